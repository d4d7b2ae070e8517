"""A recording for the rerun viewer holds people, markings and cameras."""

import re
import subprocess
import sys

import numpy as np
import pytest
from camera_builders import plain_camera

from data_contracts.conventions import COCO17_BONES
from data_contracts.pitch import PitchSpec
from worldpose.errors import UsageError
from worldpose.formats.joints_file import JointTracks
from worldpose.geometry.rigid import Rigid
from worldpose.reports.rerun_recording import write_recording


def scene():
    joints = np.random.default_rng(0).normal(size=(4, 2, 17, 3))
    joints[2, 1] = np.nan
    rotation = np.array([[1.0, 0.0, 0.0], [0.0, 0.0, -1.0], [0.0, 1.0, 0.0]])
    camera = plain_camera(
        np.full(4, 3000.0),
        (960.0, 540.0),
        Rigid(np.tile(rotation, (4, 1, 1)), np.tile([0.0, 2.0, 70.0], (4, 1))),
    )
    return JointTracks(np.arange(40, 44), np.array([3, 8]), joints), camera


def test_recording_has_people_markings_and_cameras(tmp_path):
    pytest.importorskip("rerun")
    tracks, camera = scene()
    path = tmp_path / "clip.rrd"
    write_recording(
        path, tracks, 50.0, cameras={"north": camera[0], "broadcast": camera}, pitch=PitchSpec()
    )
    assert "/world/pitch" in printed(path)
    # The printer cuts long cells: each person's first bone begins there, by frame.
    starts = re.findall(r"\[\[\[([^\]]+)\]", printed(path, "/world/people"))
    found = np.array([[float(number) for number in start.split(",")] for start in starts])
    np.testing.assert_allclose(found, tracks.joints[:, 0, COCO17_BONES[0][0]], atol=1e-6)
    for name in ("north", "broadcast"):
        camera_text = printed(path, f"/world/cameras/{name}")
        # The camera stands at (0, -70, 2) and looks along +y with z up; columns come first.
        assert "[[-0.0, -70.0, 2.0]]" in camera_text
        assert "[[1.0, 0.0, 0.0, 0.0, 0.0, -1.0, 0.0, 1.0, 0.0]]" in camera_text
        assert "[[3000.0, 0.0, 0.0, 0.0, 3000.0, 0.0, 960.0, 540.0, 1.0]]" in camera_text


def printed(path, place=None):
    """Return the viewer program's listing of a recording, or of one entity."""
    chosen = () if place is None else ("--entity", place)
    return subprocess.run(
        [sys.executable, "-m", "rerun", "rrd", "print", "-vvv", *chosen, path],
        capture_output=True,
        text=True,
        check=True,
    ).stdout


def test_without_the_viewers_package_it_says_what_to_install(tmp_path, monkeypatch):
    monkeypatch.setitem(sys.modules, "rerun", None)
    with pytest.raises(UsageError, match="with the extra rerun"):
        write_recording(tmp_path / "clip.rrd", scene()[0], 50.0)
