from statistics import mean

import numpy as np
import pytest

from worldpose.evaluation.metrics import evaluate_joints
from worldpose.formats.joints_file import JointTracks
from worldpose.geometry.cameras import Camera
from worldpose.pitch.template import PitchTemplate
from worldpose.simulation.scenarios import SCENARIOS
from worldpose.simulation.scene import simulate_scene
from worldpose.static_calibration.calibration import calibrate_camera
from worldpose.static_calibration.settings import StaticCalibrationSettings
from worldpose.tracking.settings import TrackingSettings
from worldpose.tracking.tracker import track_people
from worldpose.triangulation.estimate import triangulate_joints
from worldpose.triangulation.settings import TriangulationSettings


def reconstructed(scene, cameras, fps):
    """Scores of tracked and plainly triangulated joints: cameras are taken as exact."""
    seen = scene.static_views()
    tracks = track_people(cameras, seen.detections, fps, TrackingSettings())
    index = tracks.detection_index
    plain = TriangulationSettings(learn_noise=False, offsets="none")
    joints = triangulate_joints(cameras, seen.detections.assign_people(index), plain)
    prediction = JointTracks(scene.truth.frames, np.asarray(tracks.person), joints.joints)
    scores, _ = evaluate_joints(prediction, scene.truth, fps=fps)
    return scores


def from_clicks(scene):
    """The static cameras by the plain calibration: clicks, without the lines in the images."""
    pitch = PitchTemplate.from_spec(scene.surveyed)
    plain = StaticCalibrationSettings(lines=False)
    return Camera.stack(
        [
            calibrate_camera(pitch, clicks.markings, (1920, 1080), settings=plain).estimate.camera
            for clicks in scene.clicks.values()
        ]
    )


@pytest.mark.slow
def test_clicks_of_the_trial_cost_joints_less_than_the_papers_base_does_but_not_nothing():
    scenario = SCENARIOS["penalty-box"].model_copy(update={"broadcast": None})
    true, plain = [], []
    for seed in range(1, 11):
        scene = simulate_scene(scenario, seed)
        exact = Camera.stack(list(scene.cameras.values()))
        true.append(reconstructed(scene, exact, scenario.fps))
        plain.append(reconstructed(scene, from_clicks(scene), scenario.fps))
    # The detector's own part is pinned at 62 to 72 mm. The paper has 83.5 / 70.8 mm from its base
    # calibration; ours has to be better, and to leave something for later stages to gain.
    assert 62.0 < mean(each.g_mpjpe_mm for each in true) < 72.0
    assert 54.0 < mean(each.pa_mpjpe_mm for each in true) < 66.0
    cost = mean(each.g_mpjpe_mm for each in plain) - mean(each.g_mpjpe_mm for each in true)
    assert 5.0 < cost < 83.5 - 66.0
    assert mean(each.g_mpjpe_mm for each in plain) < 83.5
    assert 65.0 < mean(each.pa_mpjpe_mm for each in plain) < 78.0
