"""Sides of cameras from the people whom they share, with known truth."""

from dataclasses import replace

import numpy as np
import pytest
from clicking_people import pinhole

from worldpose.errors import InputError
from worldpose.pitch.template import PitchTemplate
from worldpose.static_calibration.sides import (
    MIN_EVIDENCE,
    SeenPeople,
    compare_sides,
    decide_sides,
    turn_camera,
)

PITCH = PitchTemplate.standard()
SECONDS = np.arange(6.0)
SEATS = {
    "near": ((-20.0, -60.0, 18.0), (-25.0, 0.0, 0.0)),
    "far": ((-30.0, 62.0, 16.0), (-25.0, 0.0, 0.0)),
    "goal": ((-80.0, 5.0, 15.0), (-30.0, 0.0, 0.0)),
    "other_end": ((78.0, -3.0, 25.0), (45.0, 0.0, 0.0)),
}


def camera(seat):
    center, aim = SEATS[seat]
    return pinhole(center, aim, 3000.0 if seat == "other_end" else 1100.0, (1920, 1080))


def watch(seat, places, rng, *, miss=0.2, false=1, noise=0.3):
    """Return what a camera sees of people (frames, people, 2), with misses and false positives."""
    own = camera(seat)
    stray = rng.uniform([-50.0, -32.0], [50.0, 32.0], (len(places), false, 2))
    xy = np.concatenate([places + rng.normal(0.0, noise, places.shape), stray], axis=1)
    ground = np.concatenate([xy, np.zeros((*xy.shape[:2], 1))], axis=-1)
    pixels = own.project(ground.reshape(-1, 3)).reshape(*xy.shape)
    with np.errstate(invalid="ignore"):
        seen = ((pixels > 0.0) & (pixels < own.image_size)).all(axis=-1)
    xy[~seen | (rng.random(seen.shape) < miss)] = np.nan
    return SeenPeople(own, xy, np.broadcast_to(noise**2 * np.eye(2), (*xy.shape, 2)))


def turn(seen):
    return replace(seen, camera=turn_camera(seen.camera), xy=-seen.xy)


@pytest.fixture
def people():
    """Twenty people who walk about the left half."""
    rng = np.random.default_rng(70)
    start = rng.uniform([-50.0, -30.0], [0.0, 30.0], (20, 2))
    return rng, start + rng.normal(0.0, 2.0, (len(SECONDS), 20, 2)).cumsum(axis=0)


def test_people_agree_on_the_true_side_alone(people):
    rng, places = people
    near, far = (watch(seat, places, rng) for seat in ("near", "far"))
    same, turned = compare_sides(near, far, PITCH, SECONDS)
    assert same > 10.0 * MIN_EVIDENCE
    assert turned < 0.1 * same
    assert compare_sides(near, turn(far), PITCH, SECONDS) == pytest.approx((turned, same))


@pytest.mark.parametrize("wrong", [(), ("far", "goal")])
def test_one_stated_side_decides_all_cameras(people, wrong):
    rng, places = people
    seen = {seat: watch(seat, places, rng) for seat in ("near", "far", "goal")}
    given = {name: turn(each) if name in wrong else each for name, each in seen.items()}
    decided = decide_sides(given, {"near"}, PITCH, SECONDS)
    assert {name: each.turned for name, each in decided.items()} == {
        name: name in wrong for name in seen
    }
    assert min(each.evidence for each in decided.values()) > MIN_EVIDENCE


def test_a_camera_that_sees_nobody_whom_the_others_see_is_not_guessed(people):
    rng, places = people
    seen = {seat: watch(seat, places, rng, false=0) for seat in ("near", "far", "other_end")}
    decided = decide_sides(seen, {"near"}, PITCH, SECONDS)["other_end"]
    assert decided.turned is None
    with pytest.raises(InputError, match=r"people that both this camera.*State the camera's side"):
        decided.require_side("image of other_end")


def test_unrelated_people_decide_nothing():
    """Twenty pairs of cameras whose people have nothing to do with each other."""
    rng = np.random.default_rng(71)
    for _ in range(20):
        first, second = (
            watch(seat, rng.uniform([-50.0, -30.0], [0.0, 30.0], (6, 12, 2)), rng)
            for seat in ("near", "far")
        )
        same, turned = compare_sides(first, second, PITCH, SECONDS)
        assert abs(same - turned) < MIN_EVIDENCE


def test_a_wrong_stated_side_is_named(people):
    rng, places = people
    seen = {seat: watch(seat, places, rng) for seat in ("near", "far", "goal")}
    seen["goal"] = turn(seen["goal"])
    decided = decide_sides(seen, set(seen), PITCH, SECONDS)
    assert [name for name, each in decided.items() if each.contradicted] == ["goal"]
    with pytest.raises(InputError, match=r"with near, far only after half a turn.*opposite side"):
        decided["goal"].require_side("image of goal")
