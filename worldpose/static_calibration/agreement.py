"""Stage 3 with clicks that are worse than stated, or wrong: the painted lines tell (C4)."""

from __future__ import annotations

from dataclasses import replace
from typing import Final

import numpy as np
from numpy.typing import NDArray

from worldpose.pitch import PitchTemplate
from worldpose.static_calibration.adjustment import Problem, camera_of_row, row_of
from worldpose.static_calibration.bending import tangent_at
from worldpose.static_calibration.line_refinement import LineRefinement, refine_on_lines
from worldpose.static_calibration.parameters import CameraEstimate
from worldpose.static_calibration.screening import (
    Screened,
    noise_of,
    rest_on,
    screen,
    surprise_at,
)
from worldpose.static_calibration.settings import StaticCalibrationSettings

_TRIES: Final = 3
_WIDER: Final = 2.0
"""Factor on the noise of clicks that the lines contradict, each time [1]."""
_WIDEST: Final = 4.0
"""No click is believed to be worse than this many times what is stated [1]."""
_AS_STATED: Final = 1.5
"""Up to this factor the noise that the lines tell is the stated one [1]: half of few clicks are
farther off by chance."""


def refine_and_judge(
    problem: Problem,
    fit: Screened,
    pitch: PitchTemplate,
    picture: NDArray[np.uint8],
    settings: StaticCalibrationSettings,
) -> tuple[Screened, LineRefinement]:
    """Return stage 2 as the lines judge its clicks, and stage 3 from there.

    Few clicks close together do not tell their own noise, nor which of them is wrong. The lines
    do: a camera that they hold shows how far every click is off. Where they contradict the clicks,
    these are taken to be twice, then four times as far off as stated; more is a contradiction
    that stands, and the camera is left to the clicks.

    Args:
        problem: what was clicked.
        fit: stage 2.
        pitch: the template.
        picture: of the camera.
        settings: noise, and what is wrong.
    """
    first = fit, _refined(_estimate(problem, fit), pitch, picture, settings)
    lines, factor = first[1], 1.0
    for _ in range(_TRIES):
        if lines.refined:
            row = row_of(lines.estimate.camera)
            told = noise_of(problem, row)
            factor = 1.0 if told <= _AS_STATED else min(told, _WIDEST)
            wider = _at_noise(problem, factor, settings)[0]
            surprise = surprise_at(wider, lines.estimate)
            inliers = surprise < settings.wrong_click
            if len(inliers) and 1.0 - inliers.mean() > settings.max_wrong_share:
                return first
            fit = rest_on(wider, row, inliers, fit.markings)
            # What was drawn along a line that was found tells of the same paint, only worse.
            read = {each.name for each in lines.markings if each.found}
            other = np.array([name not in read for name in problem.evidence.markings], dtype=bool)
            rest = wider.only(inliers, fit.markings & other)
            known = tangent_at(rest, row, fit.noise_scale)
            fit = replace(fit, surprise=surprise, noise_scale=factor * fit.noise_scale)
            again = _refined(known, pitch, picture, settings, begin=lines.estimate)
            return (fit, again) if again.refined else first
        if lines.contradictory and factor < _WIDEST:
            factor *= _WIDER
            wider, rough = _at_noise(problem, factor, settings)
            fit = screen(wider, fit.row, rough)
        else:
            return first
        lines = _refined(_estimate(problem, fit), pitch, picture, settings)
    return first


def _at_noise(
    problem: Problem, factor: float, settings: StaticCalibrationSettings
) -> tuple[Problem, StaticCalibrationSettings]:
    return (
        replace(
            problem,
            click_noise=factor * problem.click_noise,
            drawn_noise=factor * problem.drawn_noise,
        ),
        settings.model_copy(update={"click_noise": factor * settings.click_noise}),
    )


def _estimate(problem: Problem, fit: Screened) -> CameraEstimate:
    return CameraEstimate(camera_of_row(fit.row, problem.image_size), fit.covariance)


def _refined(
    start: CameraEstimate,
    pitch: PitchTemplate,
    picture: NDArray[np.uint8],
    settings: StaticCalibrationSettings,
    begin: CameraEstimate | None = None,
) -> LineRefinement:
    return refine_on_lines(
        start,
        pitch,
        picture,
        settings.line_refinement,
        survey_error=settings.survey_error,
        begin=begin,
    )
