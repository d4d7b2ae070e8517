"""Who follows somebody about in a few of the cameras that see him is no person."""

import numpy as np
import pytest

from worldpose.tracking.person import Person
from worldpose.tracking.shadows import without_shadows
from worldpose.tracking.sightings import Sighting

FRAMES, CAMERAS = 20, 10
BODY = np.stack([np.zeros(17), np.zeros(17), np.linspace(0.0, 1.7, 17)], axis=1)


def track(number, views, x, frames=range(FRAMES), joints=17):
    """Somebody at `x` [m], one place or one a frame, whose last joints are not determined."""
    someone = Person(number, BODY, max(frames))
    places = np.broadcast_to(x, FRAMES)
    for frame in frames:
        body = BODY + [places[frame], 0.0, 0.0]
        body[joints:] = np.nan
        index = np.where(np.arange(CAMERAS) < views, 0, -1)
        someone.sightings[frame] = Sighting(index, np.full(CAMERAS, 0.02), body)
    return someone


def kept(*people, distance=0.5):
    return [person.number for person in without_shadows(list(people), distance)]


def test_who_is_beside_a_better_seen_person_goes():
    assert kept(track(0, 10, 0.0), track(1, 2, 0.2)) == [0]
    assert kept(track(0, 10, 0.0), track(1, 2, 0.2), distance=0.0) == [0, 1]


def test_a_neighbour_seen_by_half_as_many_cameras_stays():
    assert kept(track(0, 10, 0.0), track(1, 5, 0.2)) == [0, 1]
    assert kept(track(0, 5, 0.0), track(1, 2, 0.2)) == [0]


def test_who_is_seldom_seen_and_stands_apart_stays():
    assert kept(track(0, 10, 0.0), track(1, 2, 0.6)) == [0, 1]


@pytest.mark.parametrize(("near", "who"), [(14, [0]), (13, [0, 1])])
def test_seven_tenths_of_the_time_decide(near, who):
    way = np.where(np.arange(FRAMES) < near, 0.1, 3.0)
    assert kept(track(0, 10, 0.0), track(1, 2, way)) == who


def test_a_shadow_that_changes_from_one_person_to_another_goes():
    way = np.where(np.arange(FRAMES) < 10, 0.1, 1.9)
    assert kept(track(0, 10, 0.0), track(1, 2, way), track(2, 10, 2.0)) == [0, 2]


def test_only_frames_and_joints_of_both_are_compared():
    late = track(1, 2, 0.1, range(15, 20), joints=9)
    assert kept(track(0, 10, 0.0, range(10)), late) == [0, 1]
    assert kept(track(0, 10, 0.0), late) == [0]


def test_without_a_place_nobody_is_a_shadow():
    assert kept(track(0, 10, 0.0), track(1, 1, 0.0, joints=0)) == [0, 1]
    assert kept() == []
