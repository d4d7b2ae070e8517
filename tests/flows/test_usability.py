"""The verdict on a run, from metrics and warnings that can be judged by hand."""

import re

import pytest

from data_contracts.run import UnitFailure
from data_contracts.usability import UsableLimits
from flows.usability import RunOutcome, judge_run

HEALTHY = {
    "detection/cam1.clip": {"unreadable_share": 0.01, "empty_share": 0.4},
    "tracking/clip": {"absent_share": 0.05, "unmatched_share": 0.15, "mean_ray_distance_m": 0.06},
    "triangulation/clip": {"standard_deviation_m": 0.3, "unhealthy_s.cam2": 9.0},
    "retriangulation/clip": {"standard_deviation_m": 0.05, "unhealthy_s.cam2": 1.8},
    "body_fitting/clip": {"offset_rms_m": 0.01, "held_out_certain_excess_m.knee": 0.0},
}


UNHEALTHY = {"unhealthy_s.cam2": 2.2, "unhealthy_s.cam3": 3.0}
UNHEALTHY |= {"unhealthy_from_frame.cam3": 0, "unhealthy_to_frame.cam3": 74}
UNHEALTHY |= {"unhealthy_share": 0.5, "unhealthy_share.cam3": 0.5}  # said once, in seconds
HALF = {"unhealthy_s.cam3": 0.867, "unhealthy_share": 0.5556, "unhealthy_share.cam3": 0.5556}
HALF |= {"unhealthy_from_frame.cam3": 48, "unhealthy_to_frame.cam3": 99}
MISSED = {"missed_share.cam1": 0.73, "missed_person.cam1": 1, "missed_share.cam2": 0.5}
UNREADABLE = {"unreadable_share": 0.05, "unreadable_from_frame": 7, "unreadable_to_frame": 11}
MISPLACED = {"misplacement_m.cam1": 0.05, "misplacement_m.cam4": 0.08}
NO_NUMBER = {"misplacement_m.cam1": float("nan"), "misplacement_m.cam2": 0.01}
MOVED = {"moved_deviations.cam1": 2.9, "moved_deviations.cam4": 7.1}
WORSE = {"held_out_certain_excess_m.knee": 0.02, "held_out_certain_excess_m.hip": 0.001}
WRONG = {"clicks_wrong": 2.0, "wrong_click.at_-52.50_0.04.again": 1.0, "wrong_click.b_l": 1.0}
PLANE = {"unmatched_share": 0.1, "plane_std_m": 9.0}
ABSENT = {"absent_from_frame": 40, "absent_to_frame": 64, "absent_person": 7}


def judge(unit="", limits=None, **outcome):
    """The verdict on a healthy run in which `unit` has other metrics."""
    figures = HEALTHY | {unit: HEALTHY.get(unit, {}) | outcome.pop("figures", {})}
    return judge_run(RunOutcome(figures=figures, **outcome), limits or UsableLimits())


def test_a_healthy_run_is_usable_and_adjusted_cameras_replace_those_before():
    assert judge("x/y") == judge_run(RunOutcome(), UsableLimits())
    assert judge("x/y").verdict == "usable"


@pytest.mark.parametrize(
    ("unit", "figures", "said"),
    [
        ("detection/cam1.clip", UNREADABLE, "the video of cam1 in clip has no image, .* 7 to 11"),
        ("tracking/clip", {"absent_share": 0.2, **ABSENT}, "missing in clip for 20 % .* person 7"),
        ("tracking/clip", {"unmatched_share": 0.3}, r"no track follows 30 % \(limit 15 %\)"),
        ("tracking/clip", {"mean_ray_distance_m": 0.2}, r"disagree by 20 cm \(limit 15 cm\)"),
        ("tracking/clip", {"corrections_refused": 2.0}, "2 corrections of clip do not"),
        ("retriangulation/clip", {"standard_deviation_m": 0.2}, "joints in clip are uncertain"),
        ("retriangulation/clip", UNHEALTHY, r"cam3, cam2 depart .* 3 s \(limit 2 s\) .* 0 to 74"),
        ("retriangulation/clip", HALF, r"cam3 depart .* 55\.6 % \(limit 5 %\) .* 48 to 99\."),
        (
            "retriangulation/clip",
            MISSED,
            r"is matched .* 73 % \(limit 50 %\) .* person 1 in cam1\.",
        ),
        ("retriangulation/clip", MISPLACED, r"cam4 displaces people in clip by 8 cm \(limit 5"),
        ("retriangulation/clip", {"filled_share": 0.1}, r"no camera sees 10 % \(limit 5 %\)"),
        ("bundle_adjustment/cameras", MOVED, "contradict the calibration of cam4: .* by 7.1"),
        ("body_fitting/clip", {"offset_rms_m": 0.05}, r"bodies in clip lie 5 cm \(limit 3 cm\)"),
        ("body_fitting/clip", WORSE, r"bodies in clip are farther .* \(knee\), by 2"),
        ("broadcast_calibration/clip", {"expected_error_median_px": 4.0}, r"4 px \(limit 3 px\)"),
        ("static_calibration/cam1", {"clicks_wrong": 5.0}, r"clicks of cam1 contradict .*: 5\. C"),
        ("static_calibration/cam1", WRONG, r": 2 \(\(-52\.5, 0\) m, once more, b l\)\. Correct"),
        ("broadcast_tracking/clip", PLANE, r"places of people .* 9 m \(limit 1 m\)"),
        # A metric that is not there, or not a number, is no good one.
        ("triangulation/other", {"unhealthy_share": 0.0}, "could not be computed in other"),
        ("retriangulation/clip", NO_NUMBER, r"misplacement could not be computed in clip \(cam1\)"),
    ],
)
def test_a_metric_beyond_its_limit_is_a_reservation(unit, figures, said):
    found = judge(unit, figures=figures)
    assert found.verdict == "usable with reservations"
    (text,) = found.reservations
    assert re.search(said, text)


@pytest.mark.parametrize(
    ("freedom", "moved", "is_said"),
    # Of Student's distribution, by tables: beyond 5.5 in 3 % and in 0.03 %, beyond 4.1 in 0.2 %.
    [(2.0, 5.5, False), (10.0, 5.5, True), (10.0, 4.1, True), (10.0, 3.1, False), (0.0, 3.1, True)],
)
def test_few_clicks_know_their_noise_badly_and_cameras_may_move_farther(freedom, moved, is_said):
    figures = {
        "static_calibration/cam1": {"click_freedom": freedom, "clicks_wrong": 0.0},
        "bundle_adjustment/cameras": {"moved_deviations.cam1": moved},
    }
    found = judge_run(RunOutcome(figures=HEALTHY | figures), UsableLimits())
    assert ("contradict the calibration of cam1" in str(found.reservations)) == is_said


@pytest.mark.parametrize(("joints", "is_said"), [(0.0, True), (2550.0, False)])
def test_a_camera_that_calibration_calls_uncertain_is_said_where_no_joints_check_it(
    joints, is_said
):
    figures = {"retriangulation/clip": {"joints": joints, "standard_deviation_m": 0.05}}
    figures["static_calibration/left"] = {"expected_ground_error_median_m": 0.1765}
    figures["static_calibration/good"] = {"expected_ground_error_median_m": 0.149}
    found = judge_run(RunOutcome(figures=HEALTHY | figures), UsableLimits()).reservations
    assert [re.sub(" only.*", "", each) for each in found] == [
        "the calibration of left places people on the pitch"
    ] * is_said
    assert not is_said or "17.6 cm (limit 15 cm)" in found[0]


def test_results_that_end_before_bodies_name_their_last_stage():
    until = {name: HEALTHY[name] for name in ("detection/cam1.clip", "tracking/clip")}
    found = judge_run(RunOutcome(figures=until), UsableLimits())
    assert found.verdict == "usable with reservations"
    assert found.reservations == (
        "no person has a body: the results end with tracking. Run the match without --until.",
    )
    (alone,) = judge_run(RunOutcome(figures=until, waiting=1), UsableLimits()).reservations
    assert alone.startswith("results that wait for review: 1.")


def test_a_limit_is_a_setting_and_is_kept_with_the_verdict():
    limits = UsableLimits(max_unmatched_share=0.1)
    found = judge("x/y", limits)
    assert (len(found.reservations), found.limits) == (1, limits)


def test_warnings_of_stages_that_doubt_their_results_are_reservations_those_of_inputs_are_not():
    said = {
        "ingest/cam1": ["cam1: 25 fps"],
        "detection/cam2.clip": ["cam2.clip: the camera does not film this clip."],
        "detection/cam1.clip": ["cam1.clip: people are 833 px tall in the images."],
        "triangulation/clip": ["camera cam2 moves."],
        "broadcast_calibration/clip": ["3 frames have no evidence."],
        "broadcast_tracking/clip": ["found no person on the pitch."],
    }
    doubts = [text for texts in [*said.values()][2:] for text in texts]
    assert judge("x/y", warnings=said).reservations == tuple(doubts)


def test_failed_units_and_cameras_left_out_are_reservations():
    failed = UnitFailure(unit="filtering/clip", error="E", message="no\n disk")
    found = judge("x/y", failed=[failed], left_out=["camera cam1 is left out: blind."])
    assert found.verdict == "usable with reservations"
    told = ("filtering/clip failed: no disk", "camera cam1 is left out: blind.")
    assert found.reservations == told


@pytest.mark.parametrize(
    ("outcome", "said"),
    [
        ({"lacks_results": True}, "the run failed."),
        ({"lacks_people": True}, "no person is placed."),
        ({"waiting": 2}, "results that wait for review: 2."),
        ({"unit": "tracking/clip", "figures": {"absent_share": 0.6}}, "people are missing in"),
        ({"unit": "tracking/clip", "figures": {"unmatched_share": 0.63}}, "no track follows 63 %"),
    ],
)
def test_results_that_are_not_there_are_not_usable(outcome, said):
    found = judge(**{"unit": "x/y", **outcome})
    assert found.verdict == "not usable"
    (text,) = found.reservations  # the same number is not said with two limits
    assert text.startswith(said)


def test_the_cause_is_said_before_what_it_does_and_advice_fits_given_cameras():
    figures = {"tracking/clip": {"unmatched_share": 0.63}, "static_calibration/cam1": {}}
    figures["retriangulation/clip"] = HEALTHY["retriangulation/clip"] | MISPLACED
    warnings = {"detection/cam1.clip": ["cam1.clip: people are 833 px tall."]}
    cause, effect, misplaced = judge_run(
        RunOutcome(figures=HEALTHY | figures, warnings=warnings), UsableLimits()
    ).reservations
    assert cause == "cam1.clip: people are 833 px tall."
    assert effect.startswith("no track follows 63 % (limit 50 %)")
    assert misplaced.endswith("Calibrate it anew.")
    clicked = figures | {"static_calibration/cam1": {"clicks_wrong": 0.0}}
    found = judge_run(RunOutcome(figures=HEALTHY | clicked), UsableLimits()).reservations
    assert found[-1].endswith("Click more markings, where there are none.")


def test_people_who_are_not_in_3d_are_places_that_can_be_used():
    figures = {"triangulation/clip": {"joints": 0.0}, "body_fitting/clip": {"bodies": 0.0}}
    found = judge_run(RunOutcome(figures=figures, lacks_joints=True), UsableLimits())
    assert found.verdict == "usable with reservations"
    assert found.reservations[0].startswith("no person is in 3D: people have places on the pitch")
    assert "could not be computed" not in str(found.reservations)  # there are no joints to judge
