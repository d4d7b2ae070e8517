"""The 3D view of a complete run in a real browser."""

from pathlib import Path

import cv2
import page_client
import pytest
from chromium import IN_BROWSER, drive
from command_line import TINY, succeed

pytestmark = [*IN_BROWSER, pytest.mark.timeout(1800)]
SCRIPT = Path(__file__).with_name("result_page_in_browser.mjs")


def test_people_are_seen_in_3d_and_played(project_copy, tmp_path):
    report = tmp_path / "report.html"
    succeed("report", TINY, "--project", project_copy, "--out", report, "--no-videos")
    with page_client.serving(project_copy, tmp_path) as base:
        picture = tmp_path / "view.png"
        task = {"base": base, "token": page_client.TOKEN, "match": TINY, "picture": str(picture)}
        task["report"] = str(report)
        seen = drive(SCRIPT, task, tmp_path, 600)
    blue, green, red = cv2.imread(str(picture)).astype(int).transpose(2, 0, 1)
    is_grass = (green > red + 20) & (green > blue + 20)
    assert is_grass.mean() > 0.3
    # The first person is blue (0, 114, 178), lit or not; sky, grass, lines and labels are not.
    is_person = (blue > 1.2 * green) & (green > 1.5 * red) & (blue > 60)
    assert is_person.sum() > 30
    assert {name: value for name, value in seen.items() if "overflow" in name and value} == {}
    assert (seen["reports"], seen["cameras"]) == ([[5, 120], [5, 120]], 6)
    assert seen["refused"].startswith("bvh: needs the extra usd")
    assert (seen["pages"], seen["held"]) == (1, "true")
