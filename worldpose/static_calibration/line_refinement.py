"""Stage 3: a camera refined on the painted lines of its picture (C4).

The paper looks samples of the markings up in a map of the distance to the nearest edge pixel. Here
each sample is looked for across its own projected line, which tells the side as well as the
distance, keeps apart markings that lie near each other, and has no half-width and no rounding in
it. `benchmarks/static_calibration.py` measures both.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Final

import numpy as np
from numpy.typing import NDArray
from scipy.special import chdtrc

from worldpose.cameras import Camera
from worldpose.errors import InputError
from worldpose.pitch import PitchTemplate
from worldpose.static_calibration.edges import brightness
from worldpose.static_calibration.line_profiles import Bars
from worldpose.static_calibration.line_samples import (
    sample_markings,
    thinned,
)
from worldpose.static_calibration.line_search import Found, LineSearch
from worldpose.static_calibration.line_settings import SURVEY_ERROR, LineRefinementSettings
from worldpose.static_calibration.parameters import CameraEstimate

Floats = NDArray[np.float64]


@dataclass(frozen=True)
class MarkingFit:
    """How one marking was found.

    Attributes:
        name: of the line or arc.
        samples: in the picture.
        found: of them, where the fit puts them.
        rms: of those found, measured minus projected across the line [px]; NaN if there are none.
    """

    name: str
    samples: int
    found: int
    rms: float


@dataclass(frozen=True, eq=False)
class LineRefinement:
    """A camera after its lines, or the start and why it was kept.

    Attributes:
        estimate: the refined camera; the start where it was kept.
        refined: whether the lines were used.
        reason: why not; empty if they were.
        markings: those in the picture.
        rms: of all samples found, measured minus projected across the line [px]; NaN without any.
        correlation: of neighbouring residuals along a marking, mean over the samples [1].
        effective_samples: independent ones that those found are worth [1].
        bars: what the camera rests on; None where the start was kept.
    """

    estimate: CameraEstimate
    refined: bool
    reason: str
    markings: tuple[MarkingFit, ...]
    rms: float
    correlation: float
    effective_samples: float
    bars: Bars | None


def refine_on_lines(
    start: CameraEstimate,
    pitch: PitchTemplate,
    picture: NDArray[np.uint8],
    settings: LineRefinementSettings | None = None,
    *,
    survey_error: float = SURVEY_ERROR,
    begin: CameraEstimate | None = None,
) -> LineRefinement:
    """Return the camera that the painted lines and what was known before agree on.

    What is looked for, and how far off, follows from the start's covariance: samples whose
    projection is well known come first, and what they tell brings the others within reach.

    Args:
        start: from clicks; its covariance is the Gaussian prior, and parameters without variance
            stay as they are.
        pitch: the template.
        picture: (height, width) or (height, width, 3) RGB.
        settings: the defaults if None.
        survey_error: of the template's points from the painted ones, each axis, standard
            deviation [m].
        begin: where to look first, where more is known than the prior; the start if None.

    Raises:
        InputError: the picture is not one of the start's camera.
    """
    settings = settings or LineRefinementSettings()
    grey = brightness(picture)
    _check_size(start.camera, grey)
    search = LineSearch(start, pitch, grey, survey_error, settings)
    everywhere = sample_markings(pitch, _WORLD_SPACING)
    begin = begin or start
    seen = search.look(begin.camera, everywhere)
    index = thinned(seen, everywhere, settings.spacing, settings.samples)
    index = index[search.clear(begin.camera, everywhere[index], seen[index])]
    if len(index) < settings.least_found or not search.free.any():
        return _kept(start, "no painted line is in the picture")
    found = search.run(begin, everywhere[index])
    if found is None:
        return _kept(start, "too few painted lines were found")
    inliers = found.adjusted.weights > _INLIER
    inliers &= _there(found, inliers, settings.least_share)
    count, visible = int(inliers.sum()), int(found.seen.visible.sum())
    if count < max(settings.least_found, settings.least_share * visible):
        return _kept(start, f"only {count} of {visible} samples of lines were found")
    correlation, excess = _noise(found, inliers)
    independent = (1.0 - correlation) / (1.0 + correlation)
    # Neighbours tell partly the same: their variances grow until together they tell what they do.
    found = search.reweighed(found, inliers, excess / independent)
    distance = search.distance(found.camera)
    if chdtrc(search.free.sum(), distance**2) < settings.contradiction:
        return _kept(
            start,
            "the lines contradict the clicks: the camera would move by "
            f"{distance:.1f} standard deviations",
        )
    return LineRefinement(
        estimate=CameraEstimate(found.camera, search.covariance_of(found)),
        refined=True,
        reason="",
        markings=_markings(found, inliers),
        rms=float(np.sqrt(np.mean(found.adjusted.residuals[inliers] ** 2))),
        correlation=float(correlation[inliers].mean()),
        effective_samples=float(independent[inliers].sum()),
        bars=search.bars_of(found),
    )


_WORLD_SPACING: Final = 0.2
"""Between samples before they are thinned [m]; the nearest paint has 40 px a metre."""
_INLIER: Final = 0.25
"""Weight above which a sample counts as found: within one scale of the loss [1]."""
_MOST_CORRELATED: Final = 0.95
_OWN_WORTH: Final = 20.0
"""Residuals of a marking that the expected noise is worth when its noise is told [1]."""
_LEAST_KEPT: Final = 0.5
"""Share of the samples that a fit leaves to tell the noise, at least [1]."""


def _check_size(camera: Camera, grey: NDArray[np.uint8]) -> None:
    width, height = (int(n) for n in camera.image_size)
    if grey.shape != (height, width):
        raise InputError(
            "refine_on_lines: picture",
            expected=f"{width} x {height} px, as the camera's pictures",
            found=f"{grey.shape[1]} x {grey.shape[0]}",
            todo="Give a picture of this camera in its full size.",
        )


def _there(found: Found, inliers: NDArray[np.bool_], least: float) -> NDArray[np.bool_]:
    """Return which samples (n,) are of markings of which enough was found.

    Of a marking that is not there, something else is found here or there, and moves the camera.
    """
    marking, count = found.samples.marking, len(found.samples.names)
    seen = np.bincount(marking, found.seen.visible, count)
    there = np.bincount(marking, inliers, count)
    return np.asarray((there >= least * seen)[marking])


def _noise(found: Found, inliers: NDArray[np.bool_]) -> tuple[Floats, Floats]:
    """Return how neighbouring residuals correlate, and how much larger than expected they are.

    Both for every sample (n,), from all of its marking: grass is rougher about a far line that is
    as wide as a pixel than about a near one, and neighbours there share it.
    """
    marking = found.samples.marking
    scaled = np.where(inliers, found.adjusted.residuals / np.sqrt(found.measured.variances), 0.0)
    pairs = inliers[1:] & inliers[:-1] & (np.diff(marking) == 0)

    def total(values: Floats, labels: NDArray[np.int64]) -> Floats:
        return np.bincount(labels, values, len(found.samples.names)).astype(np.float64)

    # What the fit has spent on itself is missing from its residuals.
    used = float(inliers.sum())
    kept = max(1.0 - found.adjusted.spent / used, _LEAST_KEPT)
    squares = total(scaled**2, marking) / kept
    products = total(np.where(pairs, scaled[1:] * scaled[:-1], 0.0), marking[1:])
    # Of few samples the mean square of all is more than their own.
    mean = squares.sum() / used + np.finfo(np.float64).tiny
    correlation = products / np.maximum(squares, _OWN_WORTH * mean)
    excess = (squares + _OWN_WORTH) / (total(inliers.astype(np.float64), marking) + _OWN_WORTH)
    return np.clip(correlation, 0.0, _MOST_CORRELATED)[marking], excess[marking]


def _markings(found: Found, inliers: NDArray[np.bool_]) -> tuple[MarkingFit, ...]:
    """Return how each marking in the picture was found."""
    samples, fits = found.samples, []
    visible, residuals = found.seen.visible, found.adjusted.residuals
    for index in np.unique(samples.marking[visible]):
        mine = visible & (samples.marking == index)
        there = mine & inliers
        rms = float(np.sqrt(np.mean(residuals[there] ** 2))) if there.any() else float("nan")
        fits.append(MarkingFit(samples.names[index], int(mine.sum()), int(there.sum()), rms))
    return tuple(fits)


def _kept(start: CameraEstimate, reason: str) -> LineRefinement:
    nan = float("nan")
    return LineRefinement(start, False, reason, (), nan, nan, 0.0, None)
