"""Limits of gates, their reasons in words, and the advice of a run."""

import re
from pathlib import Path
from types import SimpleNamespace

import pytest
from run_records import AT, match_spec, review_request

from data_contracts.review import ReviewDecision
from flows.gates import GATES, Gatekeeper
from flows.review.advice import click_advice, clock_advice
from flows.review.metric_words import UNITS, reason_words

CAMERAS, PEOPLE = GATES["static_calibration"], GATES["detection"]
ADJUSTMENT, ACCEPTANCE = GATES["bundle_adjustment"], GATES["body_fitting"]


GOOD_CAMERA = {"expected_ground_error_median_m": 0.01, "expected_ground_error_p95_m": 0.04}
GOOD_CAMERA |= {"clicks_wrong": 0.0, "weak": 0.0}
ON_PITCH = {"undecided": 0.0, "unmatched_share": 0.1, "corrections_refused": 0.0}
# No person can answer for frames that a video does not have: the verdict names them.
GOOD_VIDEO = {"unreadable_share": 0.1, "empty_share": 0.1}
GOOD_VIDEO |= {"bridged_share": 0.5, "flicker_share": 0.01}
GOOD_BODIES = {"bodies": 100.0, "filled": 4.0, "offset_rms_m": 0.01}
WORSE_BODIES = {f"held_out_certain_excess_m.{n}": v for n, v in (("knee", 0.02), ("ankle", 0.03))}
WORSE_BODIES |= GOOD_BODIES | {"held_out_excess_m.hip": 0.05}  # not certain


def held_out(before, after):
    """Errors in pixels, of people whom a camera images at 50 px to the metre."""
    return {
        "held_out_error_before_px": before,
        "held_out_error_after_px": after,
        "held_out_error_after_m": after / 50.0,
    }


CERTAIN = held_out(2.0, 2.02) | {"held_out_significance": -4.0}


@pytest.mark.parametrize(
    ("gate", "figures", "objected"),
    [
        (CAMERAS, {}, []),  # a given one was judged by who gave it
        (CAMERAS, GOOD_CAMERA | {"expected_ground_error_p95_m": 0.6}, []),  # the limit itself
        (CAMERAS, GOOD_CAMERA | {"clicks_wrong": 1.0}, ["clicks_wrong is 1, at most 0 passes"]),
        (CAMERAS, {"clicks_wrong": 0.0, "weak": 0.0}, ["expected_ground", "expected_ground"]),
        (PEOPLE, GOOD_VIDEO | {"stride": 2.0}, []),  # filled in between two looks on purpose
        (PEOPLE, GOOD_VIDEO | {"stride": 1.0}, ["bridged_share is 0.5, at most 0.25 passes"]),
        (ADJUSTMENT, held_out(6.0, 5.5), ["held_out_error_after_m is 0.11, at most 0.1 passes"]),
        # As accurate in a hall, where people are nine times as large.
        (ADJUSTMENT, held_out(18.0, 17.0) | {"held_out_error_after_m": 0.04}, []),
        (ADJUSTMENT, held_out(2.0, 2.1), ["held_out_growth is 1.05, at most 1 passes"]),
        (ADJUSTMENT, held_out(2.0, 2.00035), []),  # a growth that reads as the limit is none
        # Cameras on one mast place people on the pitch alone: there are no joints to judge.
        (GATES["tracking"], ON_PITCH | {"people": 25.0, "plane_people": 25.0}, []),
        (GATES["tracking"], ON_PITCH | {"people": 25.0}, ["mean_ray_distance_m could"]),
        (GATES["triangulation"], {"joints": 0.0, "unhealthy_share": 0.0}, []),
        (ADJUSTMENT, held_out(2.0, 2.02) | {"held_out_significance": -0.8}, []),  # by chance
        (ADJUSTMENT, CERTAIN, ["held_out_growth is 1.01"]),
        (ADJUSTMENT, {"cameras_changed": 0.0}, []),  # as cameras on one mast
        (ADJUSTMENT, {"cameras_changed": 1.0}, ["held_out_error_after_m", "held_out_growth"]),
        (ACCEPTANCE, {"bodies": 100.0, "filled": 6.0, "offset_rms_m": 0.01}, ["filled_share"]),
        (ACCEPTANCE, {"bodies": 0.0, "filled": 0.0}, []),
        (ACCEPTANCE, {"bodies": 1.0, "filled": 0.0}, ["offset_rms_m could"]),
        (ACCEPTANCE, WORSE_BODIES, ["held_out_certain_excess_m is 0.03 (knee, ankle), at most"]),
    ],
)
def test_auto_objects_to_figures_beyond_their_limits(gate, figures, objected):
    lines = gate.objections(figures).values()
    assert len(lines) == len(objected)
    assert all(line.startswith(start) for line, start in zip(lines, objected, strict=True))


HEALTHY = {"standard_deviation_m": 0.01, "filled_share": 0.0, "joints": 9.0}


def unhealthy(**cameras):
    parts = {f"unhealthy_share.{name}": share for name, share in cameras.items()}
    return HEALTHY | {"unhealthy_share": max(cameras.values())} | parts


@pytest.mark.parametrize(
    ("now", "is_known"),
    [
        (unhealthy(a=0.3, b=0.0), True),
        (unhealthy(a=0.29, b=0.05), True),  # a camera within the limit is no question
        (unhealthy(a=0.0, b=0.29), False),
        (unhealthy(a=0.3, b=0.06), False),
        (unhealthy(a=0.3, c=0.1), False),
        (HEALTHY | {"unhealthy_share": 0.3}, True),
        ({**unhealthy(a=0.3), "filled_share": 0.9}, False),
    ],
)
def test_an_approval_covers_the_cameras_that_were_approved(now, is_known):
    unit = "triangulation/clip"
    gate, keys = GATES["triangulation"], {unit: "0" * 32}
    asked = review_request("q", keys=keys, figures=unhealthy(a=0.3, b=0.0))
    given = {"match_id": "m", "request": "q", "verdict": "approve", "who": "Ada"}
    journal = SimpleNamespace(questions=(asked, ReviewDecision(**given, decided_at=AT)))
    keeper = Gatekeeper(None, SimpleNamespace(journal=journal), "auto")
    manifest = SimpleNamespace(figures=now, left_out={})
    assert gate.objections(now)
    assert keeper._is_known(gate, unit, manifest) is is_known


@pytest.mark.parametrize(
    ("gate", "figures", "excess"),
    [
        (CAMERAS, {}, 0.0),
        # Of medians 0.15 m pass, at the far side 0.6 m: what the calibration page warns of.
        (CAMERAS, GOOD_CAMERA | {"expected_ground_error_median_m": 0.15}, 0.0),
        (CAMERAS, GOOD_CAMERA | {"expected_ground_error_median_m": 0.3}, 1.0),
        (CAMERAS, GOOD_CAMERA | {"clicks_wrong": 3.0}, 3.0),  # none passes
        (ACCEPTANCE, {"bodies": 100.0, "filled": 20.0, "offset_rms_m": 0.01}, 3.0),
    ],
)
def test_how_bad_a_result_is_goes_by_its_worst_figure(gate, figures, excess):
    assert gate.excess(figures) == pytest.approx(excess, abs=1e-12)


PAGES = Path(__file__).parents[2] / "infra" / "review_pages" / "src" / "words.js"


def test_every_metric_of_a_gate_is_put_into_words():
    names = [name for gate in GATES.values() for name in gate.limits]
    assert len(names) > 10
    for name in names:
        for reason in (f"{name} is 1, at most 0.5 passes", f"{name} could not be computed"):
            said = reason_words(reason)
            assert said != reason or "_" not in name
            assert "_" not in said


def test_the_pages_know_the_same_units():
    (listed,) = re.findall(r"const UNITS = \{(.*?)\};", PAGES.read_text())
    assert dict(re.findall(r'(\w+): "([^"]+)"', listed)) == UNITS


def match(cameras, offset=0, clips=("clip",)):
    offsets = {f"cam{c}": {"offset_frames": 0 if c else offset} for c in range(cameras)}
    return match_spec(offsets, {clip: {"frame_count": 9} for clip in clips})


def figures(late, error=0.06):
    """Metrics with clock offsets relative to their mean, and their standard errors [frame]."""
    mean = sum(late) / len(late)
    return {
        "triangulation/clip": {f"clock_error_frames.cam{c}": error for c in range(len(late))},
        "filtering/clip": {f"clock_late_frames.cam{c}": v - mean for c, v in enumerate(late)},
    }


@pytest.mark.parametrize(
    ("cameras", "late", "told"),
    [(3, 3.0, "3.0 match frames later"), (6, -2.2, "2.2 match frames earlier")],
)
def test_the_one_camera_out_of_step_is_told_its_offset(cameras, late, told):
    found = clock_advice(figures([late] + [0.0] * (cameras - 1)), match(cameras, offset=3))
    (text,) = found
    assert text.startswith(f"camera cam0 shows {told} than the others")
    assert f"set its offset_frames to {3 - round(late)} in match.yaml" in text


def test_a_camera_with_a_frame_rate_of_its_own_is_told_its_own_frames():
    spec = match(4, offset=7)
    slow = spec.cameras[0].model_copy(update={"fps": spec.fps / 2})
    spec = spec.model_copy(update={"cameras": (slow, *spec.cameras[1:])})
    (text,) = clock_advice(figures([2.0, 0.0, 0.0, 0.0]), spec)
    assert text.endswith("set its offset_frames to 6 in match.yaml")


@pytest.mark.parametrize(("late", "error"), [(0.4, 0.01), (3.0, 1.0)])
def test_what_no_whole_frame_mends_or_nobody_knows_is_not_told(late, error):
    assert clock_advice(figures([late, 0.0, 0.0, 0.0], error), match(4)) == []


def run(noise, cameras, freedom=8.0):
    figures = {"click_noise_px": noise, "click_freedom": freedom}
    return {f"static_calibration/cam{k}": figures for k in range(cameras)}


def test_noisy_clicks_of_several_cameras_are_told_with_the_setting():
    (text,) = click_advice(run(3.0, 10), {})
    # 80 degrees of freedom: 3 / sqrt(160).
    assert "10 cameras are 3.0 px off (standard error 0.2 px), stated are 1 px" in text
    assert text.endswith("--set static_calibration.click_noise_px=3")


@pytest.mark.parametrize(
    ("noise", "cameras", "stated"),
    [(1.2, 40, 1.0), (3.0, 1, 1.0), (3.0, 10, 3.0), (0.4, 10, 1.0), (1.5, 2, 1.0)],
)
def test_honest_or_few_clicks_are_not(noise, cameras, stated):
    settings = {"static_calibration": {"click_noise_px": stated}}
    assert click_advice(run(noise, cameras), settings) == []
