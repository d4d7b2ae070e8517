"""A method that saw the clip at another frame rate is scored at the clip's own."""

import numpy as np
import pytest
from method_files import FRAMES, WRITERS, scene, truth_of

from flows.cli.evaluate import named_rates
from flows.results.baselines import score_methods
from worldpose.body.model import BodyParameters
from worldpose.errors import UsageError
from worldpose.formats.baselines.result import MethodResult, resample_result
from worldpose.formats.challenge import write_moving_camera
from worldpose.formats.joints_file import JointTracks, write_joints


def straight(frames, speed, persons=1):
    """A person who moves along x by so much in each image."""
    joints = np.zeros((len(frames), persons, 17, 3))
    joints[..., 0] = speed * np.asarray(frames)[:, None, None]
    boxes = np.repeat(joints[:, :, 0, :1], 4, axis=-1)
    return MethodResult(JointTracks(np.array(frames), np.arange(persons), joints), "shared", boxes)


@pytest.mark.parametrize(
    ("seen", "fps"), [(30.0, 50.0), (50.0, 30.0), (25.0, 50.0), (29.97, 59.94)]
)
def test_straight_motion_stays_what_it_is(seen, fps):
    found = resample_result(straight(np.arange(31), 1.0 / seen), seen, fps)
    frames = found.joints.frames
    assert (frames[0], frames[-1]) == (0, int(np.floor(30 * fps / seen + 1e-6)))
    np.testing.assert_array_equal(np.diff(frames), 1)
    np.testing.assert_allclose(found.joints.joints[:, 0, 0, 0], frames / fps, atol=1e-12)
    np.testing.assert_allclose(found.boxes[:, 0, 2], frames / fps, atol=1e-12)
    assert f"from {seen:g} to {fps:g}" in found.notes["resampled"]


def test_a_gap_stays_a_gap_and_its_edges_are_not_drawn_out():
    result = straight([3, 4, 7, 8], 1.0)
    found = resample_result(result, 25.0, 50.0)
    known = found.joints.frames[np.isfinite(found.joints.joints[:, 0, 0, 0])]
    assert known.tolist() == [6, 7, 8, 14, 15, 16]


def test_a_person_who_is_missing_in_one_of_two_pictures_is_missing_between_them():
    result = straight(np.arange(3), 1.0, persons=2)
    result.joints.joints[1, 1] = np.nan
    found = resample_result(result, 25.0, 50.0)
    there = np.isfinite(found.joints.joints[:, :, 0, 0])
    np.testing.assert_array_equal(there[:, 0], True)
    np.testing.assert_array_equal(there[:, 1], [True, False, False, False, True])


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
