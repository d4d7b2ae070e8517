"""Who is never on the pitch or near it is no player."""

import numpy as np
import pytest

from worldpose.tracking.bystanders import without_bystanders
from worldpose.tracking.person import Person
from worldpose.tracking.sightings import Sighting

FRAMES, PITCH = 20, (105.0, 68.0)
BODY = np.stack([np.zeros(17), np.zeros(17), np.linspace(0.0, 1.7, 17)], axis=1)


def standing(x, y):
    """Somebody at a place [m], or at one a frame; NaN where rays determine none."""
    person = Person(0, BODY, FRAMES - 1)
    for frame in range(FRAMES):
        place = [np.broadcast_to(each, FRAMES)[frame] for each in (x, y)]
        joints = BODY + [*place, 0.0 if np.isfinite(place).all() else np.nan]
        person.sightings[frame] = Sighting(np.zeros(2), np.zeros(2), joints)
    return person


def stays(person, margin=2.0, pitch=PITCH):
    return without_bystanders([person], pitch, margin) == [person]


@pytest.mark.parametrize("side", [-1.0, 1.0])
def test_who_waits_behind_the_lines_goes(side):
    assert stays(standing(0.0, side * 35.9))
    assert not stays(standing(0.0, side * 36.1))
    assert stays(standing(side * 54.4, 0.0))
    assert not stays(standing(side * 54.6, 0.0))
    assert not stays(standing(0.0, side * 35.9), margin=1.5)


def test_beside_a_corner_both_lines_count():
    assert stays(standing(52.5 + 1.4, 34.0 + 1.4))
    assert not stays(standing(52.5 + 1.5, 34.0 + 1.5))


def test_a_player_who_runs_over_the_line_stays():
    assert stays(standing(0.0, np.linspace(33.0, 40.0, FRAMES)))
    out = np.full(FRAMES, 40.0)
    out[-1] = 34.0
    assert stays(standing(0.0, out))


def test_frames_without_a_place_decide_nothing():
    nowhere = np.where(np.arange(FRAMES) < 10, np.nan, 40.0)
    assert not stays(standing(nowhere, nowhere))
    assert stays(standing(np.full(FRAMES, np.nan), np.full(FRAMES, np.nan)))


def test_joints_that_are_not_determined_do_not_count():
    person = standing(0.0, 36.5)
    for frame, sighting in list(person.sightings.items()):
        joints = sighting.joints.copy()
        joints[5:] = np.nan
        person.sightings[frame] = Sighting(sighting.index, sighting.ray_distance, joints)
    assert not stays(person)


def test_without_a_pitch_everybody_stays():
    assert stays(standing(0.0, 80.0), pitch=None)
