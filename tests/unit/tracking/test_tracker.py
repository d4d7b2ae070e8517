import numpy as np
import pytest

from data_contracts.keypoints import KeypointDetections
from worldpose.tracking.settings import TrackingSettings
from worldpose.tracking.tracker import track_people

detections = KeypointDetections.from_keypoints

SETTINGS = TrackingSettings()
FPS = 50.0
PLACES = np.array([[0.0, 0.0], [0.9, 0.2], [-3.0, 2.0], [4.0, -3.0]])


def still(people, frames=20, places=PLACES):
    return people(np.broadcast_to(places, (frames, *places.shape)))


def owners(tracking):
    """The detection that each track holds everywhere it holds one: n is person n."""
    index = tracking.detection_index
    values = [np.unique(index[:, :, n][index[:, :, n] >= 0]) for n in range(index.shape[2])]
    assert all(len(value) == 1 for value in values)
    return [int(value[0]) for value in values]


@pytest.mark.parametrize("shape", [(0, 4, 3), (5, 4, 0)])
def test_nothing_to_see_gives_no_tracks(ring, shape):
    keypoints = np.full((*shape, 17, 2), np.nan)
    result = track_people(
        ring(4), detections(keypoints, np.full((*shape, 17), np.nan)), FPS, SETTINGS
    )
    assert result.detection_index.shape == (shape[0], 4, 0)
    assert (result.joints.shape, result.tracks) == ((shape[0], 0, 17, 3), ())
    assert result.report.unmatched_share is None
    assert result.report.mean_ray_distance_m is None


def test_everyone_is_followed_in_every_camera(ring, people, seen):
    result = track_people(ring(5), detections(*seen(ring(5), still(people))), FPS, SETTINGS)
    assert sorted(owners(result)) == [0, 1, 2, 3]
    assert (result.detection_index >= 0).all()
    assert result.detection_index.dtype == np.int16
    assert result.ray_distance.dtype == result.joints.dtype == np.float32
    # 1 px is 2 cm at 30 m; the mean length of two such axes is 2.5 cm.
    assert 0.01 < result.ray_distance.mean() < 0.03
    truth = people(PLACES)[owners(result)]
    # Five views of 2 cm, 20400 coordinates: 4.5 standard deviations of 2 cm / sqrt(2.5).
    np.testing.assert_allclose(result.joints, np.broadcast_to(truth, (20, 4, 17, 3)), atol=0.06)
    assert result.person.tolist() == [0, 1, 2, 3]
    for track in result.tracks:
        assert (track.first_frame, track.last_frame, track.frames_seen) == (0, 19, 20)
        assert track.views == 5.0
    report = result.report
    assert (report.births, report.losses, report.dropped, report.merged) == (4, 0, 0, 0)
    assert (report.detections, report.unmatched_share) == (400, 0.0)


@pytest.mark.parametrize("fps", [12.5, 50.0])
def test_people_who_cross_keep_their_identity(ring, people, seen, fps):
    # Two run at each other at 6 m/s and pass at 0.6 m, shoulder to shoulder.
    time = np.arange(-1.0, 1.0, 1 / fps)
    places = np.stack(
        [np.stack([6 * time, 0 * time], -1), np.stack([-6 * time, 0 * time + 0.6], -1)], axis=1
    )
    result = track_people(ring(6), detections(*seen(ring(6), people(places))), fps, SETTINGS)
    assert sorted(owners(result)) == [0, 1]
    assert (result.detection_index >= 0).all()


def test_prediction_carries_a_sprinter_through_a_low_frame_rate(ring, people, seen):
    # From standing to 8 m/s at 5 m/s^2, at 10 frames per second: in the end 0.8 m per frame, beyond
    # the gate, but the change from frame to frame is 5 cm.
    time = np.arange(0.0, 2.4, 0.1)
    run = np.where(time < 1.6, 2.5 * time**2, 6.4 + 8.0 * (time - 1.6)) - 7.0
    keypoints, confidence = seen(ring(6), people(np.stack([run, 0 * run], -1)[:, None]))
    moving = track_people(ring(6), detections(keypoints, confidence), 10.0, SETTINGS)
    assert len(moving.tracks) == 1
    assert (moving.detection_index >= 0).all()
    at_rest = SETTINGS.model_copy(update={"predict_motion": False})
    resting = track_people(ring(6), detections(keypoints, confidence), 10.0, at_rest)
    assert (resting.detection_index[-5:] < 0).any()


def test_lost_person_is_found_again_under_the_same_identity(ring, people, seen):
    # 1 m/s to and fro, unseen for 0.8 s.
    time = np.arange(0, 3.0, 1 / FPS)
    places = np.stack([np.stack([np.sin(time), 0 * time], -1)], axis=1)
    keypoints, confidence = seen(ring(5), people(places))
    keypoints[50:90] = np.nan
    result = track_people(ring(5), detections(keypoints, confidence), FPS, SETTINGS)
    assert (len(result.tracks), result.tracks[0].frames_seen) == (1, 110)
    assert (result.detection_index[50:90] == -1).all()
    assert np.isnan(result.joints[50:90]).all()
    assert np.isnan(result.ray_distance[50:90]).all()


def test_ghosts_of_two_people_in_two_cameras_make_no_tracks(ring, people, seen):
    # Two views of two people meet at four places; two of them are empty.
    camera = ring(5)[np.array([0, 1])]
    places = np.array([[-1.5, 0.5], [1.5, 1.0]])
    result = track_people(
        camera, detections(*seen(camera, still(people, 40, places))), FPS, SETTINGS
    )
    assert (sorted(owners(result)), result.report.births) == ([0, 1], 2)


def test_join_that_may_be_either_way_is_left_to_review(ring, people, seen):
    # Two people face each other, are unseen for 1 s, and stand across: each may be either.
    places = np.zeros((100, 2, 2))
    places[:30] = [[-0.8, 0.0], [0.8, 0.0]]
    places[80:] = [[0.0, -0.8], [0.0, 0.8]]
    keypoints, confidence = seen(ring(5), people(places))
    keypoints[30:80] = np.nan
    result = track_people(ring(5), detections(keypoints, confidence), FPS, SETTINGS)
    assert len(result.tracks) == 4
    assert result.report.undecided == len(result.joins) == 2
    assert {(join.before, join.after) for join in result.joins} in (
        {(0, 2), (1, 3)},
        {(0, 3), (1, 2)},
    )
    for join in result.joins:
        assert not join.decided
        assert join.margin < np.log(SETTINGS.join_odds)
    assert result.joins[0].cost >= result.joins[1].cost


def test_person_whom_a_camera_loses_is_not_carried_away_by_a_neighbour(ring, people, seen):
    # Two cameras follow a person; then the second sees only a neighbour 0.45 m away, within
    # the gate: its ray misses the other camera's by more than two views of one body do.
    places = np.broadcast_to([[0.0, 0.0], [0.0, 0.45]], (40, 2, 2))
    camera = ring(2)
    keypoints, confidence = seen(camera, people(places), noise=0.5)
    keypoints[:, :, 1] = np.nan
    alone = track_people(camera, detections(keypoints, confidence), FPS, SETTINGS)
    assert owners(alone) == [0]
    keypoints, confidence = seen(camera, people(places), noise=0.5)
    keypoints[:, 0, 1] = np.nan
    keypoints[:20, 1, 1] = np.nan
    keypoints[20:, 1, 0] = np.nan
    taken = track_people(camera, detections(keypoints, confidence), FPS, SETTINGS)
    together = (taken.detection_index[20:] >= 0).all(axis=1)
    assert not together.any()


def test_one_camera_alone_follows_a_person_through_a_turn(ring, people, seen):
    # Walks to and fro at 1 m/s; from 0.5 to 1.2 s the first camera alone sees it.
    time = np.arange(0, 2.0, 1 / FPS)
    places = np.stack([0 * time, 0.5 * np.abs(2.0 * ((time + 0.2) % 1.0) - 1.0)], -1)[:, None]
    keypoints, confidence = seen(ring(3), people(places))
    keypoints[25:60, 1:] = np.nan
    result = track_people(ring(3), detections(keypoints, confidence), FPS, SETTINGS)
    assert result.report.births == 1
    assert (result.detection_index[:, 0, 0] == 0).all()
    assert np.isnan(result.joints[25:60]).all()
    assert (result.detection_index[60:] == 0).all()


def test_camera_that_shows_a_neighbour_for_a_while_is_left_out(ring, people, seen):
    # Three cameras follow a person; then the third sees only a neighbour 0.5 m behind, whose rays
    # pass the person within the gate.
    camera = ring(3)
    behind = -0.5 * camera.center[2, :2] / np.linalg.norm(camera.center[2, :2])
    places = np.broadcast_to([[0.0, 0.0], behind], (60, 2, 2))
    keypoints, confidence = seen(camera, people(places), noise=0.5)
    keypoints[:, :2, 1] = np.nan
    keypoints[:20, 2, 1] = np.nan
    keypoints[20:, 2, 0] = np.nan
    tracked = track_people(camera, detections(keypoints, confidence), FPS, SETTINGS)
    assert (tracked.detection_index[:, :2, 0] == 0).all()
    assert (tracked.detection_index[:20, 2, 0] == 0).all()
    assert (tracked.detection_index[40:, 2, 0] == -1).all()
    # 1 px is 2 cm: two views place the mean of 17 joints to some millimetres.
    away = tracked.joints[40:, 0].mean(axis=1) - people(places[40:])[:, 0].mean(axis=1)
    assert np.linalg.norm(away, axis=-1).max() < 0.02


def test_a_fall_is_followed_though_it_leaves_the_prediction(ring, people, seen):
    # From running at 6 m/s to lying still within 0.3 s, in a low camera rig.
    time = np.arange(0.0, 2.0, 1 / FPS)
    slowed = np.clip(time - 1.0, 0.0, 0.3)
    along = 6.0 * np.minimum(time, 1.0) + 6.0 * slowed - 10.0 * slowed**2
    joints = people(np.stack([along, 0 * along], -1)[:, None])
    tilt = np.clip((time - 1.0) / 0.3, 0.0, 1.0)[:, None] * np.pi / 2
    height = joints[:, 0, :, 2].copy()
    joints[:, 0, :, 0] += np.sin(tilt) * height
    joints[:, 0, :, 2] = np.cos(tilt) * height + 0.1
    result = track_people(ring(4), detections(*seen(ring(4), joints)), FPS, SETTINGS)
    assert owners(result) == [0]
    assert (result.detection_index >= 0).all()
