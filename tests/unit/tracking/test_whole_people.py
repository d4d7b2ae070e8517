"""A stretch of somebody is judged by the whole of him: off the pitch, and in duels."""

import numpy as np
import pytest

from worldpose.geometry import Camera, Rigid
from worldpose.tracking import TrackingSettings, track_people
from worldpose.tracking.following import Follower
from worldpose.tracking.person import Person
from worldpose.tracking.sightings import Sighting
from worldpose.tracking.whole_people import join_people

FPS, CAMERAS, PITCH = 50.0, 10, (20.0, 20.0)
BODY = np.stack([np.zeros(17), np.zeros(17), np.linspace(0.0, 1.7, 17)], axis=1)


def track(number, frames, x, y=0.0, views=CAMERAS):
    """Somebody in some frames [s] at a place [m], one or one a frame."""
    frames = range(*(round(FPS * second) for second in frames))
    x, y = np.broadcast_to(x, len(frames)), np.broadcast_to(y, len(frames))
    someone = Person(number, BODY, frames[-1], fixed=len(frames), evidence=float(len(frames)))
    index = np.where(np.arange(CAMERAS) < views, 0, -1)
    for n, frame in enumerate(frames):
        joints = BODY + [x[n], y[n], 0.0]
        someone.sightings[frame] = Sighting(index, np.full(CAMERAS, 0.02), joints)
    return someone


def found(*tracks, people=None, **changed):
    """Numbers of the tracks of each person."""
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
    follower = Follower(cameras, FPS, True, people, TrackingSettings(**changed))
    follower.born, follower.low, follower.high = 1, np.full(2, -10.0), np.full(2, 10.0)
    _, chains = join_people(list(tracks), follower, PITCH)
    return sorted([part.number for part in chain] for chain in chains)


def fetching(back=True):
    """Walks off at 2 m/s, unseen on the line, and is back five seconds later."""
    out = np.interp(np.arange(100), [0, 50, 100], [12.2, 13.5, 12.2])
    parts = [track(0, (0, 1), 0.0, np.linspace(8.0, 10.0, 50)), track(1, (2, 4), 0.0, out)]
    return [*parts, track(2, (5, 6), 0.0, np.linspace(10.0, 8.0, 50))][: 3 if back else 2]


def test_who_fetches_the_ball_is_there_all_the_time():
    assert found(*fetching()) == [[0, 1, 2]]


def test_who_is_off_the_pitch_when_the_clip_ends_is_a_player():
    assert found(*fetching(back=False)) == [[0, 1]]


def test_who_is_never_on_the_pitch_goes_with_all_his_stretches():
    away = [track(n, (2 * n, 2 * n + 1), -8.0, 12.5) for n in (3, 4, 5)]
    assert found(*fetching(), *away) == [[0, 1, 2]]


def duel():
    """Two together for two seconds, in which few cameras see the one who comes and goes."""
    come, go = np.linspace(2.5, 0.4, 50), np.linspace(0.4, 2.5, 50)
    parts = [track(1, (0, 1), come), track(2, (1.4, 3.4), 0.4, views=3), track(3, (3.8, 4.8), go)]
    return track(0, (0, 5), 0.0), *parts


def test_a_duel_that_few_cameras_see_is_the_players():
    assert found(*duel()) == [[0], [1, 2, 3]]


def test_a_shadow_in_several_stretches_goes():
    person = track(0, (0, 6), 0.0)
    shadows = [track(n, (2 * n - 2, 2 * n - 1), 0.2, views=2) for n in (1, 2, 3)]
    assert found(person, *shadows) == [[0]]
    assert len(found(person, *shadows, shadow_distance=0.0)) > 1


def test_a_stretch_apart_does_not_save_a_shadow():
    # In seven tenths of the whole there is somebody beside him.
    apart = track(1, (0, 0.5), np.linspace(1.4, 0.6, 25), views=2)
    assert found(track(0, (0, 6), 0.0), apart, track(2, (0.6, 3.6), 0.3, views=2)) == [[0], [1]]


def test_a_shadow_takes_nobody_from_who_goes_on():
    person, after = track(0, (0, 7), 0.0), track(3, (5.8, 6.8), np.linspace(0.4, 2.5, 50))
    before = track(1, (0, 3), np.interp(np.arange(150), [0, 130], [4.0, 0.4]))
    # It goes on where the other stopped, and is still there when he is back.
    shadow = track(2, (3.1, 6.2), 0.4, views=3)
    assert found(person, before, shadow, after) == [[0], [1, 3]]


def test_a_roster_counts_whole_people():
    assert found(*duel(), people=2) == [[0], [1, 2, 3]]


@pytest.mark.parametrize("margin", [2.0, 1e3])
def test_tracking_keeps_who_fetches_the_ball(ring, people, seen, margin):
    seconds = np.arange(0.0, 6.0, 1.0 / FPS)
    y = np.interp(seconds, [0.0, 1.0, 2.0, 3.0, 4.0, 5.0], [8.0, 10.0, 12.2, 13.4, 12.2, 10.0])
    places = np.stack([np.zeros_like(y), y], axis=-1)[:, None]
    keypoints, confidence = seen(ring(5), people(places))
    unseen = ((seconds > 1.0) & (seconds < 2.0)) | ((seconds > 4.0) & (seconds < 5.0))
    keypoints[unseen] = np.nan
    settings = TrackingSettings(pitch_margin_m=margin)
    result = track_people(ring(5), keypoints, confidence, FPS, settings, pitch_size=PITCH)
    assert len(result.tracks) == 1
    assert result.tracks[0].frames_seen == np.count_nonzero(~unseen)
    assert result.report.dropped == 0
