import numpy as np
import pytest
from running_samples import MIRRORED, detections, runner

from data_contracts.conventions import COCO17
from data_contracts.keypoints import KeypointDetections
from data_contracts.triangulation import EXCHANGED_PARTS
from worldpose.geometry.cameras import Camera
from worldpose.geometry.rigid import Rigid
from worldpose.triangulation.estimate import triangulate_joints
from worldpose.triangulation.limb_lengths import find_swaps
from worldpose.triangulation.residuals import Observations, Rig
from worldpose.triangulation.settings import TriangulationSettings
from worldpose.triangulation.solve import SolvedJoints

as_detections = KeypointDetections.from_keypoints

SETTINGS = TriangulationSettings(learn_noise=False, offsets="none")
FACE, ARMS, LEGS = range(len(EXCHANGED_PARTS))


def exchanged(array, joints=range(17)):
    out = array.copy()
    for joint in joints:
        out[..., joint, :] = array[..., MIRRORED[joint], :]
    return out


@pytest.fixture
def clip(ring):
    """Cameras, and keypoints, confidence and index of two runners seen without noise."""
    camera = ring(5)
    return camera, detections(camera, runner(12), 0.0)


def test_exchanged_sides_are_found_named_and_put_right(clip):
    camera, (keypoints, confidence, index) = clip
    expected = triangulate_joints(camera, as_detections(keypoints, confidence, index), SETTINGS)
    assert not expected.exchanged.any()
    wrong, truth = keypoints.copy(), np.zeros_like(expected.exchanged)
    wrong[3:7, 1, 0] = exchanged(keypoints[3:7, 1, 0])
    truth[3:7, 1, 0] = True
    legs = [joint for joint, name in enumerate(COCO17) if name[-4:] in ("_hip", "knee", "nkle")]
    wrong[5:9, 3, 1] = exchanged(keypoints[5:9, 3, 1], legs)
    truth[5:9, 3, 1, LEGS] = True
    found = triangulate_joints(camera, as_detections(wrong, confidence, index), SETTINGS)
    np.testing.assert_array_equal(found.exchanged, truth)
    # The same observations: the same joints to the last step of the iteration.
    np.testing.assert_allclose(found.joints, expected.joints, atol=1e-6)
    assert found.inliers.all()
    assert found.report.exchanged_share == (0.0, 4 / 24, 0.0, 4 / 24, 0.0)


def test_noise_is_not_taken_for_an_exchange(ring):
    # 6 px are twice the stated noise here; odds of fifty to one leave a few in a thousand.
    arrays = detections(ring(5), runner(40), 6.0)
    found = triangulate_joints(ring(5), as_detections(*arrays), SETTINGS)
    assert found.exchanged.any(axis=-1).mean() < 0.01


@pytest.mark.parametrize(
    ("aside", "legs_fit", "parts"),
    [
        # 7 against twice log(50), 7.8, for a whole body; 9, which is enough.
        (3.2, False, []),
        (3.4, False, [FACE, ARMS, LEGS]),
        # The legs are the right way round: 9 against twice log(150), 10.0, for arms alone; 11.
        (3.4, True, []),
        (3.6, True, [ARMS]),
    ],
)
def test_an_exchange_needs_as_much_evidence_as_it_is_rare(aside, legs_fit, parts):
    camera = Camera(
        focal=np.array([[1000.0, 1000.0]]),
        principal_point=np.zeros((1, 2)),
        distortion=np.zeros((1, 5)),
        cam_from_world=Rigid(np.eye(3)[None], np.zeros((1, 3))),
        image_size=np.array([[1920, 1080]]),
    )
    # Left and right wrist, left and right ankle: 5 px apart; only the left ones are seen.
    wrist, ankle = COCO17.index("left_wrist"), COCO17.index("left_ankle")
    joints, keypoints = np.full((1, 1, 17, 3), np.nan), np.zeros((1, 1, 1, 17, 2))
    joints[0, 0, [wrist, ankle]] = [0.0, 0.0, 10.0]
    joints[0, 0, [wrist + 1, ankle + 1]] = [0.05, 0.0, 10.0]
    keypoints[..., wrist, 0] = aside
    precision = np.zeros((1, 1, 1, 17))
    precision[..., wrist], precision[..., ankle] = 1.0, legs_fit
    found = SolvedJoints(
        joints=joints,
        covariance=np.zeros((1, 1, 17, 3, 3)),
        views=np.zeros((1, 1, 17), np.uint8),
        spread=np.zeros((1, 1, 17), np.float32),
        reprojection_error=np.zeros((1, 1, 17), np.float32),
        inliers=np.zeros((1, 1, 1, 17), np.bool_),
        seen=np.ones((1, 1, 1, 17), np.bool_),
    )
    index, noise = np.zeros((1, 1, 1), np.int64), (1.0, 0.0)
    observed = Observations.of(Rig.from_cameras(camera), keypoints, precision, index)
    # The squared residual, minus that with sides swapped, both at most 25.
    flags = find_swaps(observed, noise, 25.0, found)
    assert np.flatnonzero(flags).tolist() == parts
