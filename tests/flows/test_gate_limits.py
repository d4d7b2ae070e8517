"""Positions of gates, and the metrics that let a result pass."""

import pytest

from flows.gates import GATES
from flows.method import METHOD

CAMERAS, PEOPLE, IDENTITIES = (
    GATES[stage] for stage in ("static_calibration", "detection", "tracking")
)
ADJUSTMENT, ACCEPTANCE = GATES["bundle_adjustment"], GATES["body_fitting"]


def test_gates_stand_behind_stages_of_the_method():
    stages = [stage.name for stage in METHOD]
    places = [stages.index(gate.stage) for gate in GATES.values()]
    assert places == sorted(set(places))


GOOD_CAMERA = {"expected_ground_error_median_m": 0.01, "expected_ground_error_p95_m": 0.04}
GOOD_CAMERA |= {"clicks_wrong": 0.0, "weak": 0.0}
ON_PITCH = {"undecided": 0.0, "unmatched_share": 0.1, "corrections_refused": 0.0}
# No person can answer for frames that a video does not have: the verdict names them.
GOOD_VIDEO = {"unreadable_share": 0.1, "empty_share": 0.1}
GOOD_VIDEO |= {"bridged_share": 0.5, "flicker_share": 0.01}
GOOD_BODIES = {"bodies": 100.0, "filled": 4.0, "offset_rms_m": 0.01}
WORSE_BODIES = {f"held_out_certain_excess_m.{n}": v for n, v in (("knee", 0.02), ("ankle", 0.03))}
WORSE_BODIES |= {"held_out_excess_m.hip": 0.05}  # not certain


def held_out(before, after):
    """Errors in pixels, of people whom a camera images at 50 px to the metre."""
    return {
        "held_out_error_before_px": before,
        "held_out_error_after_px": after,
        "held_out_error_after_m": after / 50.0,
    }


@pytest.mark.parametrize(
    ("gate", "figures", "objected"),
    [
        (CAMERAS, GOOD_CAMERA, []),
        (CAMERAS, {}, []),  # a given one was judged by who gave it
        (CAMERAS, GOOD_CAMERA | {"expected_ground_error_p95_m": 0.6}, []),  # the limit itself
        (CAMERAS, GOOD_CAMERA | {"clicks_wrong": 1.0}, ["clicks_wrong is 1, at most 0 passes"]),
        (CAMERAS, {"clicks_wrong": 0.0, "weak": 0.0}, ["expected_ground", "expected_ground"]),
        (PEOPLE, GOOD_VIDEO | {"stride": 2.0}, []),  # filled in between two looks on purpose
        (PEOPLE, GOOD_VIDEO | {"stride": 1.0}, ["bridged_share is 0.5, at most 0.25 passes"]),
        (ADJUSTMENT, held_out(2.0, 1.9), []),
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
        (
            ADJUSTMENT,
            held_out(2.0, 2.02) | {"held_out_significance": -4.0},
            ["held_out_growth is 1.01"],
        ),
        (ADJUSTMENT, {"cameras_changed": 0.0}, []),  # as cameras on one mast
        (ADJUSTMENT, {"cameras_changed": 1.0}, ["held_out_error_after_m", "held_out_growth"]),
        (ACCEPTANCE, {"bodies": 100.0, "filled": 6.0, "offset_rms_m": 0.01}, ["filled_share"]),
        (ACCEPTANCE, {"bodies": 0.0, "filled": 0.0, "offset_rms_m": 0.01}, []),
        (ACCEPTANCE, GOOD_BODIES | {"held_out_certain_excess_m.knee": 0.01}, []),
        (
            ACCEPTANCE,
            GOOD_BODIES | WORSE_BODIES,
            ["held_out_certain_excess_m is 0.03 (knee, ankle), at most 0.01 passes"],
        ),
    ],
)
def test_auto_objects_to_figures_beyond_their_limits(gate, figures, objected):
    lines = gate.objections(figures)
    assert len(lines) == len(objected)
    assert all(line.startswith(start) for line, start in zip(lines, objected, strict=True))


@pytest.mark.parametrize(
    ("gate", "figures", "excess"),
    [
        (CAMERAS, {}, 0.0),
        # Of medians 0.15 m pass, at the far side 0.6 m: what the calibration page warns of.
        (CAMERAS, GOOD_CAMERA | {"expected_ground_error_median_m": 0.15}, 0.0),
        (CAMERAS, GOOD_CAMERA | {"expected_ground_error_median_m": 0.3}, 1.0),
        (CAMERAS, GOOD_CAMERA | {"clicks_wrong": 3.0}, 3.0),  # none passes
        (PEOPLE, GOOD_VIDEO | {"stride": 1.0}, 1.0),  # 0.5 where 0.25 passes
        (ADJUSTMENT, held_out(2.0, 3.0), 0.5),
        (ACCEPTANCE, {"bodies": 100.0, "filled": 20.0, "offset_rms_m": 0.01}, 3.0),
    ],
)
def test_how_bad_a_result_is_goes_by_its_worst_figure(gate, figures, excess):
    assert gate.excess(figures) == pytest.approx(excess, abs=1e-12)
