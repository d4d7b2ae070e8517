"""A match with a broadcast video, from the command line to the page about it."""

import pytest
from command_line import succeed

from worldpose.video import VideoReader


@pytest.mark.slow
def test_a_broadcast_clip_is_calibrated_scored_and_shown(server, tmp_path):
    match, project = tmp_path / "match", tmp_path / "project"
    scenario = ("--scenario", "broadcast-pan", "--seed", 2, "--duration", 1.2, "--cameras", 6)
    succeed("simulate", *scenario, "--calibrated", "--no-stills", "--out", match)
    succeed("run", match, "--project", project)
    truth = ("--prediction", match, "--reference", match / "reference")
    scores = succeed("evaluate", *truth, "--project", project, "--json").json
    camera = scores["cameras"]["broadcast"]
    # 1.2 s tell less of the place and the lens than 30.
    assert camera["center_error_m"] < 0.3
    assert camera["focal_error_percent"] < 0.5
    page = tmp_path / "page.html"
    told = succeed("report", match, "--project", project, "--out", page, "--json").json
    assert "known least" in page.read_text()
    # 60 frames at 50 a second are shown at 25.
    with VideoReader(tmp_path / "page-clip.mp4") as video:
        assert len(video) == 30
        assert video.frame(0).shape == (540, 960, 3)
    assert told["videos"] == [str(tmp_path / "page-clip.mp4")]
