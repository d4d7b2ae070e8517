"""Bystanders, shadows and surplus people are dropped, judged by whole people."""

import numpy as np
import pytest

from data_contracts.keypoints import KeypointDetections
from worldpose.geometry.cameras import Camera
from worldpose.geometry.rigid import Rigid
from worldpose.tracking.frame_tracker import FrameTracker
from worldpose.tracking.people_selection import (
    drop_bystanders,
    drop_shadows,
    join_people,
    limit_people,
    merge_duplicates,
)
from worldpose.tracking.person import Person, Sighting
from worldpose.tracking.settings import TrackingSettings

detections = KeypointDetections.from_keypoints

FRAMES, FULL_PITCH = 20, (105.0, 68.0)
BODY = np.stack([np.zeros(17), np.zeros(17), np.linspace(0.0, 1.7, 17)], axis=1)


def standing(x, y):
    """Return a person at a position [m], one or one per frame; NaN where rays give none."""
    person = Person(0, BODY, FRAMES - 1)
    for frame in range(FRAMES):
        place = [np.broadcast_to(each, FRAMES)[frame] for each in (x, y)]
        joints = BODY + [*place, 0.0 if np.isfinite(place).all() else np.nan]
        person.sightings[frame] = Sighting(np.zeros(2), np.zeros(2), joints)
    return person


def stays(person, margin=2.0, pitch=FULL_PITCH):
    return drop_bystanders([person], pitch, margin) == [person]


@pytest.mark.parametrize("side", [-1.0, 1.0])
def test_a_person_who_waits_behind_the_lines_is_a_bystander(side):
    assert stays(standing(0.0, side * 35.9))
    assert not stays(standing(0.0, side * 36.1))
    assert stays(standing(side * 54.4, 0.0))
    assert not stays(standing(side * 54.6, 0.0))
    assert not stays(standing(0.0, side * 35.9), margin=1.5)


def test_a_player_who_runs_over_the_line_stays():
    assert stays(standing(0.0, np.linspace(33.0, 40.0, FRAMES)))
    out = np.full(FRAMES, 40.0)
    out[-1] = 34.0
    assert stays(standing(0.0, out))


CAMERAS = 10


def shadow_track(number, views, x, frames=range(FRAMES), joints=17):
    """Return a track at `x` [m], one or one per frame; joints from `joints` on are unknown."""
    someone = Person(number, BODY, max(frames))
    places = np.broadcast_to(x, FRAMES)
    for frame in frames:
        body = BODY + [places[frame], 0.0, 0.0]
        body[joints:] = np.nan
        index = np.where(np.arange(CAMERAS) < views, 0, -1)
        someone.sightings[frame] = Sighting(index, np.full(CAMERAS, 0.02), body)
    return someone


def kept(*people, distance=0.5):
    return [person.number for person in drop_shadows(list(people), distance)]


def test_a_track_next_to_a_better_seen_person_is_a_shadow():
    assert kept(shadow_track(0, 10, 0.0), shadow_track(1, 2, 0.2)) == [0]
    assert kept(shadow_track(0, 10, 0.0), shadow_track(1, 2, 0.2), distance=0.0) == [0, 1]


def test_a_neighbour_seen_by_half_as_many_cameras_stays():
    assert kept(shadow_track(0, 10, 0.0), shadow_track(1, 5, 0.2)) == [0, 1]
    assert kept(shadow_track(0, 5, 0.0), shadow_track(1, 2, 0.2)) == [0]


def test_a_track_in_few_cameras_stays_if_it_stands_apart():
    assert kept(shadow_track(0, 10, 0.0), shadow_track(1, 2, 0.6)) == [0, 1]


@pytest.mark.parametrize(("near", "left"), [(14, [0]), (13, [0, 1])])
def test_seven_tenths_of_the_time_decide(near, left):
    way = np.where(np.arange(FRAMES) < near, 0.1, 3.0)
    assert kept(shadow_track(0, 10, 0.0), shadow_track(1, 2, way)) == left


def person(number, first, last, evidence):
    nothing = Sighting(np.empty(0, int), np.empty(0), np.empty((0, 3)))
    someone = Person(number, np.empty((0, 3)), last, evidence=evidence)
    someone.sightings.update({first: nothing, last: nothing})
    return someone


def test_weakest_of_too_many_at_once_goes():
    people = [
        person(0, 0, 9, 9.0),
        person(1, 0, 4, 4.0),
        person(2, 3, 9, 5.0),
        person(3, 6, 9, 1.0),
    ]
    kept = limit_people(people, 2)
    assert [each.number for each in kept] == [0, 2]
    assert limit_people(people, None) == people
    assert limit_people([], 2) == []


FPS, PITCH = 50.0, (20.0, 20.0)


def track(number, frames, x, y=0.0, views=CAMERAS):
    """Return a track over a time span [s] at a position [m], one or one per frame."""
    frames = range(*(round(FPS * second) for second in frames))
    x, y = np.broadcast_to(x, len(frames)), np.broadcast_to(y, len(frames))
    someone = Person(number, BODY, frames[-1], fixed=len(frames), evidence=float(len(frames)))
    index = np.where(np.arange(CAMERAS) < views, 0, -1)
    for n, frame in enumerate(frames):
        joints = BODY + [x[n], y[n], 0.0]
        someone.sightings[frame] = Sighting(index, np.full(CAMERAS, 0.02), joints)
    return someone


def found(*tracks, people=None, **changed):
    """Return the numbers of the tracks of each person."""
    cameras = Camera.stack(
        [
            Camera(
                focal=np.full(2, 1500.0),
                principal_point=np.zeros(2),
                distortion=np.zeros(5),
                cam_from_world=Rigid(np.eye(3), np.zeros(3)),
                image_size=np.array([1920, 1080]),
            )
        ]
        * CAMERAS
    )
    tracker = FrameTracker(cameras, FPS, True, people, TrackingSettings(**changed))
    tracker.born, tracker.low, tracker.high = 1, np.full(2, -10.0), np.full(2, 10.0)
    _, chains = join_people(list(tracks), tracker, PITCH)
    return sorted([part.number for part in chain] for chain in chains)


def fetching(back=True):
    """Return tracks of a player who leaves at 2 m/s, unseen on the line, and returns in 5 s."""
    out = np.interp(np.arange(100), [0, 50, 100], [12.2, 13.5, 12.2])
    parts = [track(0, (0, 1), 0.0, np.linspace(8.0, 10.0, 50)), track(1, (2, 4), 0.0, out)]
    return [*parts, track(2, (5, 6), 0.0, np.linspace(10.0, 8.0, 50))][: 3 if back else 2]


def test_a_player_who_fetches_the_ball_keeps_all_tracks():
    assert found(*fetching()) == [[0, 1, 2]]


def duel():
    """Return two people together for two seconds, in which few cameras see the second one."""
    come, go = np.linspace(2.5, 0.4, 50), np.linspace(0.4, 2.5, 50)
    parts = [track(1, (0, 1), come), track(2, (1.4, 3.4), 0.4, views=3), track(3, (3.8, 4.8), go)]
    return track(0, (0, 5), 0.0), *parts


def test_a_duel_that_few_cameras_see_is_the_players():
    assert found(*duel()) == [[0], [1, 2, 3]]


def test_a_shadow_breaks_no_join_of_accepted_tracks():
    person, after = track(0, (0, 7), 0.0), track(3, (5.8, 6.8), np.linspace(0.4, 2.5, 50))
    before = track(1, (0, 3), np.interp(np.arange(150), [0, 130], [4.0, 0.4]))
    # It begins where the other stopped, and is still there when the player is back.
    shadow = track(2, (3.1, 6.2), 0.4, views=3)
    assert found(person, before, shadow, after) == [[0], [1, 3]]


def in_cameras(person, cameras):
    """Return the track with detections in these cameras alone."""
    for frame, sighting in person.sightings.items():
        index = np.where(np.isin(np.arange(CAMERAS), cameras), sighting.index, -1)
        person.sightings[frame] = Sighting(index, sighting.ray_distance, sighting.joints)
    return person


LEFT, RIGHT = np.arange(CAMERAS)[: CAMERAS // 2], np.arange(CAMERAS)[CAMERAS // 2 :]


@pytest.mark.parametrize(("near", "left"), [(0.7, [0]), (0.68, [0, 1])])
def test_a_track_at_another_in_seven_tenths_of_its_frames_is_the_same_person(near, left):
    first = in_cameras(track(0, (0, 3), 0.0), LEFT)
    second = in_cameras(track(1, (1, 2), np.where(np.arange(50) < near * 50, 0.19, 0.3)), RIGHT)
    people, merged = merge_duplicates([first, second], distance=0.2)
    assert [person.number for person in people] == left
    assert merged == 2 - len(left)


def test_the_longer_track_takes_over_detections_that_it_lacks():
    short, long = track(0, (1, 2), 0.1), track(1, (0, 3), 0.0)
    short, long = in_cameras(short, RIGHT), in_cameras(long, LEFT)
    assert merge_duplicates([short, long], distance=0.2) == ([long], 1)
    views = [np.count_nonzero(long.sightings[frame].index >= 0) for frame in (49, 50, 99, 100)]
    assert views == [len(LEFT), CAMERAS, CAMERAS, len(LEFT)]
    np.testing.assert_allclose(long.sightings[60].joints, BODY, atol=1e-6)


def test_two_people_whom_a_camera_shows_at_once_are_no_duplicates():
    first, second = track(0, (0, 3), 0.0), track(1, (1, 2), 0.1)
    second = in_cameras(second, np.append(RIGHT, LEFT[0]))
    tracks = [in_cameras(first, LEFT), second]
    assert merge_duplicates(tracks, distance=0.2) == (tracks, 0)
