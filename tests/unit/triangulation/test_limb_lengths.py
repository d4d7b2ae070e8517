import numpy as np
import pytest

from data_contracts.conventions import COCO17, COCO17_LIMBS
from data_contracts.keypoints import KeypointDetections
from worldpose.triangulation.estimate import triangulate_joints
from worldpose.triangulation.limb_lengths import (
    FEWEST,
    limb_lengths,
)
from worldpose.triangulation.residuals import Observations, Rig
from worldpose.triangulation.settings import TriangulationSettings
from worldpose.triangulation.solve import solve_joints

as_detections = KeypointDetections.from_keypoints

# Noise as stated: exact views do not make the least disagreement count.
SETTINGS = TriangulationSettings(learn_noise=False, offsets="none")
AS_THEY_AGREE = SETTINGS.model_copy(update={"repair_limb_lengths": False})
ANKLE, WRIST, ELBOW = (COCO17.index(f"left_{name}") for name in ("ankle", "wrist", "elbow"))
SHANK = 0.4
BAD = 7


def walker(frames=12):
    """Joints (frames, 1, 17, 3) of a person who moves 2 cm per frame in a fixed pose."""
    body = np.zeros((17, 3))
    body[:5] = [0.1, 0.0, 1.7]
    for side, (shoulder, elbow, wrist, hip, knee, ankle) in (
        (1.0, (5, 7, 9, 11, 13, 15)),
        (-1.0, (6, 8, 10, 12, 14, 16)),
    ):
        body[shoulder] = [0.0, 0.2 * side, 1.45]
        body[elbow] = [0.0, 0.25 * side, 1.16]
        body[wrist] = [0.12, 0.25 * side, 0.95]
        body[hip] = [0.0, 0.15 * side, 0.9]
        body[knee] = [0.05, 0.15 * side, 0.1 + SHANK]
        body[ankle] = [0.05, 0.15 * side, 0.1]
    body[1:5, 1] = [0.03, -0.03, 0.07, -0.07]
    return (body + 0.02 * np.arange(frames)[:, None, None] * [1.0, 0.0, 0.0])[:, None]


def misled(camera, arrays, joints, joint, one, two, ahead=0.8):
    """Let one view see a joint of one frame as a point on its way to another camera looks."""
    keypoints, confidence, index = (array.copy() for array in arrays)
    true = joints[BAD, 0, joint]
    way = camera.center[two] - true
    wrong = true + ahead * way / np.linalg.norm(way)
    keypoints[BAD, one, 0, joint] = camera[np.array([one])].project(wrong[None, None])[0, 0]
    return (keypoints, confidence, index), wrong


def test_of_pairs_that_agree_as_well_the_one_that_keeps_the_limb_decides(ring, seen):
    camera, joints = ring(3), walker()
    arrays, wrong = misled(camera, seen(camera, joints), joints, ANKLE, 0, 1)
    # The true pair agrees to 3 px, the wrong one exactly: looked at alone, that is the better one.
    arrays[0][BAD, 2, 0, ANKLE] += [0.0, 3.0]
    alone = triangulate_joints(camera, as_detections(*arrays), AS_THEY_AGREE)
    assert np.linalg.norm(alone.joints[BAD, 0, ANKLE] - wrong) < 0.01
    mended = triangulate_joints(camera, as_detections(*arrays), SETTINGS)
    # 3 px are 6 cm at 30 m.
    assert np.linalg.norm(mended.joints[BAD, 0, ANKLE] - joints[BAD, 0, ANKLE]) < 0.06
    assert mended.inliers[BAD, :, 0, ANKLE].tolist() == [False, True, True]
    assert mended.views[BAD, 0, ANKLE] == 2
    others = np.delete(np.arange(17), ANKLE)
    np.testing.assert_array_equal(mended.joints[:, :, others], alone.joints[:, :, others])


def test_end_that_two_views_alone_place_far_from_its_limb_is_missing(ring, seen):
    camera, joints = ring(4)[np.array([0, 1])], walker()
    arrays, wrong = misled(camera, seen(camera, joints), joints, WRIST, 0, 1)
    alone = triangulate_joints(camera, as_detections(*arrays), AS_THEY_AGREE)
    assert np.linalg.norm(alone.joints[BAD, 0, WRIST] - wrong) < 0.01
    mended = triangulate_joints(camera, as_detections(*arrays), SETTINGS)
    for name in ("joints", "covariance", "reprojection_error", "spread"):
        assert np.isnan(getattr(mended, name)[BAD, 0, WRIST]).all()
    assert mended.views[BAD, 0, WRIST] == 0
    assert not mended.inliers[BAD, :, 0, WRIST].any()
    assert np.isfinite(mended.joints).all(axis=-1).sum() == joints[..., 0].size - 1


def test_what_three_views_agree_on_stays_however_long_the_limb(ring, seen):
    camera, joints = ring(4), walker()
    joints[BAD, 0, ANKLE] += [0.0, 0.0, 1.0]
    arrays = seen(camera, joints)
    result = triangulate_joints(camera, as_detections(*arrays), SETTINGS)
    np.testing.assert_array_equal(
        result.joints,
        triangulate_joints(camera, as_detections(*arrays), AS_THEY_AGREE).joints,
    )


@pytest.mark.parametrize("frames", [FEWEST - 1, FEWEST])
def test_lengths_need_five_frames(ring, seen, frames):
    camera, joints = ring(3), walker(frames)
    keypoints, confidence, index = seen(camera, joints)
    found = solve_joints(
        Observations.of(Rig.from_cameras(camera), keypoints, confidence, index), SETTINGS
    )
    lengths = limb_lengths(found)
    assert lengths.shape == (1, len(COCO17_LIMBS))
    if frames < FEWEST:
        assert np.isnan(lengths).all()
    else:
        # Exact views: rounding of single precision is not involved.
        np.testing.assert_allclose(lengths[0, -2:], SHANK, atol=1e-6)
        np.testing.assert_allclose(lengths[0, 2:4], np.hypot(0.12, 0.21), atol=1e-6)


def test_frames_that_three_views_agree_in_tell_how_long_a_limb_is(ring, seen):
    camera, joints = ring(3), walker()
    keypoints, confidence, index = seen(camera, joints)
    found = solve_joints(
        Observations.of(Rig.from_cameras(camera), keypoints, confidence, index), SETTINGS
    )
    # Two views alone put the ankle 2 cm lower in seven frames of twelve.
    found.joints[:7, 0, ANKLE, 2] -= 0.02
    found.views[:7, 0, ANKLE] = 2
    shank = COCO17_LIMBS.index((COCO17.index("left_knee"), ANKLE))
    assert limb_lengths(found)[0, shank] == pytest.approx(SHANK, abs=1e-6)
    # Four frames are too few: then all of them tell.
    found.views[7, 0, ANKLE] = 2
    assert limb_lengths(found)[0, shank] == pytest.approx(SHANK + 0.02, abs=1e-6)
