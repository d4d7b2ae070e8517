"""A camera that contradicts the others is named and left out; the match continues without it."""

import json
import shutil

import pytest
from command_line import TINY, worldpose

from worldpose.store.store import open_run

OTHER_END = {"left": "right", "right": "left", "near": "far", "far": "near"}


def click_the_other_end(folder, camera):
    """Give every click of a camera the name of its place at the pitch's other end."""
    file = folder / "annotations" / "static_calibration" / f"{camera}.json"
    clicked = json.loads(file.read_text())
    for marking in (*clicked["points"], *clicked["drawn"]):
        words = marking["name"].split("_")
        marking["name"] = "_".join(OTHER_END.get(word, word) for word in words)
    file.write_text(json.dumps(clicked))


@pytest.mark.usefixtures("server")
def test_a_camera_with_clicks_of_the_other_end_is_named_and_left_out(tiny, tmp_path):
    match, project = shutil.copytree(tiny, tmp_path / "match"), tmp_path / "project"
    click_the_other_end(match, "cam02")
    answer = worldpose("run", match, "--project", project, "--until", "tracking")
    assert answer.code == 0, answer.err
    warning = " ".join(answer.err.split())
    assert "camera cam02 is left out: its calibration is turned by half a turn" in warning
    run = open_run(project, TINY)
    assert list(run.record.left_out) == ["cam02"]
    (fault,) = run["camera_consistency/clip"].attrs["faults"]
    assert (fault["camera"], fault["kind"]) == ("cam02", "flipped")
    assert fault["share_now"] < 0.3 < 0.8 < fault["share_corrected"]
    tracks = run["tracking/clip"]
    assert "cam02" not in tracks["camera"].values.tolist()
    assert len(tracks["camera"].values.tolist()) == 5
    assert run.record.figures["tracking/clip"]["unmatched_share"] < 0.1
