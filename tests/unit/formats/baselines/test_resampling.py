"""A method that saw the clip at another frame rate is scored at the clip's own."""

import numpy as np
import pytest
from method_files import FRAMES, WRITERS, scene, truth_of

from flows.cli.evaluate import named_rates
from flows.results.baselines import score_methods
from worldpose.body.model import BodyParameters
from worldpose.errors import UsageError
from worldpose.formats.joints_file import write_joints
from worldpose.formats.release_cameras import write_moving_camera


def test_a_file_of_every_second_picture_scores_as_one_of_all(tmp_path):
    bodies, camera = scene()
    # Rigid bodies on straight ways: what lies between two images is known exactly.
    still = BodyParameters(
        bodies.betas,
        np.repeat(bodies.global_orient[:, :1], FRAMES, axis=1),
        np.repeat(bodies.body_pose[:, :1], FRAMES, axis=1),
        bodies.transl,
    )
    write_joints(tmp_path / "joints.npz", truth_of(still))
    write_moving_camera(tmp_path / "cameras" / "clip.npz", camera)
    half = still[:, ::2]
    path = WRITERS["smpl"](tmp_path / "out", half, camera)
    (score,) = score_methods([f"smpl={path}"], str(tmp_path), fps=50.0, seen_fps={"smpl": 25.0})
    # All but the last frame, which lies behind the last image of the half.
    assert score.evaluation.g_mpjpe_mm == pytest.approx(0.0, abs=0.01)
    assert score.notes["resampled"] == "from 25 to 50 images per second, by linear interpolation"
    with pytest.raises(UsageError, match="--method-fps tram"):
        score_methods([f"smpl={path}"], str(tmp_path), fps=50.0, seen_fps={"tram": 25.0})
    with pytest.raises(UsageError, match="--fps"):
        score_methods([f"smpl={path}"], str(tmp_path), seen_fps={"smpl": 25.0})


@pytest.mark.parametrize("text", ["gvhmr", "gvhmr=", "gvhmr=x", "gvhmr=0", "gvhmr=-3", "gvhmr=inf"])
def test_what_is_no_rate_is_refused(text):
    with pytest.raises(UsageError, match="NAME=FPS"):
        named_rates([text])
    assert named_rates(["gvhmr=30"]) == {"gvhmr": 30.0}
