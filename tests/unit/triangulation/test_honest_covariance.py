"""Stated covariances hold the truth, and noise is learned from what was seen."""

import numpy as np
import pytest
from running_samples import MIRRORED, detections, runner

from data_contracts.conventions import COCO17
from data_contracts.keypoints import KeypointDetections
from data_contracts.triangulation import EXCHANGED_PARTS
from worldpose.geometry.cameras import Camera
from worldpose.simulation.scenarios import SCENARIOS
from worldpose.simulation.scene import simulate_scene
from worldpose.static_calibration.parameters import step_camera
from worldpose.triangulation.estimate import triangulate_joints
from worldpose.triangulation.noise_model import (
    CONDITIONS,
    OCCLUDED,
    conditions,
    learn_noise,
    shared_variance,
)
from worldpose.triangulation.person_offsets import StatedErrors
from worldpose.triangulation.residuals import Rig, no_shift
from worldpose.triangulation.settings import TriangulationSettings

as_detections = KeypointDetections.from_keypoints

# Standard deviations of steps in the order of PARAMETERS; together some 9 cm at a player.
CALIBRATION = np.array([3e-4] * 3 + [0.05] * 3 + [7e-4, 2.0, 2.0, 0.0, 0.0, 0.0])
INSIDE = 7.815
"""95 % quantile of chi-square with three degrees of freedom."""


def simulated(seed, people=8):
    """Cameras, arrays as the tracker would match them, and the truth of a short stretch."""
    scenario = SCENARIOS["match"]
    crowd = scenario.crowd.model_copy(update={"people": people})
    # The common bias of all views would hide whether the noise is honest.
    noise = scenario.noise.model_copy(update={"shared_bias_m": 0.0, "own_bias_m": 0.0})
    changes = {"duration": 0.8, "crowd": crowd, "broadcast": (), "noise": noise}
    scene = simulate_scene(scenario.model_copy(update=changes), seed)
    seen = scene.static_views()
    arrays = seen.detections.keypoints, seen.detections.confidence, seen.index(people)
    return Camera.stack(list(scene.cameras.values())), arrays, scene.truth.joints


def squared_deviations(result, truth):
    """Of the joints of one frame: frames a third of a second apart are not independent."""
    middle = len(truth) // 2
    joints, covariance = result.joints[middle], result.covariance[middle]
    found = np.isfinite(joints[..., 0])
    error = (joints - truth[middle])[found]
    return np.einsum("ni,nij,nj->n", error, np.linalg.inv(covariance[found]), error)


def two_views_each(index, rng):
    """Keep two cameras per person, of those that see him nearly always."""
    index = index.copy()
    for person in range(index.shape[2]):
        always = np.flatnonzero((index[:, :, person] >= 0).mean(axis=0) > 0.8)
        kept = rng.permutation(always)[:2]
        index[:, np.setdiff1d(np.arange(index.shape[1]), kept), person] = -1
    return index


def coverage(seeds):
    """Share of joints within their 95 % region, and their number, by case."""
    settings = TriangulationSettings(common_bias_m=0.0)
    squared = {"exact": [], "calibrated": [], "two views": []}
    for seed in seeds:
        cameras, arrays, truth = simulated(seed)
        rng, (keypoints, confidence, index) = np.random.default_rng(seed), arrays
        exact = triangulate_joints(cameras, as_detections(*arrays), settings)
        squared["exact"].append(squared_deviations(exact, truth))
        count = len(cameras.focal)
        steps = CALIBRATION * rng.normal(size=(count, 12))
        given = Camera.stack([step_camera(cameras[c], steps[c]) for c in range(count)])
        covariance = np.broadcast_to(np.diag(CALIBRATION**2), (count, 12, 12)).copy()
        calibrated = triangulate_joints(given, as_detections(*arrays), settings, covariance)
        squared["calibrated"].append(squared_deviations(calibrated, truth))
        few = keypoints, confidence, two_views_each(index, rng)
        two = triangulate_joints(cameras, as_detections(*few), settings)
        squared["two views"].append(squared_deviations(two, truth))
    joined = {case: np.concatenate(values) for case, values in squared.items()}
    return {case: ((values < INSIDE).mean(), len(values)) for case, values in joined.items()}


@pytest.mark.slow
def test_regions_of_95_percent_hold_the_truth_in_93_to_97_percent():
    figures = coverage(range(30))
    for case, (share, number) in figures.items():
        # 0.4 % of sampling error for joints of their own; people of a clip share the detector's
        # bias and the rig its calibration.
        assert number > 3000, case
        assert 0.93 <= share <= 0.97, figures


def test_regions_hold_the_truth_of_one_clip():
    share, number = coverage([3])["exact"]
    # 136 joints, not independent: five standard errors below and everything above.
    assert number > 100
    assert share > 0.86


def test_a_calibration_displaces_the_people_whom_its_camera_shows():
    # 100 px to the metre: 4 px are 4 cm; beyond the image of the camera the lens means nothing.
    variance, scale = np.array([[[16.0, 1e6, 1e6]]]), np.full((1, 1, 3), 100.0)
    shown = np.array([[[True, False, False]]])
    (displacement,) = StatedErrors(variance, scale).position_std(1.0, shown)
    assert displacement.median == pytest.approx(0.04, rel=0.01)
    (displacement,) = StatedErrors(variance, scale).position_std(4.0, shown)
    assert displacement.median == pytest.approx(0.08, rel=0.01)
    (displacement,) = StatedErrors(variance, scale).position_std(1.0, ~shown & shown)
    assert displacement.median is None


def test_a_worse_camera_is_learned_from_residuals(ring):
    cameras = ring(7)
    joints = runner(20, persons=12)
    keypoints, confidence, index = detections(cameras, joints, noise=2.0)
    exact, _, _ = detections(cameras, joints, noise=0.0)
    keypoints[:, 2] += 2.0 * (keypoints[:, 2] - exact[:, 2])
    seen = KeypointDetections.from_keypoints(keypoints, confidence, index)
    model = learn_noise(Rig.from_cameras(cameras), seen, no_shift(), (2.0, 0.0), 1e3)
    rest = np.delete(model.camera, 2, axis=0).mean()
    # Three times the noise; a prior of 20 degrees of freedom per frame holds the ratio back.
    assert 5.0 < model.camera[2].mean() / rest < 9.5
    precision = model.precision(confidence, conditions(keypoints))
    assert precision[:, 0].mean() > 5.0 * precision[:, 2].mean()


def test_views_that_miss_a_joint_raise_the_error_that_all_views_share():
    variance = shared_variance(np.array([0.02]), np.array([[[4], [3], [0]]]), np.array([[4, 4, 0]]))
    expected = 0.02 * (1.0 + OCCLUDED * np.array([0.0, 0.25, 1.0]))
    assert variance[0, :, 0] == pytest.approx(expected**2)


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


def standing(x, bottom, height):
    """Keypoints (17, 2) [px] of an upright person whose trunk is a third of the height."""
    up = {"shoulder": 0.8, "hip": 0.8 - 1 / 3, "knee": 0.25, "ankle": 0.0, "elbow": 0.65}
    rows = [up.get(name.split("_")[-1], 0.9) for name in COCO17]
    side = [0.05 * (("left" in name) - ("right" in name)) for name in COCO17]
    return np.stack([x + height * np.array(side), bottom - height * np.array(rows)], axis=-1)


def test_keypoints_are_hidden_by_a_nearer_person_and_classed_by_their_distance_from_the_trunk():
    far, near = standing(300.0, 400.0, 120.0), standing(302.0, 450.0, 180.0)
    apart = standing(700.0, 400.0, 120.0)
    found = conditions(np.stack([far, near, apart])[None, None])[0, 0]
    alone = found[2]
    # The trunk's middle is at 0.633 of the height, its length a third: ankles are 1.9 away.
    assert alone[COCO17.index("left_ankle")] == 3
    assert alone[COCO17.index("left_knee")] == 2
    assert alone[COCO17.index("left_elbow")] == 0
    np.testing.assert_array_equal(found[1], alone)
    inside = (np.abs(far[:, 0] - 302.0) < 9.0) & (far[:, 1] > near[:, 1].min())
    np.testing.assert_array_equal(found[0], alone + CONDITIONS // 2 * inside)
