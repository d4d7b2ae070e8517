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
from scipy.stats import chi2

from worldpose.cameras import Camera
from worldpose.errors import InputError
from worldpose.pitch import PitchTemplate
from worldpose.static_calibration.edges import brightness
from worldpose.static_calibration.line_samples import (
    LineSamples,
    apart,
    sample_markings,
    thinned,
)
from worldpose.static_calibration.line_search import Found, LineRefinementSettings, LineSearch
from worldpose.static_calibration.parameters import CameraEstimate

__all__ = ["LineRefinement", "LineRefinementSettings", "MarkingFit", "refine_on_lines"]

SURVEY_ERROR: Final = 0.006
"""Default of how far surveyed points are from the painted ones, each axis [m]."""


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
        contradictory: were lines found that the start's covariance does not allow.
        markings: those in the picture.
        rms: of all samples found, measured minus projected across the line [px]; NaN without any.
        correlation: of neighbouring residuals along a marking [1].
        effective_samples: independent ones that those found are worth [1].
    """

    estimate: CameraEstimate
    refined: bool
    reason: str
    contradictory: bool
    markings: tuple[MarkingFit, ...]
    rms: float
    correlation: float
    effective_samples: float


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
    search = LineSearch(start, grey, survey_error, settings)
    everywhere = sample_markings(pitch, _WORLD_SPACING)
    begin = begin or start
    seen = search.look(begin.camera, everywhere)
    index = apart(everywhere, thinned(seen, everywhere, settings.spacing, settings.samples))
    if len(index) < settings.least_found or not search.free.any():
        return _kept(start, "no painted line is in the picture")
    samples = everywhere[index]
    found = search.run(begin, samples)
    if found is None:
        return _kept(start, "too few painted lines were found")
    inliers = found.adjusted.weights > _INLIER
    count, visible = int(inliers.sum()), int(found.seen.visible.sum())
    if count < max(settings.least_found, settings.least_share * visible):
        return _kept(start, f"only {count} of {visible} samples of lines were found")
    correlation, excess = _noise(found, samples, inliers)
    independent = (1.0 - correlation) / (1.0 + correlation)
    # Neighbours tell partly the same: their variances grow until together they tell what they do.
    found = search.reweighed(found, samples, excess / independent)
    distance = search.distance(found.camera)
    if chi2.sf(distance**2, search.free.sum()) < settings.contradiction:
        return _kept(
            start,
            "the lines contradict the clicks: the camera would move by "
            f"{distance:.1f} standard deviations",
            contradictory=True,
        )
    return LineRefinement(
        estimate=CameraEstimate(found.camera, search.covariance_of(found)),
        refined=True,
        reason="",
        contradictory=False,
        markings=_markings(samples, found, inliers),
        rms=float(np.sqrt(np.mean(found.adjusted.residuals[inliers] ** 2))),
        correlation=correlation,
        effective_samples=count * independent,
    )


_WORLD_SPACING: Final = 0.2
"""Between samples before they are thinned [m]; the nearest paint has 40 px a metre."""
_INLIER: Final = 0.25
"""Weight above which a sample counts as found: within one scale of the loss [1]."""
_MOST_CORRELATED: Final = 0.95


def _check_size(camera: Camera, grey: NDArray[np.uint8]) -> None:
    width, height = (int(n) for n in camera.image_size)
    if grey.shape != (height, width):
        raise InputError(
            "refine_on_lines: picture",
            expected=f"{width} x {height} px, as the camera's pictures",
            found=f"{grey.shape[1]} x {grey.shape[0]}",
            todo="Give a picture of this camera in its full size.",
        )


def _noise(found: Found, samples: LineSamples, inliers: NDArray[np.bool_]) -> tuple[float, float]:
    """Return how neighbouring residuals correlate, and how much larger than expected they are."""
    scaled = np.where(inliers, found.adjusted.residuals / np.sqrt(found.measured.variances), 0.0)
    excess = float(np.mean(scaled[inliers] ** 2))
    pairs = inliers[1:] & inliers[:-1] & (np.diff(samples.marking) == 0)
    products = float(np.mean((scaled[1:] * scaled[:-1])[pairs])) if pairs.any() else 0.0
    return float(np.clip(products / excess, 0.0, _MOST_CORRELATED)), max(excess, 1.0)


def _markings(
    samples: LineSamples, found: Found, inliers: NDArray[np.bool_]
) -> tuple[MarkingFit, ...]:
    """Return how each marking in the picture was found."""
    fits = []
    visible, residuals = found.seen.visible, found.adjusted.residuals
    for index in np.unique(samples.marking[visible]):
        mine = visible & (samples.marking == index)
        there = mine & inliers
        rms = float(np.sqrt(np.mean(residuals[there] ** 2))) if there.any() else float("nan")
        fits.append(MarkingFit(samples.names[index], int(mine.sum()), int(there.sum()), rms))
    return tuple(fits)


def _kept(start: CameraEstimate, reason: str, contradictory: bool = False) -> LineRefinement:
    nan = float("nan")
    return LineRefinement(start, False, reason, contradictory, (), nan, nan, 0.0)
