"""Cameras proposed from stills, and the side from which they look."""

from dataclasses import replace
from functools import cache

import numpy as np
import pytest
from clicking_people import ground_errors, paint_of, pinhole

from worldpose.errors import InputError
from worldpose.pitch.template import PitchTemplate
from worldpose.simulation.renderer import render_pitch
from worldpose.static_calibration.from_paint.proposal import (
    calibrate_proposal,
    propose_camera,
    propose_from_paint,
)
from worldpose.static_calibration.paint_share import paint_share
from worldpose.static_calibration.sides import (
    MIN_EVIDENCE,
    SeenPeople,
    compare_sides,
    decide_sides,
    turn_camera,
)

PITCH = PitchTemplate.standard()
SIZE = (1280, 720)


def camera(center=(-24.0, -60.0, 22.0), aim=(-33.0, -2.0, 0.0), focal=1300.0):
    return pinhole(center, aim, focal, SIZE, -0.05, 0.005)


@cache
def still(center=(-24.0, -60.0, 22.0)):
    return render_pitch(camera(center), PITCH, None, 3)


X, Y = (axis.ravel() for axis in np.meshgrid(np.linspace(-50, -15, 8), np.linspace(-25, 25, 8)))
PLACES = np.stack([X, Y, PITCH.height(X, Y)], axis=-1)


@pytest.fixture(scope="module")
def proposal():
    return propose_camera(still(), PITCH, side="near")


def test_a_rendered_still_gives_its_camera_without_a_click(proposal):
    found = calibrate_proposal(PITCH, proposal, still(), where="image of cam3")
    off = ground_errors(found.estimate.camera, camera(), PLACES)
    assert len(off) > 20
    assert np.median(off) < 0.05
    assert found.report.decisions[0].startswith("markings proposed from the image")


@pytest.mark.slow
def test_a_purple_cast_hides_no_pitch():
    cast = np.clip(still() * np.array([1.4, 0.5, 1.4]), 0, 255).astype(np.uint8)
    found = calibrate_proposal(PITCH, propose_camera(cast, PITCH, side="near"), cast)
    assert np.median(ground_errors(found.estimate.camera, camera(), PLACES)) < 0.05


def test_a_proposal_whose_markings_are_not_in_the_image_is_refused(proposal):
    other = still((-20.0, -64.0, 19.0))
    with pytest.raises(InputError, match=r"lines where the proposed camera projects.*Click four"):
        calibrate_proposal(PITCH, proposal, other, where="image of cam3")


def test_too_little_paint_is_refused_with_what_to_click():
    paint = paint_of(camera(), ["penalty_area_left_front"])
    assert propose_from_paint([paint], PITCH, side="near") is None
    grass = np.full((720, 1280, 3), (60, 120, 50), np.uint8)
    with pytest.raises(InputError, match=r"image of cam3: expected three straight.*Click"):
        propose_camera(grass, PITCH, side="near", where="image of cam3")


def test_lines_that_many_cameras_explain_are_not_clear():
    # Two parallels and a line across them: every pair of parallels of the pitch explains them.
    names = ["penalty_area_left_near", "penalty_area_left_far", "penalty_area_left_front"]
    proposal = propose_from_paint([paint_of(camera(), names)], PITCH, side="near")
    assert proposal is not None
    assert not proposal.is_clear
    told = rf"image of cam3.*nearly as well \(margin {proposal.margin:.0f}\).*Click four or more"
    with pytest.raises(InputError, match=told) as refused:
        proposal.require_clear("image of cam3", PITCH)
    named = str(refused.value).rpartition("it sees ")[2].rstrip(".").split(", ")
    assert 1 <= len(named) <= 4
    pixels = proposal.camera.project(PITCH.positions(named))
    assert ((pixels >= 0.0) & (pixels <= proposal.camera.image_size - 1.0)).all()


@pytest.mark.parametrize(
    ("picture", "message"),
    [
        (np.zeros((720, 1280), np.uint8), "expected RGB bytes"),
        (np.full((720, 1280, 3), 200, np.uint8), "expected grass in the lower three quarters"),
    ],
    ids=["grey", "white"],
)
def test_an_image_without_a_green_pitch_is_refused(picture, message):
    with pytest.raises(InputError, match=message):
        propose_camera(picture, PITCH, side="near")


@pytest.mark.parametrize("dark", [False, True])
def test_markings_lie_on_paint_for_the_right_camera_alone(dark):
    picture = 255 - still() if dark else still()
    share = paint_share(picture, camera(), PITCH)
    assert share is not None
    assert share > 0.9
    other = paint_share(picture, camera((10.0, -55.0, 15.0), (-25.0, 4.0, 0.0)), PITCH)
    assert other is not None
    assert other < 0.4
    assert paint_share(picture, camera(aim=(-24.0, -160.0, 0.0)), PITCH) is None


SECONDS = np.arange(6.0)
SEATS = {
    "near": pinhole((-20.0, -60.0, 18.0), (-25.0, 0.0, 0.0), 1100.0, (1920, 1080)),
    "far": pinhole((-30.0, 62.0, 16.0), (-25.0, 0.0, 0.0), 1100.0, (1920, 1080)),
    "goal": pinhole((-80.0, 5.0, 15.0), (-30.0, 0.0, 0.0), 1100.0, (1920, 1080)),
    "other_end": pinhole((78.0, -3.0, 25.0), (45.0, 0.0, 0.0), 3000.0, (1920, 1080)),
}


def watch(seat, places, rng, *, miss=0.2, false=1, noise=0.3):
    """Return what a camera sees of people (frames, people, 2), with misses and false positives."""
    own = SEATS[seat]
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
