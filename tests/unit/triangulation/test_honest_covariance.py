import numpy as np
import pytest

from data_contracts.keypoints import KeypointDetections
from worldpose.geometry.cameras import Camera
from worldpose.simulation.scenarios import SCENARIOS
from worldpose.simulation.scene import simulate_scene
from worldpose.static_calibration.parameters import step_camera
from worldpose.triangulation.estimate import triangulate_joints
from worldpose.triangulation.person_offsets import StatedErrors
from worldpose.triangulation.settings import TriangulationSettings

as_detections = KeypointDetections.from_keypoints

# Standard deviations of steps in the order of PARAMETERS; together some 9 cm at a player.
CALIBRATION = np.array([3e-4] * 3 + [0.05] * 3 + [7e-4, 2.0, 2.0, 0.0, 0.0, 0.0])
INSIDE = 7.815
"""95 % quantile of chi-square with three degrees of freedom."""


def simulated(seed, people=8):
    """Cameras, arrays and the truth of a short stretch of the match."""
    scenario = SCENARIOS["match"]
    crowd = scenario.crowd.model_copy(update={"people": people})
    # The common bias of all views would hide whether the noise is honest.
    noise = scenario.noise.model_copy(update={"shared_bias_m": 0.0, "own_bias_m": 0.0})
    changes = {"duration": 0.8, "crowd": crowd, "broadcast": (), "noise": noise}
    return arrays_of(simulate_scene(scenario.model_copy(update=changes), seed), people)


def arrays_of(scene, people):
    """Cameras, arrays as the tracker would match them, and the truth."""
    seen = scene.static_views()
    cameras = Camera.stack(list(scene.cameras.values()))
    return (
        cameras,
        (seen.detections.keypoints, seen.detections.confidence, seen.index(people)),
        scene.truth.joints,
    )


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
        cameras, (keypoints, confidence, index), truth = simulated(seed)
        rng = np.random.default_rng(seed)
        arrays = keypoints, confidence, index
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
