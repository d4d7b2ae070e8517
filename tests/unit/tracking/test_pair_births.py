"""People in exactly two cameras: evidence for and against a pair of detections."""

import numpy as np
import pytest

from data_contracts.keypoints import KeypointDetections
from worldpose.geometry.cameras import Camera
from worldpose.geometry.rigid import Rigid
from worldpose.tracking.diagnosis import diagnose_no_people
from worldpose.tracking.pair_births import (
    CameraGates,
    CameraVisibility,
    find_uncovered_bodies,
    group_pairs,
    judge_pairs,
)
from worldpose.tracking.settings import TrackingSettings

detections = KeypointDetections.from_keypoints

SETTINGS = TrackingSettings()
FPS = 25.0


def rig(*centers, focal=1500.0):
    """Cameras at places [m] that look at the point 1 m over the origin, 1920 x 1080."""
    cameras = []
    for center in np.asarray(centers, dtype=float):
        forward = np.array([0.0, 0.0, 1.0]) - center
        forward /= np.linalg.norm(forward)
        right = np.cross(forward, [0.0, 0.0, 1.0])
        right /= np.linalg.norm(right)
        rotation = np.stack([right, np.cross(forward, right), forward])
        cameras.append(
            Camera(
                focal=np.full(2, focal),
                principal_point=np.array([960.0, 540.0]),
                distortion=np.zeros(5),
                cam_from_world=Rigid(rotation, -rotation @ center),
                image_size=np.array([1920, 1080]),
            )
        )
    return Camera.stack(cameras)


HIGH = ((-12.0, 0.0, 9.0), (0.0, -12.0, 9.0))
LOW = ((-30.0, 0.0, 1.0), (0.0, -30.0, 1.0))
THIRD = (12.0, 12.0, 9.0)


def rays_of(cameras, joints, show=None):
    """Directions and weights (cameras, people, 17) of people (people, 17, 3).

    `show` (cameras, people) tells which camera detects which person; None = all.
    """
    offsets = joints[None] - cameras.center[:, None, None]
    directions = offsets / np.linalg.norm(offsets, axis=-1, keepdims=True)
    weights = np.ones(directions.shape[:-1])
    if show is not None:
        weights[~np.asarray(show, dtype=bool)] = 0.0
        directions[~np.asarray(show, dtype=bool)] = np.nan
    return directions, weights


def judge(cameras, directions, weights, visibility=None, ground=True):
    visibility = CameraVisibility(cameras) if visibility is None else visibility
    gates = CameraGates(len(visibility.centers))
    return judge_pairs(directions, weights, visibility, gates, ground, SETTINGS, everything=weights)


def test_two_high_cameras_keep_two_people_apart_from_their_two_ghosts(people):
    # The rays of two views of two people meet at four places, the ghosts metres apart in height.
    cameras = rig(*HIGH)
    directions, weights = rays_of(cameras, people([[-1.5, 0.5], [1.5, 1.0]]))
    pairs = judge(cameras, directions, weights)
    groups = group_pairs(pairs, weights, SETTINGS)
    assert sorted(tuple(group.index) for group in groups) == [(0, 0), (1, 1)]
    for group in groups:
        assert pairs.odds[pairs.find(group.index)] > SETTINGS.pair_odds
        truth = people([[-1.5, 0.5], [1.5, 1.0]])[group.index[0]]
        np.testing.assert_allclose(group.joints, truth, atol=1e-6)


def test_cameras_at_eye_level_cannot_tell_people_from_ghosts(people):
    # All joints are on one level with both cameras, nearly: every ray meets every other.
    cameras = rig(*LOW)
    directions, weights = rays_of(cameras, people([[-0.8, -0.8], [0.8, 0.8]]))
    pairs = judge(cameras, directions, weights)
    assert len(pairs.odds) == 4
    assert not pairs.unique.any() and (pairs.odds < 1.0).all()
    assert group_pairs(pairs, weights, SETTINGS) == []


def known_sight(cameras, frames=98):
    """Statistics of cameras that detected a person everywhere in view, in every frame."""
    visibility = CameraVisibility(cameras)
    visibility.reach[:] = 40.0
    visibility.shown[:], visibility.missed[:] = frames, 0.0
    return visibility


def test_camera_that_should_see_a_person_and_shows_nothing_is_evidence_against(people):
    # Missed once in a hundred times (Laplace's rule: 1 / (98 + 2)).
    cameras = rig(*HIGH, THIRD)
    body = people([[0.0, 0.0]])
    missed = rays_of(cameras, body, [[1], [1], [0]])
    two = rig(*HIGH)
    free = judge(two, *rays_of(two, body)).odds[0]
    judged = judge(cameras, *missed, known_sight(cameras))
    assert judged.odds[0] == pytest.approx(free / 100.0, rel=1e-6)
    # A camera of which nothing is known, or that showed people only nearer, says nothing.
    assert judge(cameras, *missed).odds[0] == pytest.approx(free, rel=1e-6)


def test_detection_that_lies_on_the_person_excuses_a_camera(people):
    # The third camera sees one person before the other: on its line of visibility, 3 m nearer.
    cameras = rig(*HIGH, THIRD)
    body = people([[0.0, 0.0]])
    toward = np.array(THIRD) - [0.0, 0.0, 1.0]
    before = body + 0.1 * toward * [1.0, 1.0, 1.0]
    directions, weights = rays_of(cameras, np.concatenate([body, before]), [[1, 0], [1, 0], [0, 1]])
    everywhere = np.ones((3, 1), dtype=bool)
    uncovered = find_uncovered_bodies(everywhere, body, cameras.center, directions, weights)
    assert uncovered[:, 0].tolist() == [False, False, False]
    # A detection covers less than all of a body 3 m aside, and only in the cameras asked about.
    aside, asked = body + [3.0, 3.0, 0.0], np.array([[True], [False], [True]])
    uncovered = find_uncovered_bodies(asked, aside, cameras.center, directions, weights)
    assert uncovered[:, 0].tolist() == [True, False, True]
    two = rig(*HIGH)
    judged = judge(cameras, directions, weights, known_sight(cameras))
    pair = judged.find(np.array([0, 0, -1]))
    free = judge(two, *rays_of(two, body)).odds[0]
    assert judged.odds[pair] == pytest.approx(free, rel=0.05)


def test_sight_learns_how_often_a_camera_misses_and_how_far_it_sees(people):
    cameras = rig(*HIGH, THIRD)
    visibility = CameraVisibility(cameras)
    body = people([[0.0, 0.0]])
    for frame in range(10):
        show = [[1], [1], [frame % 2]]
        directions, weights = rays_of(cameras, body, show)
        visibility.learn(body, directions, weights, np.array(show, dtype=bool))
    middle = body.mean(axis=1)[0]
    np.testing.assert_allclose(visibility.reach, np.linalg.norm(cameras.center - middle, axis=1))
    # Until frame 1 the third had no detection, so frame 0 does not count.
    assert visibility.shown.tolist() == [10, 10, 9]
    assert visibility.missed.tolist() == [0, 0, 4]


def picture(cameras, joints, show):
    """Keypoints and confidence (frames, cameras, people, 17) of people that are shown."""
    frames, count = joints.shape[:2]
    keypoints = cameras.project(joints.reshape(frames, 1, -1, 3)).reshape(frames, -1, count, 17, 2)
    keypoints[:, ~np.asarray(show, dtype=bool)] = np.nan
    return keypoints, np.full(keypoints.shape[:-1], 0.9)


def test_people_whom_two_cameras_cannot_tell_apart_are_the_stated_reason(people):
    cameras = rig(*LOW)
    joints = people(np.broadcast_to([[-0.8, -0.8], [0.8, 0.8]], (4, 2, 2)))
    both = detections(*picture(cameras, joints, np.ones((2, 2))))
    given = (cameras, ["left", "right"], both, FPS, SETTINGS)
    reason = diagnose_no_people(*given, ground=True, births=0)
    assert reason.cause == "ambiguous_pairs"
    assert "detections of left and right fit each other in several ways" in reason.message
