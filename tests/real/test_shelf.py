"""Real multi-view detections of people around a shelf; skipped where the data is absent.

WORLDPOSE_TEST_DATA names a folder with `shelf_dev/import` (calibration.toml, detections) and
`shelf_dev/pcp.py` and `gt.npz` (the scorer of the published PCP3D).
"""

import importlib.util

import numpy as np
import pytest
from command_line import succeed
from real_data import GIVEN, needs

from worldpose.formats.joints_file import read_joints

SHELF = GIVEN / "shelf_dev"

pytestmark = [
    needs("shelf_dev"),
    pytest.mark.usefixtures("server"),
    pytest.mark.slow,  # 60 of its frames are in test_shelf_cameras.py
]


def test_shelf_is_reconstructed_from_real_detections(tmp_path):
    match, project, out = tmp_path / "shelf", tmp_path / "worldpose-data", tmp_path / "out"
    source = SHELF / "import"
    succeed(
        *("import", "--calibration", source / "calibration.toml"),
        *("--detections", source / "detections", "--fps", 25, "--out", match),
    )
    succeed("run", match, "--project", project)
    succeed("export", "shelf", "--format", "joints", "--out", out, "--project", project)
    tracks = read_joints(out / "joints.npz")
    truth = np.load(SHELF / "gt.npz")
    assert tracks.frames.tolist() == truth["frames"].tolist()

    spec = importlib.util.spec_from_file_location("pcp", SHELF / "pcp.py")
    pcp = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(pcp)
    poses = dict(zip(tracks.frames.tolist(), tracks.joints, strict=True))
    score, _ = pcp.evaluate(truth["gt"], truth["frames"], poses, "shelf")
    # A plain matcher reaches 98.5; seen here 98.53 of fitted bodies, 98.59 of triangulated joints.
    assert score["avg_pcp_actors_1_3"] >= 98.0, score
