"""Stage 3: refinement of a camera on the painted lines of its image.

The paper looks up samples of the markings in a map of the distance to the nearest edge pixel. This
module searches each sample across its own projected line, which gives a signed offset, separates
neighboring markings, and adds no half-width and no rounding.
`benchmarks/run.py static_calibration` measures both.

Where clicks are noisier than stated, or wrong, the painted lines decide.
"""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import suppress
from dataclasses import dataclass, replace
from typing import Final

import numpy as np
from scipy.special import chdtrc

from data_contracts.arrays import Flags, Floats, Image, Integers
from worldpose.errors import InputError
from worldpose.pitch.template import PitchTemplate, Surface
from worldpose.static_calibration.click_outliers import (
    Explanation,
    InlierFit,
    fit_given_inliers,
    fit_inliers,
    mahalanobis_distances,
    noise_ratio,
    scale_noise,
)
from worldpose.static_calibration.curvature_correction import (
    ClicksAndBars,
    fit_with_curvature,
    linearize_at,
)
from worldpose.static_calibration.fit import CameraProblem
from worldpose.static_calibration.line_detection import brightness
from worldpose.static_calibration.line_samples import PaintNoise, sample_markings, thin_samples
from worldpose.static_calibration.line_search import Bars, LineFit, LineSearch
from worldpose.static_calibration.parameters import CameraOnPitch
from worldpose.static_calibration.settings import (
    SURVEY_ERROR,
    LineRefinementSettings,
    StaticCalibrationSettings,
)
from worldpose.static_calibration.venue import VenueEvidence, gather_venue_evidence


@dataclass(frozen=True)
class MarkingFit:
    """Detection result of one marking: samples in the image, and inliers found among them.

    `rms` [px] is the root mean square residual of the inliers across the line; NaN without any.
    """

    name: str
    samples: int
    found: int
    rms: float


@dataclass(frozen=True, eq=False)
class LineRefinement:
    """A camera refined on lines, or its start and the reason of the failure.

    Attributes:
        estimate: the refined camera; the start if refinement failed.
        reason: why it failed; empty on success.
        markings: markings in the image.
        rms: root mean square residual of all inliers, measured minus projected across the line
            [px]; NaN without inliers.
        correlation: correlation of neighbouring residuals along a marking, mean over samples [1].
        effective_samples: equivalent number of independent inliers [1].
        bars: bars of the fit; None if refinement failed, as `noise`.
        noise: noise of paint and detection, learned from the residuals.
        venue: what the camera tells about the pitch; None before the final fit.
    """

    estimate: CameraOnPitch
    refined: bool
    reason: str
    markings: tuple[MarkingFit, ...]
    rms: float
    correlation: float
    effective_samples: float
    bars: Bars | None
    noise: PaintNoise | None
    venue: VenueEvidence | None = None


def refine_on_lines(
    start: CameraOnPitch,
    pitch: PitchTemplate,
    picture: Image,
    settings: LineRefinementSettings | None = None,
    *,
    survey_error: float = SURVEY_ERROR,
    begin: CameraOnPitch | None = None,
) -> LineRefinement:
    """Return the most probable camera and surface from the painted lines and a Gaussian prior.

        L* = arg min sum_s rho(o_s(L) / s_s) + d^T C^-1 d

    In place of the paper's distance D[Pi(X'; L)] to extracted lines, o_s [px] is the offset of a
    sample of paint from the projected line, found by `LineSearch`, rho the Geman-McClure loss, and
    d the step from the prior.

    The start's covariance gives samples and search widths: the search begins with samples of small
    projected uncertainty, which reduce the uncertainty of the others.

    Parameters without variance stay fixed. The template's surface is where to linearize;
    `survey_error` is that of its points from the painted ones, each axis, standard deviation [m].
    The search begins at `begin`, if it is more accurate than the start.

    Raises:
        InputError: the image size is not that of the start's camera.
    """
    grey = brightness(picture)
    width, height = (int(n) for n in start.camera.image_size)
    if grey.shape != (height, width):
        raise InputError(
            "refine_on_lines: picture",
            expected=f"an image of {width} x {height} px, the camera's image_size",
            found=f"{grey.shape[1]} x {grey.shape[0]}",
            todo="Give an image of this camera in its full size.",
        )
    search = LineSearch(start, pitch, grey, survey_error, settings or LineRefinementSettings())
    return _refine_by_search(search, pitch, begin or start)


def _refine_by_search(
    search: LineSearch, pitch: PitchTemplate, begin: CameraOnPitch
) -> LineRefinement:
    start, settings = search.start, search.settings
    # The nearest paint has 40 px per metre.
    everywhere = sample_markings(pitch, 0.2)
    everywhere = everywhere.raise_surface(begin.surface - pitch.surface)
    seen = search.look(begin.camera, everywhere)
    index = thin_samples(seen, everywhere, settings.spacing_px, settings.samples)
    index = index[search.clear(begin.camera, everywhere[index], seen[index])]
    if len(index) < settings.min_found or not search.free.any():
        return _keep_start(start, "no painted line is in the picture")
    found = search.run(begin, everywhere[index])
    if found is None:
        return _keep_start(start, "too few painted lines were found")
    found = search.learn_noise(found)
    # Within one scale of the loss.
    inliers = found.adjusted.weights > 0.25
    # Chance detections on a marking that is absent would move the camera.
    marking, names = found.samples.marking, len(found.samples.names)
    seen_there = np.bincount(marking, found.seen.visible, names)
    found_there = np.bincount(marking, inliers, names)
    inliers &= (found_there >= settings.min_inlier_share * seen_there)[marking]
    count, visible = int(inliers.sum()), int(found.seen.visible.sum())
    if count < max(settings.min_found, settings.min_inlier_share * visible):
        return _keep_start(start, f"only {count} of {visible} samples of lines were found")
    correlation, excess = _residual_noise(found, inliers)
    independent = (1.0 - correlation) / (1.0 + correlation)
    # Neighbours are correlated: larger variances give them their joint information.
    found = search.reweight(found, inliers, excess / independent)
    distance = search.distance(found)
    if chdtrc(search.free.sum(), distance**2) < settings.contradiction:
        return _keep_start(
            start,
            "the lines contradict the clicked or drawn pixels: the camera would move "
            f"{distance:.1f} standard deviations",
        )
    return LineRefinement(
        estimate=CameraOnPitch(found.camera, found.surface, search.covariance(found)),
        refined=True,
        reason="",
        markings=_marking_fits(found, inliers),
        rms=float(np.sqrt(np.mean(found.adjusted.residuals[inliers] ** 2))),
        correlation=float(correlation[inliers].mean()),
        effective_samples=float(independent[inliers].sum()),
        bars=search.collect_bars(found),
        noise=search.noise,
    )


def _residual_noise(found: LineFit, inliers: Flags) -> tuple[Floats, Floats]:
    """Return correlation and excess variance of neighbouring residuals.

    Both per sample (n,), from its whole marking: grass is rougher about a far line as narrow as a
    pixel than about a near one, and affects neighbours alike.
    """
    prior = 20.0  # weight of the expected noise of a marking [residuals]
    marking = found.samples.marking
    scaled = np.where(inliers, found.adjusted.residuals / np.sqrt(found.variances), 0.0)
    pairs = inliers[1:] & inliers[:-1] & (np.diff(marking) == 0)

    def total(values: Floats, labels: Integers) -> Floats:
        return np.bincount(labels, values, len(found.samples.names)).astype(np.float64)

    # The fit's degrees of freedom are missing from its residuals.
    used = float(inliers.sum())
    kept = max(1.0 - found.adjusted.spent / used, 0.5)
    squares = total(scaled**2, marking) / kept
    products = total(np.where(pairs, scaled[1:] * scaled[:-1], 0.0), marking[1:])
    # For a few samples, the mean square of all samples is the better estimate.
    mean = squares.sum() / used + np.finfo(np.float64).tiny
    correlation = products / np.maximum(squares, prior * mean)
    excess = (squares + prior) / (total(inliers.astype(np.float64), marking) + prior)
    return np.clip(correlation, 0.0, 0.95)[marking], excess[marking]


def _marking_fits(found: LineFit, inliers: Flags) -> tuple[MarkingFit, ...]:
    """Return the detection result of each marking in the image."""
    samples, fits = found.samples, []
    visible, residuals = found.seen.visible, found.adjusted.residuals
    for index in np.unique(samples.marking[visible]):
        mine = visible & (samples.marking == index)
        there = mine & inliers
        rms = float(np.sqrt(np.mean(residuals[there] ** 2))) if there.any() else float("nan")
        fits.append(MarkingFit(samples.names[index], int(mine.sum()), int(there.sum()), rms))
    return tuple(fits)


def _keep_start(start: CameraOnPitch, reason: str) -> LineRefinement:
    nan = float("nan")
    return LineRefinement(start, False, reason, (), nan, nan, 0.0, None, None)


_NOISE_FACTORS: Final = (2.0, 4.0)
"""Factors on the click noise, tried in turn where the clicks do not lead to the lines [1]; the last
is the largest plausible one."""


def refine_and_judge(
    found: Explanation, pitch: PitchTemplate, picture: Image
) -> tuple[Explanation, LineRefinement]:
    """Return stage 2 with inliers chosen by the painted lines of an image, and stage 3 from there.

    Its clicks are then on the surface that the lines show. A few clicks close together determine
    neither their own noise nor the outliers among them. The lines do: a camera fitted to the lines
    gives the residual of every click. Where the search finds no lines, or the lines contradict the
    clicks, it retries with twice and four times the stated noise, then without one click at a time.
    If every attempt fails, the clicks decide the camera.
    """
    problem, fit, settings = found.problem, found.fit, found.settings

    def refine(problem: CameraProblem, fit: InlierFit) -> LineRefinement:
        return _refine(_start_from_clicks(problem, fit, pitch), pitch, picture, settings)

    first = refine(problem, fit)
    tried = [(fit, first)]
    for factor in _NOISE_FACTORS:
        if tried[-1][1].refined:
            break
        wider, rough = scale_noise(problem, factor, settings)
        other = fit_inliers(wider, fit.row, rough)
        tried.append((other, refine(wider, other)))
    if not tried[-1][1].refined:
        widest = scale_noise(problem, _NOISE_FACTORS[-1], settings)[0]
        tried += sorted(
            ((other, refine(widest, other)) for other in _leave_one_out_fits(widest, fit)),
            key=lambda one: -one[1].effective_samples,
        )
    for other, lines in tried:
        judged = _judge(replace(found, fit=other), lines, pitch, picture)
        if judged is not None:
            return judged
    return found, first


def _start_from_clicks(
    problem: CameraProblem, fit: InlierFit, pitch: PitchTemplate
) -> CameraOnPitch:
    """Return camera and surface of a fit to clicks, with their covariance to second order."""
    kept = problem.select(fit.inliers, fit.markings)
    start = linearize_at(kept, fit.row, fit.noise_scale, Surface.of(pitch))
    whole = start.covariance.copy()
    whole[:-2, :-2] += fit.covariance - fit.tangent_covariance
    return replace(start, covariance=whole)


def _leave_one_out_fits(problem: CameraProblem, fit: InlierFit) -> Iterator[InlierFit]:
    """Yield the leave-one-out fits of a fit to a problem."""
    for index in range(len(problem.evidence.points)):
        inliers = np.arange(len(problem.evidence.points)) != index
        with suppress(InputError):
            yield fit_given_inliers(problem, fit.row, inliers, fit.markings)


def _judge(
    found: Explanation, lines: LineRefinement, pitch: PitchTemplate, picture: Image
) -> tuple[Explanation, LineRefinement] | None:
    """Return the fit to the inliers of a camera refined on lines, and stage 3 from there.

    None if no such camera exists, or with too few inliers.
    """
    if not lines.refined:
        return None
    settings, prior = found.settings, Surface.of(pitch)
    problem = _on_surface(found.problem, lines.estimate)
    row = lines.estimate.camera.numbers
    ratio = noise_ratio(problem, row)
    # The median residual of a few clicks exceeds the stated noise by chance.
    factor = 1.0 if ratio <= 1.5 else min(ratio, _NOISE_FACTORS[-1])
    wider = scale_noise(problem, factor, settings)[0]
    mahalanobis = mahalanobis_distances(wider, lines.estimate.estimate)
    inliers = mahalanobis < settings.wrong_click
    if len(inliers) and 1.0 - inliers.mean() > settings.max_wrong_share:
        return None
    fit = fit_given_inliers(wider, row, inliers, found.fit.markings)
    # Pixels drawn along a detected line measure the same paint less accurately.
    read = {each.name for each in lines.markings if each.found}
    other = np.array([name not in read for name in problem.evidence.markings], dtype=bool)
    if not len(inliers):
        # Without points the drawn pixels hold the camera while the lines are searched again.
        other[:] = True
        wider = scale_noise(problem, _NOISE_FACTORS[-1], settings)[0]
    rest = wider.select(inliers, fit.markings & other)
    scale = fit.noise_scale
    known = linearize_at(rest, row, scale, prior)
    again = _refine(known, pitch, picture, settings, begin=lines.estimate)
    if again.bars is None:
        return None
    evidence = ClicksAndBars(rest, scale, again.bars, prior)
    best = fit_with_curvature(evidence, again.estimate.camera)
    fit = replace(fit, mahalanobis=mahalanobis, noise_scale=factor * scale)
    found = replace(found, problem=_on_surface(problem, best), fit=fit)
    return found, replace(again, estimate=best, venue=gather_venue_evidence(evidence, best))


def _on_surface(problem: CameraProblem, found: CameraOnPitch) -> CameraProblem:
    return replace(problem, evidence=problem.evidence.on_surface(found.surface))


def _refine(
    start: CameraOnPitch,
    pitch: PitchTemplate,
    picture: Image,
    settings: StaticCalibrationSettings,
    begin: CameraOnPitch | None = None,
) -> LineRefinement:
    return refine_on_lines(
        start,
        pitch,
        picture,
        settings.line_refinement,
        survey_error=settings.survey_error_m,
        begin=begin,
    )
