"""Stage 3 where clicks are noisier than stated, or wrong: painted lines decide (C4)."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import suppress
from dataclasses import replace
from typing import Final

import numpy as np
from numpy.typing import NDArray

from worldpose.errors import InputError
from worldpose.pitch import PitchTemplate
from worldpose.static_calibration.adjustment import Problem, camera_of_row, row_of
from worldpose.static_calibration.click_outliers import (
    Screened,
    at_noise,
    noise_of,
    rest_on,
    screen,
    surprise_at,
)
from worldpose.static_calibration.curvature_correction import tangent_at
from worldpose.static_calibration.ill_conditioned import fit_and_bends
from worldpose.static_calibration.line_refinement import LineRefinement, refine_on_lines
from worldpose.static_calibration.parameters import CameraEstimate
from worldpose.static_calibration.settings import StaticCalibrationSettings

_WIDER: Final = (2.0, 4.0)
"""Factors on the click noise, tried in turn where the clicks do not lead to the lines [1]; the last
is the largest plausible one."""
_AS_STATED: Final = 1.5
"""Noise ratio from the lines up to which the stated noise stands [1]: the median residual of a few
clicks exceeds it by chance."""


def refine_and_judge(
    problem: Problem,
    fit: Screened,
    pitch: PitchTemplate,
    picture: NDArray[np.uint8],
    settings: StaticCalibrationSettings,
) -> tuple[Screened, LineRefinement]:
    """Return stage 2 with inliers chosen by the painted lines, and stage 3 from there.

    A few clicks close together determine neither their own noise nor the outliers among them. The
    lines do: a camera fitted to the lines gives the residual of every click. Where the search finds
    no lines, or the lines contradict the clicks, it retries with twice and four times the stated
    noise, then without one click at a time. If every attempt fails, the clicks decide the camera.

    Args:
        problem: clicks, noise and prior.
        fit: stage 2.
        pitch: the template.
        picture: image of the camera.
        settings: noise and thresholds of outliers.
    """
    first = _refined(_estimate(problem, fit), pitch, picture, settings)
    tried = [(fit, first)]
    for factor in _WIDER:
        if tried[-1][1].refined:
            break
        wider, rough = at_noise(problem, factor, settings)
        other = screen(wider, fit.row, rough)
        tried.append((other, _refined(_estimate(wider, other), pitch, picture, settings)))
    if not tried[-1][1].refined:
        tried += sorted(
            (
                (other, _refined(_estimate(problem, other), pitch, picture, settings))
                for other in _without_one(problem, fit, settings)
            ),
            key=lambda one: -one[1].effective_samples,
        )
    for other, lines in tried:
        judged = _judged(problem, other, lines, pitch, picture, settings)
        if judged is not None:
            return judged
    return fit, first


def _without_one(
    problem: Problem, fit: Screened, settings: StaticCalibrationSettings
) -> Iterator[Screened]:
    """Yield the leave-one-out fits at the largest noise."""
    wider, _ = at_noise(problem, _WIDER[-1], settings)
    for index in range(len(problem.evidence.points)):
        inliers = np.arange(len(problem.evidence.points)) != index
        with suppress(InputError):
            yield rest_on(wider, fit.row, inliers, fit.markings)


def _judged(
    problem: Problem,
    fit: Screened,
    lines: LineRefinement,
    pitch: PitchTemplate,
    picture: NDArray[np.uint8],
    settings: StaticCalibrationSettings,
) -> tuple[Screened, LineRefinement] | None:
    """Return the fit to the inliers of a camera refined on lines, and stage 3 from there.

    None without such a camera, or with too few inliers.
    """
    if not lines.refined:
        return None
    row = row_of(lines.estimate.camera)
    told = noise_of(problem, row)
    factor = 1.0 if told <= _AS_STATED else min(told, _WIDER[-1])
    wider = at_noise(problem, factor, settings)[0]
    surprise = surprise_at(wider, lines.estimate)
    inliers = surprise < settings.wrong_click
    if len(inliers) and 1.0 - inliers.mean() > settings.max_wrong_share:
        return None
    fit = rest_on(wider, row, inliers, fit.markings)
    # Pixels drawn along a detected line measure the same paint less accurately.
    read = {each.name for each in lines.markings if each.found}
    other = np.array([name not in read for name in problem.evidence.markings], dtype=bool)
    rest = wider.only(inliers, fit.markings & other)
    scale = fit.noise_scale
    known = tangent_at(rest, row, scale)
    again = _refined(known, pitch, picture, settings, begin=lines.estimate)
    if again.bars is None:
        return None
    best = fit_and_bends(rest, again.estimate.camera, again.bars, scale)
    fit = replace(fit, surprise=surprise, noise_scale=factor * scale)
    return fit, replace(again, estimate=best)


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
