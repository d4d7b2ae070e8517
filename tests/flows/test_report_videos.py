"""Which camera's video lies beside the page, and what is loaded before a thread films it."""

from types import SimpleNamespace

import pytest
from run_records import match_spec

from flows.reports.report import write_report
from worldpose.errors import UsageError


@pytest.mark.parametrize("asked", ["south", "main", "nobody"])
def test_a_camera_without_a_video_of_its_own_is_refused_before_anything_is_written(tmp_path, asked):
    names = {"north": "static", "south": "static", "main": "broadcast"}
    cameras = {name: {"kind": kind} for name, kind in names.items()}
    spec = match_spec(cameras, {"clip": {"frame_count": 4, "broadcast": "main"}})
    folder = SimpleNamespace(spec=spec, videos={"north": "a.mp4", "clip": "b.mp4"})
    page = tmp_path / "report.html"
    with pytest.raises(UsageError, match=rf"--camera {asked}: .*these have one: north\."):
        there = SimpleNamespace(folder=folder)
        write_report(None, SimpleNamespace(at_hand=lambda: there), page, camera=asked)
    assert not page.exists()
