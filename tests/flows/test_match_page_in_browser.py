"""The page of a match names a camera that is left out, and lists corrections: in a real browser."""

import json
import shutil
from pathlib import Path

import page_client
import pytest
from chromium import IN_BROWSER, drive
from command_line import TINY, worldpose
from long_journal import write_corrections

from worldpose.store.store import Store

pytestmark = [*IN_BROWSER, pytest.mark.timeout(1200)]
SCRIPT = Path(__file__).with_name("match_page_in_browser.mjs")


def test_a_left_out_camera_and_groups_of_corrections_are_seen(tiny, tmp_path):
    folder = shutil.copytree(tiny, tmp_path / "match")
    file = folder / "annotations" / "static_calibration" / "cam01.json"
    clicked = json.loads(file.read_text())
    clicked["points"], clicked["drawn"] = clicked["points"][:2], []
    file.write_text(json.dumps(clicked))
    project = tmp_path / "project"
    done = worldpose("run", folder, "--project", project, "--until", "static_calibration", "--json")
    reason = done.json["left_out"]["cam01"]
    write_corrections(Store.open(project), TINY, 450)
    with page_client.serving(project, tmp_path) as base:
        task = {"base": base, "token": page_client.TOKEN, "match": TINY}
        seen = drive(SCRIPT, task, tmp_path, 600)
    (note,) = [text for text in seen["notes"] if "left out" in text]
    assert note.startswith("The results of run 0001 are usable with reservations")
    assert f"camera cam01 is left out: {reason.rstrip('.')}." in note
    (row,) = [text for text in seen["rows"] if text.startswith("cam01")]
    assert "left out" in row
    assert (seen["listed"], seen["more"]) == ([200, 400, 450], 0)
    assert (seen["stays"], seen["dismissed"]) == (1, 0)
    assert [seen[f"overflow_{width}"] for width in (1440, 1280, 390)] == [0, 0, 0]
    assert seen["progress"] == "Running, 42 % tracking, 18 s left"
    assert (seen["cancel"], seen["steps"]) == (1, "▶ identify people across cameras and over time")
    assert (seen["who"], seen["run_buttons"]) == ("Ada, viewer", 0)
