"""The stage's accuracy on whole scenarios, in full size, against the truth."""

import numpy as np
import pytest

from worldpose.broadcast_calibration.calibration import BroadcastClip, calibrate_broadcast
from worldpose.broadcast_calibration.moving_camera import MovingCamera
from worldpose.broadcast_calibration.players import People
from worldpose.pitch.template import PitchTemplate
from worldpose.simulation.annotations import click_key_frames
from worldpose.simulation.renderer import render_broadcast
from worldpose.simulation.scenarios import SCENARIOS
from worldpose.simulation.scene import simulate_scene
from worldpose.simulation.settings import ClickSettings


def played(name, duration, seed):
    scenario = SCENARIOS[name]
    rig = scenario.rig.model_copy(update={"cameras": 1})
    scenario = scenario.model_copy(update={"duration": duration, "rig": rig})
    return scenario, simulate_scene(scenario, seed)


def bearing_errors(found, true):
    """Angles between directions of image points, which no choice of principal point hides."""
    pixels = np.stack(np.meshgrid([200.0, 960.0, 1720.0], [120.0, 540.0, 960.0]), axis=-1)
    one, two = (c.camera.unproject(pixels.reshape(-1, 2)).directions for c in (found, true))
    return np.degrees(np.linalg.norm(one - two, axis=-1))


@pytest.mark.slow
@pytest.mark.parametrize("name", ["broadcast-pan", "broadcast-zoom"])
def test_a_clip_with_lines_and_players_is_known_to_centimetres_and_pixels(name):
    scenario, scene = played(name, 6.0, 4)
    painted, truth = PitchTemplate.from_spec(scenario.pitch), scene.broadcast
    joints = scene.truth.joints
    rng = np.random.default_rng(4)
    keys = click_key_frames(truth, painted, joints, ClickSettings(noise_px=1.0), 4, rng).key_frames
    pictures = [
        np.ascontiguousarray(picture[..., 1])
        for picture in render_broadcast(truth, painted, joints, 4)
    ]
    people = People(
        joints + 0.02 * rng.standard_normal(joints.shape),
        scene.observations["clip"].keypoints.astype(np.float64),
        scenario.fps,
    )
    found = calibrate_broadcast(
        PitchTemplate.from_spec(scene.surveyed),
        BroadcastClip(keys, lambda: iter(pictures), scenario.fps, people=people),
    )
    true = MovingCamera.of(truth, truth.center[0], truth.principal_point[0])
    camera = found.camera
    # The bars of a clip with lines in view in most frames.
    assert np.linalg.norm(camera.center - true.center) < 0.10
    assert np.median(np.abs(camera.focal / true.focal - 1.0)) < 0.002
    assert np.median(bearing_errors(camera, true)) < 0.02
    feet = joints[:, :, 15:17].mean(axis=2)
    seen = truth.project(feet)
    inside = ((seen > 0.0) & (seen < [1919.0, 1079.0])).all(axis=-1)
    off = np.linalg.norm(camera.camera.project(feet) - seen, axis=-1)[inside]
    assert np.median(off) < 1.0
    assert np.percentile(off, 95.0) < 3.0
    # The report's own expectation is of that size, neither a tenth nor ten times.
    ratio = np.nanmedian(found.report.reprojection_error) / np.median(off)
    assert 1.0 / 4.0 < ratio < 4.0
