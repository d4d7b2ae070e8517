"""A run advises on click noise and on clock offsets of cameras."""

import pytest

from data_contracts.match import CameraSpec, ClipSpec, MatchSpec
from flows.review.advice import click_advice, clock_advice


def match(cameras, offset=0, clips=("clip",)):
    return MatchSpec(
        match_id="m",
        fps=25.0,
        cameras=tuple(
            CameraSpec(id=f"cam{c}", width=10, height=10, offset_frames=0 if c else offset)
            for c in range(cameras)
        ),
        clips=tuple(ClipSpec(id=clip, frame_count=9) for clip in clips),
    )


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
    [(1.0, 10, 1.0), (1.2, 40, 1.0), (3.0, 1, 1.0), (3.0, 10, 3.0), (0.4, 10, 1.0), (1.5, 2, 1.0)],
)
def test_honest_or_few_clicks_are_not(noise, cameras, stated):
    settings = {"static_calibration": {"click_noise_px": stated}}
    assert click_advice(run(noise, cameras), settings) == []
