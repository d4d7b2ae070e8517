import numpy as np
import pytest

from worldpose.cameras import Camera
from worldpose.evaluation import evaluate_joints
from worldpose.release import JointTracks
from worldpose.synthetic import SCENARIOS, simulate_scene
from worldpose.tracking import TrackingSettings, track_people
from worldpose.triangulation import TriangulationSettings, triangulate_joints


def reconstructed(scenario, seed):
    """G-MPJPE and PA-MPJPE [mm] of tracked and triangulated joints, with the given cameras."""
    scene = simulate_scene(scenario, seed)
    people = [scene.observations[name] for name in scene.cameras]
    most = max(each.keypoints.shape[1] for each in people)
    shape = (len(scene.truth.frames), len(people), most, 17)
    keypoints, confidence = np.full((*shape, 2), np.nan), np.full(shape, np.nan)
    for index, each in enumerate(people):
        found = each.keypoints.shape[1]
        keypoints[:, index, :found] = each.keypoints
        confidence[:, index, :found] = each.confidence
    cameras = Camera.stack([scene.given[name] for name in scene.cameras])
    tracks = track_people(cameras, keypoints, confidence, scenario.fps, TrackingSettings())
    index = tracks.detection_index
    joints = triangulate_joints(cameras, keypoints, confidence, index, TriangulationSettings())
    prediction = JointTracks(scene.truth.frames, np.asarray(tracks.person), joints.joints)
    scores, _ = evaluate_joints(prediction, scene.truth, fps=scenario.fps)
    return scores.g_mpjpe_mm, scores.pa_mpjpe_mm


@pytest.mark.slow
def test_the_trial_with_true_cameras_comes_as_near_as_the_papers_after_adjustment():
    figures = np.array([reconstructed(SCENARIOS["penalty-box"], seed) for seed in range(1, 11)])
    # The paper has 83.5 mm from its base calibration and 80.0 with adjustment and body fits; the
    # detector's own part, left with true cameras, is pinned at 62 to 72 mm (docs/synthetic.md).
    # Ten seeds spread by 5.5 mm: standard error 1.8 mm.
    assert 62.0 < figures[:, 0].mean() < 72.0
    assert 54.0 < figures[:, 1].mean() < 66.0
