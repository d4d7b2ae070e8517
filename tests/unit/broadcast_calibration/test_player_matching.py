"""Matching of projected and detected people, and the noise that residuals show."""

import numpy as np
import pytest
import turning_clip as clip

from worldpose.broadcast_calibration.players import (
    People,
    estimate_feed_offset,
    match,
    player_evidence,
    similarity,
)
from worldpose.broadcast_calibration.settings import BroadcastCalibrationSettings
from worldpose.errors import InputError


def figure():
    """Seventeen points on two lines, 10 wide and 40 high."""
    points = np.zeros((17, 2))
    points[:, 0] = np.where(np.arange(17) % 2 == 1, 0.0, 10.0)
    points[:, 1] = np.linspace(0.0, 40.0, 17)
    return points


def test_people_are_as_alike_as_their_common_joints_say():
    upright, few = figure(), figure()
    upside_down = upright.max(axis=0) + upright.min(axis=0) - upright
    few[5:] = np.nan
    found = similarity(upright[None], np.stack([upright, upside_down, few]))
    assert found[0] == pytest.approx([1.0, -1.0, 0.0])


def standing():
    """Joints of an upright person with slightly spread arms, nearly COCO's points [m]."""
    sides = np.array(
        [[0.0, 0.03, -0.03, 0.07, -0.07, 0.2, -0.2, 0.3, -0.3, 0.32, -0.32, 0.12, -0.12]]
    )
    across = np.append(sides, [0.13, -0.13, 0.15, -0.15])
    height = [1.65, 1.7, 1.7, 1.68, 1.68, 1.45, 1.45, 1.15, 1.15, 0.9, 0.9, 0.95, 0.95]
    height += [0.5, 0.5, 0.08, 0.08]
    return np.stack([across, 0.1 * np.sin(np.arange(17.0)), height], axis=-1)


def crowd(frames, rng, noise):
    """People standing on the pitch, seen by a moving camera in another order."""
    camera = clip.moving(frames)
    places = [(-3.0, -6.0), (2.0, 4.0), (6.0, -3.0), (-8.0, 8.0)]
    joints = np.stack([standing() + [x, y, 0.0] for x, y in places])
    joints = np.broadcast_to(joints, (frames, *joints.shape))
    pixels = camera.camera.project(joints.reshape(frames, -1, 3)).reshape(frames, 4, 17, 2)
    seen = pixels[:, [2, 0, 3, 1]]
    return camera, People(joints, seen + noise * rng.standard_normal(seen.shape), 50.0)


def test_people_are_found_whatever_their_order():
    camera, people = crowd(5, np.random.default_rng(1), 0.5)
    pairs = match(camera, people)
    assert len(pairs.frame) == 20
    assert (np.array([2, 0, 3, 1])[pairs.detection] == pairs.person).all()


def test_noise_is_learned_as_a_share_of_height():
    camera, people = crowd(60, np.random.default_rng(2), 1.0)
    pairs = match(camera, people)
    evidence, noise = player_evidence(camera, people, pairs, BroadcastCalibrationSettings())
    tall = np.nanmean(people.boxes[..., 3] - people.boxes[..., 1])
    # 8,000 residuals; the height itself has the noise.
    assert noise.share == pytest.approx(1.0 / tall, rel=0.1)
    assert noise.frames == pytest.approx(1.0, abs=0.2)
    assert len(evidence) == 60 * 4 * 17


def test_errors_that_last_are_noticed():
    rng = np.random.default_rng(3)
    camera, people = crowd(100, rng, 0.0)
    slow = np.repeat(rng.standard_normal((10, 4, 17, 2)), 10, axis=0)
    people = People(people.joints, people.keypoints + slow, 50.0)
    _, noise = player_evidence(
        camera, people, match(camera, people), BroadcastCalibrationSettings()
    )
    # Steps of ten frames: the triangle of their autocorrelation has an area of ten.
    assert noise.frames == pytest.approx(10.0, rel=0.2)


def test_joints_and_keypoints_of_other_frames_are_refused():
    with pytest.raises(InputError, match="same frames"):
        People(np.zeros((3, 1, 17, 3)), np.zeros((2, 1, 17, 2)), 50.0)


def test_nobody_is_matched_with_nobody():
    camera, people = crowd(5, np.random.default_rng(4), 0.5)
    nobody = People(people.joints[:, :0], people.keypoints, 50.0)
    pairs = match(camera, nobody)
    assert len(pairs.frame) == 0
    evidence, noise = player_evidence(camera, nobody, pairs, BroadcastCalibrationSettings())
    assert len(evidence) == 0
    assert noise.frames == 1.0
    assert not estimate_feed_offset(camera, nobody, reach=2.0).determined
