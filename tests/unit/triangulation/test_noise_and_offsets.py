import numpy as np
import pytest
from running_samples import detections, runner

from data_contracts.keypoints import KeypointDetections
from worldpose.geometry.cameras import Camera
from worldpose.static_calibration.parameters import project_with_jacobian, step_camera
from worldpose.triangulation.estimate import triangulate_joints
from worldpose.triangulation.person_offsets import stated_errors
from worldpose.triangulation.settings import TriangulationSettings

as_detections = KeypointDetections.from_keypoints

SETTINGS = TriangulationSettings(common_bias_m=0.0)
PLAIN = SETTINGS.model_copy(update={"offsets": "none"})


def test_noise_is_learned_by_joint(ring):
    camera, joints = ring(8), runner(60)
    keypoints, confidence, index = detections(camera, joints, 1.0)
    more = np.random.default_rng(2).normal(size=keypoints[..., 3, :].shape)
    keypoints[..., 3, :] += np.sqrt(8.0) * more
    result = triangulate_joints(camera, as_detections(keypoints, confidence, index), PLAIN)
    factor = result.noise.joint
    # 1 px and 3 px; 1900 residuals a joint: 2 % each. Doubtful views of the worse are cut at 3.5
    # deviations.
    assert np.sqrt(factor[3] / np.median(factor)) == pytest.approx(3.0, rel=0.1)


def test_noise_is_learned_by_confidence(ring):
    camera, joints = ring(8), runner(60)
    keypoints, confidence, index = detections(camera, joints, 1.0)
    rng = np.random.default_rng(3)
    doubtful = rng.random(confidence.shape) < 0.3
    confidence[doubtful] = 0.5
    keypoints += np.where(doubtful, 3.0, 0.0)[..., None] * rng.normal(size=keypoints.shape)
    result = triangulate_joints(camera, as_detections(keypoints, confidence, index), PLAIN)
    sure, doubt = result.noise.precision(np.ones(17)), result.noise.precision(np.full(17, 0.5))
    # sqrt(10) times the noise; knots average over classes of confidence.
    assert np.sqrt(np.median(sure / doubt)) == pytest.approx(np.sqrt(10), rel=0.15)
    worse = triangulate_joints(
        camera,
        as_detections(keypoints, confidence, index),
        PLAIN.model_copy(update={"learn_noise": False}),
    )
    error = [np.linalg.norm(r.joints - joints, axis=-1).mean() for r in (result, worse)]
    assert error[0] < 0.95 * error[1]


def test_variance_of_places_is_that_of_the_camera_covariance(ring):
    camera, joints = ring(3), runner(2)
    root = np.random.default_rng(4).normal(size=(3, 12, 12)) * 1e-3
    covariance = root @ root.swapaxes(1, 2)
    found = stated_errors(camera, joints, SETTINGS, covariance)
    for c in range(3):
        square = Camera(
            camera.focal[c],
            camera.principal_point[c],
            camera.distortion[c],
            camera.cam_from_world[c],
            camera.image_size[c],
        )
        places = joints.mean(axis=2).reshape(-1, 3)
        _, jacobian = project_with_jacobian(square, places)
        expected = np.einsum("nap,pq,naq->n", jacobian, covariance[c], jacobian) / 2
        np.testing.assert_allclose(found.variance[:, c].ravel(), expected, rtol=1e-9)


def misjudged(camera, seed, size):
    rng = np.random.default_rng(seed)
    sigma = np.array([size] * 3 + [0.0] * 9)
    count = len(camera.focal)
    cameras = [step_camera(camera[c], sigma * rng.normal(size=12)) for c in range(count)]
    return Camera.stack(cameras), np.broadcast_to(np.diag(sigma**2), (count, 12, 12)).copy()


def shape_error(joints, truth):
    """Mean error [m] of joints about their mean: calibration errors move a person as a whole."""
    return np.linalg.norm(
        (joints - joints.mean(axis=2, keepdims=True)) - (truth - truth.mean(axis=2, keepdims=True)),
        axis=-1,
    ).mean()


@pytest.mark.parametrize("known", [True, False])
def test_offsets_keep_calibration_errors_from_the_pose(ring, known):
    truth, joints = ring(8), runner(40)
    keypoints, confidence, index = detections(truth, joints, 1.0)
    # Other cameras for every joint: with the same ones all joints err alike anyway.
    confidence[np.random.default_rng(8).random(confidence.shape) < 0.25] = 0.0
    arrays = keypoints, confidence, index
    given, covariance = misjudged(truth, 5, 2e-3)
    covariance = covariance if known else None
    errors = {}
    for offsets in ("none", "midhip", "body"):
        # 2 mrad are 6 cm at 30 m.
        settings = SETTINGS.model_copy(update={"offsets": offsets})
        result = triangulate_joints(given, as_detections(*arrays), settings, covariance)
        errors[offsets] = shape_error(result.joints, joints)
    exact = shape_error(
        triangulate_joints(truth, as_detections(*arrays), SETTINGS).joints,
        joints,
    )
    assert errors["body"] < 1.15 * exact
    assert errors["body"] < errors["midhip"]
    assert errors["body"] < 0.9 * errors["none"]
