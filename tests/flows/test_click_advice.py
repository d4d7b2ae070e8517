"""A run warns of clicks with larger errors than stated, from all cameras together."""

import pytest

from flows.review.advice import click_advice


def run(noise, cameras, freedom=8.0):
    figures = {"click_noise_px": noise, "click_freedom": freedom}
    return {f"static_calibration/cam{k}": figures for k in range(cameras)}


def test_noisy_clicks_of_several_cameras_are_told_with_the_setting():
    (text,) = click_advice(run(3.0, 10), 1.0)
    # 80 degrees of freedom: 3 / sqrt(160).
    assert "10 cameras are 3.0 px off (standard error 0.2 px), stated are 1 px" in text
    assert text.endswith("--set static_calibration.click_noise_px=3")


@pytest.mark.parametrize(
    ("noise", "cameras", "stated"),
    [(1.0, 10, 1.0), (1.2, 40, 1.0), (3.0, 1, 1.0), (3.0, 10, 3.0), (0.4, 10, 1.0), (1.5, 2, 1.0)],
)
def test_honest_or_few_clicks_are_not(noise, cameras, stated):
    assert click_advice(run(noise, cameras), stated) == []


def test_given_cameras_tell_nothing():
    assert click_advice({"static_calibration/cam0": {}, "tracking/clip": {"a": 1.0}}, 1.0) == []
