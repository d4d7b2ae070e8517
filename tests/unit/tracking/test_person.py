import numpy as np
import pytest

from worldpose.tracking.person import BLOCK, Person, Sighting, separations
from worldpose.tracking.settings import TrackingSettings

SETTINGS = TrackingSettings()
FPS = 50.0


def sighting(joints, *index):
    places = np.array(index or (0, 0))
    return Sighting(places, np.where(places >= 0, 0.1, np.nan), joints)


def test_separation_is_the_mean_distance_of_joints_known_in_both(people):
    here = people([[0.0, 0.0]])
    there = people([[3.0, 4.0], [0.0, 1.0]])
    there[0, :10] = np.nan
    np.testing.assert_allclose(separations(here, there), [[5.0, 1.0]], rtol=1e-14)


def test_velocity_is_learned_and_predicts_the_next_frame(people):
    person = Person(0, people([0.0, 0.0]), 0)
    for frame in range(1, 51):
        person.advance(frame, FPS, SETTINGS)
        person.see(frame, sighting(people([0.16 * frame, 0.0])), FPS, SETTINGS)
    # 8 m/s; after 1 s = ten averaging times the start is forgotten to exp(-10).
    np.testing.assert_allclose(person.velocity, [8.0, 0.0, 0.0], atol=1e-3)
    person.advance(51, FPS, SETTINGS)
    np.testing.assert_allclose(person.pose, people([0.16 * 51, 0.0]), atol=1e-4)


def test_absorbed_sightings_fill_the_empty_cameras(people):
    kept, other = Person(0, people([0.0, 0.0]), 0), Person(1, people([0.0, 0.0]), 0)
    for frame in range(4):
        kept.see(frame, sighting(people([0.0, 0.0]), 3, -1), FPS, SETTINGS)
        other.see(frame, sighting(people([0.1, 0.0]), 5, 7), FPS, SETTINGS)
    kept.absorb(other, 2)
    assert kept.sightings[1].index.tolist() == [3, -1]
    assert kept.sightings[2].index.tolist() == [3, 7]
    assert sorted(other.sightings) == [0, 1]
    assert other.fixed == 2


FRAMES = 3 * BLOCK + 5


@pytest.mark.parametrize("known", [16, 1])
def test_unseen_joints_move_by_the_median_of_the_seen_ones(known):
    rng = np.random.default_rng(known)
    pose, motion = rng.normal(size=(17, 3)), rng.normal(size=(17, 3))
    joints = np.where(np.arange(17)[:, None] < known, pose + motion, np.nan)
    person = Person(0, pose, 0)
    person.see(1, sighting(joints), FPS, SETTINGS)
    middle = np.median(motion[:known], axis=0)
    np.testing.assert_allclose(person.pose[:known], joints[:known])
    np.testing.assert_allclose(person.pose[known:], pose[known:] + middle, rtol=1e-12)
