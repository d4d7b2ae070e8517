"""Bystanders, shadows and surplus people are dropped, judged by whole people."""

import itertools

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from worldpose.tracking.absences import measure_absences
from worldpose.tracking.people_selection import drop_bystanders, drop_shadows, merge_duplicates
from worldpose.tracking.person import Person, Sighting
from worldpose.tracking.ray_matching import match_optimally

FRAMES, FULL_PITCH = 20, (105.0, 68.0)
BODY = np.stack([np.zeros(17), np.zeros(17), np.linspace(0.0, 1.7, 17)], axis=1)


def standing(x, y):
    """Return a person at a position [m], one or one per frame; NaN where rays give none."""
    person = Person(0, BODY, FRAMES - 1, CAMERAS)
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


CAMERAS = 10


def shadow_track(number, views, x, frames=range(FRAMES), joints=17):
    """Return a track at `x` [m], one or one per frame; joints from `joints` on are unknown."""
    someone = Person(number, BODY, max(frames), CAMERAS)
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


@pytest.mark.parametrize(("near", "left"), [(14, [0]), (13, [0, 1])])
def test_seven_tenths_of_the_time_decide(near, left):
    way = np.where(np.arange(FRAMES) < near, 0.1, 3.0)
    assert kept(shadow_track(0, 10, 0.0), shadow_track(1, 2, way)) == left


FPS, PITCH = 50.0, (20.0, 20.0)


def track(number, frames, x, y=0.0, views=CAMERAS):
    """Return a track over a time span [s] at a position [m], one or one per frame."""
    frames = range(*(round(FPS * second) for second in frames))
    x, y = np.broadcast_to(x, len(frames)), np.broadcast_to(y, len(frames))
    someone = Person(
        number, BODY, frames[-1], CAMERAS, fixed=len(frames), evidence=float(len(frames))
    )
    index = np.where(np.arange(CAMERAS) < views, 0, -1)
    for n, frame in enumerate(frames):
        joints = BODY + [x[n], y[n], 0.0]
        someone.sightings[frame] = Sighting(index, np.full(CAMERAS, 0.02), joints)
    return someone


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


@pytest.mark.parametrize(("span", "whole"), [((0.8, 1.8), (40, 149)), ((2.2, 3.2), (50, 159))])
def test_a_duplicate_extends_the_track_that_takes_it_over(span, whole):
    first = in_cameras(track(0, (1, 3), 0.0), LEFT)
    second = in_cameras(track(1, span, 0.1), RIGHT)
    (person,), _ = merge_duplicates([first, second], distance=0.2)
    np.testing.assert_array_equal(person.sightings.stack()[0], np.arange(whole[0], whole[1] + 1))
    assert (person.last_fixed, person.evidence) == (whole[1], 110.0)


FRAME = np.arange(100, 200)


def clip(**absent):
    """Two people in 100 frames, 25 per second; rows in which one is not seen."""
    present = np.ones((100, 2), dtype=bool)
    for name, (first, last) in absent.items():
        present[first : last + 1, {"one": [0], "two": [1], "both": [0, 1]}[name]] = False
    return present


@pytest.mark.parametrize(
    ("absent", "share", "longest"),
    [
        ({}, 0.0, ()),
        ({"one": (40, 63)}, 0.0, ()),  # under a second
        ({"one": (40, 64)}, 25 / 200, (140, 164, 7)),
        ({"one": (60, 99)}, 0.0, ()),  # left for good
        ({"both": (75, 99)}, 0.25, (175, 199)),
        ({"both": (0, 49), "two": (60, 89)}, 0.5, (100, 149)),
        ({"both": (0, 24), "two": (40, 95)}, 56 / 150, (140, 195, 9)),
    ],
)
def test_absences(absent, share, longest):
    names = ("absent_from_frame", "absent_to_frame", "absent_person")
    expected = {"absent_share": pytest.approx(share), **dict(zip(names, longest, strict=False))}
    assert measure_absences(clip(**absent), FRAME, [7, 9], 25.0) == expected


def test_a_clip_without_people_misses_them_all():
    assert measure_absences(np.zeros((100, 0), bool), FRAME, [], 25.0) == {"absent_share": 1.0}


@given(seed=st.integers(0, 10_000))
@settings(max_examples=50)
def test_optimal_matching_has_the_largest_gain_of_all(seed):
    rng = np.random.default_rng(seed)
    affinity = -rng.uniform(0, 1, (1, 3, 4))
    affinity[rng.random(affinity.shape) < 0.3] = -np.inf
    index = match_optimally(affinity, -0.8)[0]

    def gain(places):
        return sum(-0.8 if d < 0 else affinity[0, p, d] for p, d in enumerate(places))

    every = (
        choice
        for choice in itertools.product(range(-1, 4), repeat=3)
        if len({d for d in choice if d >= 0}) == sum(d >= 0 for d in choice)
    )
    # Sums of three numbers of size 1.
    assert gain(index.tolist()) == pytest.approx(max(map(gain, every)), abs=1e-12)
