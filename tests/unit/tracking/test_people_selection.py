"""Who is a player, and how certain an identity is."""

import itertools

import cv2
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from data_contracts.tracking import Join
from worldpose.tracking.absences import measure_absences
from worldpose.tracking.joins import End, Takeover, choose_joins, identity_certainty, join_costs
from worldpose.tracking.people_selection import drop_bystanders, drop_shadows, merge_duplicates
from worldpose.tracking.person import Person, Sighting
from worldpose.tracking.plane.feet import GroundPositions
from worldpose.tracking.plane.shirts import measure_shirts
from worldpose.tracking.plane.tracker import track_on_plane
from worldpose.tracking.ray_matching import match_optimally
from worldpose.tracking.settings import TrackingSettings

FPS, CAMERAS, FULL_PITCH = 50.0, 10, (105.0, 68.0)
BODY = np.stack([np.zeros(17), np.zeros(17), np.linspace(0.0, 1.7, 17)], axis=1)


def track(number, seconds, x, y=0.0, views=CAMERAS):
    """Return a track over a time span [s] at a position [m], one or one per frame.

    It is seen by these cameras, or by that many.
    """
    frames = range(*(round(FPS * second) for second in seconds))
    views, count = np.arange(views) if np.isscalar(views) else views, len(frames)
    someone = Person(number, BODY, frames[-1], CAMERAS, fixed=count, evidence=float(count))
    index = np.where(np.isin(np.arange(CAMERAS), views), 0, -1)
    for frame, *place in zip(frames, *np.broadcast_arrays(x, y, np.zeros(count)), strict=True):
        someone.sightings[frame] = Sighting(index, np.full(CAMERAS, 0.02), BODY + place)
    return someone


@pytest.mark.parametrize("side", [-1.0, 1.0])
def test_a_person_who_waits_behind_the_lines_is_a_bystander(side):
    def stays(x, y, margin=2.0):
        person = track(0, (0.0, 0.4), x, y)
        return drop_bystanders([person], FULL_PITCH, margin) == [person]

    assert stays(0.0, side * 35.9) and not stays(0.0, side * 36.1)
    assert stays(side * 54.4, 0.0) and not stays(side * 54.6, 0.0)
    assert not stays(0.0, side * 35.9, margin=1.5)


@pytest.mark.parametrize(
    ("near", "distance", "left"),
    [(20, 0.5, [0]), (20, 0.0, [0, 1]), (14, 0.5, [0]), (13, 0.5, [0, 1])],
)
def test_a_track_next_to_a_better_seen_person_for_seven_tenths_of_the_time_is_a_shadow(
    near, distance, left
):
    way = np.where(np.arange(20) < near, 0.1, 3.0)
    people = [track(0, (0.0, 0.4), 0.0), track(1, (0.0, 0.4), way, views=2)]
    assert [person.number for person in drop_shadows(people, distance)] == left


LEFT, RIGHT = np.arange(CAMERAS)[: CAMERAS // 2], np.arange(CAMERAS)[CAMERAS // 2 :]


@pytest.mark.parametrize(("near", "left"), [(0.7, [0]), (0.68, [0, 1])])
def test_a_track_at_another_in_seven_tenths_of_its_frames_is_the_same_person(near, left):
    first = track(0, (0, 3), 0.0, views=LEFT)
    second = track(1, (1, 2), np.where(np.arange(50) < near * 50, 0.19, 0.3), views=RIGHT)
    people, merged = merge_duplicates([first, second], distance=0.2)
    assert [person.number for person in people] == left
    assert merged == 2 - len(left)


@pytest.mark.parametrize(("span", "whole"), [((0.8, 1.8), (40, 149)), ((2.2, 3.2), (50, 159))])
def test_a_duplicate_extends_the_track_that_takes_it_over(span, whole):
    first, second = track(0, (1, 3), 0.0, views=LEFT), track(1, span, 0.1, views=RIGHT)
    (person,), _ = merge_duplicates([first, second], distance=0.2)
    np.testing.assert_array_equal(person.sightings.stack()[0], np.arange(whole[0], whole[1] + 1))
    assert (person.last_fixed, person.evidence) == (whole[1], 110.0)


FRAME = np.arange(100, 200)


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
    present = np.ones((100, 2), dtype=bool)  # two people, 25 frames per second
    for who, (first, last) in absent.items():
        present[first : last + 1, {"one": [0], "two": [1], "both": [0, 1]}[who]] = False
    assert measure_absences(present, FRAME, [7, 9], 25.0) == expected


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


SETTINGS = TrackingSettings()
LIMBS = np.full(11, 0.36)


def end(number, frame, limbs=LIMBS, place=(0.0, 0.0)):
    return End(number, frame, np.array(place), np.zeros(2), limbs, np.full(11, 4e-5))


def decided(before, after):
    costs = join_costs(before, after, 25.0, 300.0, SETTINGS)
    return [
        (join.before, join.after)
        for join in choose_joins(before, after, costs, 25.0, SETTINGS)
        if join.decided
    ]


def test_a_person_is_back_after_ten_seconds_only_with_the_own_size():
    gone, other = end(0, 100), end(1, 110, LIMBS + 0.03)
    same, unlike = end(2, 350, place=(4.0, 3.0)), end(3, 360, LIMBS - 0.02)
    assert decided([gone, other], [same]) == [(0, 2)]
    # One has left, and one comes: that alone is no evidence.
    assert decided([gone], [unlike]) == []
    assert decided([gone], [end(4, 350, np.full(11, np.nan))]) == []
    # After minutes, a place tells nothing.
    patient = TrackingSettings(max_join_gap_s=200.0)
    (cost,) = join_costs([gone], [end(6, 5000)], 25.0, 300.0, patient).ravel()
    assert np.isfinite(cost)
    # A moment unseen needs no shape.
    assert decided([gone], [end(5, 110, np.full(11, np.nan))]) == [(0, 5)]


def test_certainty_falls_at_every_return_and_not_at_a_confirmed_one():
    def join(first_frame, margin, after=7, is_decided=True):
        last = first_frame - 5
        return Join(before=7, after=after, last_frame=last, first_frame=first_frame, cost=0.0,
                    margin=margin, decided=is_decided)  # fmt: skip

    joins = [join(10, np.log(9.0)), join(20, None), join(30, np.log(4.0)), join(5, 1.0, 8, False)]
    found = identity_certainty(joins, np.array([7, 8]), 40)
    assert found[[0, 9, 10, 29, 30, 39], 0] == pytest.approx([1, 1, 0.9, 0.9, 0.72, 0.72])
    assert (found[:, 1] == 1.0).all()


def test_a_track_that_may_show_another_person_is_as_likely_either():
    join = Takeover(frame=20, person=7, other=-1).join
    found = identity_certainty([join], np.array([7, 8]), 40)
    assert found[[0, 19, 20, 39], 0] == pytest.approx([1, 1, 0.5, 0.5])
    assert (found[:, 1] == 1.0).all()


RED, BLUE, GRASS = (200, 20, 30), (20, 40, 180), (60, 120, 50)
CERTAIN_FPS = 25.0


def lab(colour):
    pixel = np.array(colour, dtype=np.float32)[None, None] / 255.0
    return cv2.cvtColor(pixel, cv2.COLOR_RGB2LAB)[0, 0]


def people(lefts):
    """Boxes of 20 x 60 px, and torsos whose shoulders are at 12 px and hips at 30 px."""
    boxes = np.array([[left, 20.0, left + 20.0, 80.0] for left in lefts])
    keypoints = np.full((len(lefts), 17, 2), np.nan)
    for joint, at in ((5, (15, 32)), (6, (5, 32)), (11, (13, 50)), (12, (7, 50))):
        keypoints[:, joint] = np.array(at, dtype=float) + [[left, 0.0] for left in lefts]
    return keypoints, np.where(np.isfinite(keypoints[..., 0]), 0.9, np.nan), boxes


def test_the_colour_is_that_of_the_upper_body_with_and_without_keypoints():
    keypoints, confidence, boxes = people([20, 120])
    image = np.tile(np.array(GRASS, dtype=np.uint8), (100, 200, 1))
    for left, colour in ((20, RED), (120, BLUE)):
        image[31:52, left + 4 : left + 17] = colour
    found = measure_shirts(image, keypoints, confidence, boxes)
    np.testing.assert_allclose(found, [lab(RED), lab(BLUE)], atol=1e-3)
    confidence[:] = np.nan
    np.testing.assert_allclose(measure_shirts(image, keypoints, confidence, boxes), found)


def meeting(colours, spread=2.0):
    """Two people who run towards each other, meet, and run back; their places and shirts."""
    rng = np.random.default_rng(2)
    frames = 50
    x = 0.1 + np.abs(np.linspace(-5.0, 5.0, frames))
    xy = np.zeros((frames, 1, 2, 2))
    xy[:, 0, 0, 0], xy[:, 0, 1, 0] = -x, x
    xy += rng.normal(0.0, 0.02, xy.shape)
    shirts = np.empty((frames, 1, 2, 3))
    for person, colour in enumerate(colours):
        shirts[:, 0, person] = lab(colour) + rng.normal(0.0, spread, (frames, 3))
    shirts[23:27] = np.nan  # they hide one another
    noise = np.broadcast_to(0.2**2 * np.eye(2), (*xy.shape, 2)).copy()
    height = np.full(xy.shape[:-1], 1.8)
    return GroundPositions(xy, noise, np.zeros_like(noise), height, shirts=shirts)


def ends(positions):
    """Each track's detection in the first and in the last frame."""
    tracks = track_on_plane(positions, CERTAIN_FPS, pitch_size=(105.0, 68.0))
    index = tracks.detection_index[:, 0]
    assert index.shape[1] == 2
    return sorted((int(index[0, n]), int(index[-1, n])) for n in range(2))


def test_people_of_two_teams_who_meet_and_part_are_not_exchanged():
    positions = meeting([RED, BLUE])
    assert ends(positions) == [(0, 0), (1, 1)]
    positions.shirts[:] = np.nan
    assert ends(positions) == [(0, 1), (1, 0)]  # at constant velocity they run on


def test_shirts_of_one_team_decide_nothing_even_if_one_stands_in_the_shade():
    # The second person's shirt is darker, as shading makes it.
    assert ends(meeting([(200, 20, 30), (185, 18, 28)])) == [(0, 1), (1, 0)]
