"""Coarse-to-fine search for painted lines, samples of small uncertainty first (C4).

`LineSearch` alternates between measuring bars across projected markings and a robust least-squares
fit of the camera to them, with a prior. `Bars` are the result: measured bars of painted lines, and
their residuals at nearby cameras.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import cached_property
from typing import Final

import numpy as np
from numpy.typing import NDArray

from data_contracts.arrays import Floats, Integers
from worldpose.compiled import compile_kernel
from worldpose.geometry import Camera
from worldpose.pitch import PitchTemplate
from worldpose.static_calibration.line_detection import CANDIDATES, CLEARANCE, find_bars, fit_bars
from worldpose.static_calibration.line_samples import (
    LineSamples,
    ProjectedLines,
    clear,
    project_lines,
    white_structures,
)
from worldpose.static_calibration.parameters import (
    CameraEstimate,
    project_with_jacobian,
    step_between,
    step_camera,
    step_jacobian,
)
from worldpose.static_calibration.settings import LineRefinementSettings

_STRIDE: Final = 0.1
"""Step along a marking for finite differences of its projection [m]."""


@dataclass(frozen=True, eq=False)
class Bars:
    """Bars in the image, each with its marking sample.

    Attributes:
        samples: (n,) marking samples.
        pixels: (n, 2) positions of the bars [px].
        noise: (n,) across the marking, standard deviation [px].
        by_paint: (n, 7) derivatives of the marking by the paint's unknowns.
        unknowns: (n, 7) numbers of these, see `ProjectedLines`.
    """

    samples: LineSamples
    pixels: Floats
    noise: Floats
    by_paint: Floats
    unknowns: NDArray[np.int64]

    @cached_property
    def _paint(self) -> Floats:
        """Orthonormal basis of the paint's unknowns, in residuals and priors."""
        numbers, index = np.unique(self.unknowns, return_inverse=True)
        count = len(self.noise)
        columns = np.zeros((count + len(numbers), len(numbers)))
        np.add.at(columns, (np.arange(count)[:, None], index), self.by_paint / self.noise[:, None])
        columns[count:] = np.eye(len(numbers))
        return np.linalg.qr(columns)[0]

    def whiten_residuals(self, camera: Camera) -> tuple[Floats, Floats]:
        """Return whitened residuals (m,) of markings against bars, and derivatives (m, 12).

        Residuals are distances to the nearest point: a marking that slides along itself fits as
        well as before. Residuals and derivatives are projected off the paint's unknowns and their
        priors, so that m is larger than the number of bars.
        """
        before, after = (camera.project(self.samples.beside(way)) for way in (-_STRIDE, _STRIDE))
        middle, jacobian = project_with_jacobian(camera, self.samples.points_world)
        along, bend = 0.5 * (after - before), after + before - 2.0 * middle
        away = self.pixels - middle
        way = (away * along).sum(-1) / (along**2).sum(-1)
        normal = np.stack([-along[:, 1], along[:, 0]], axis=-1)
        normal /= np.linalg.norm(normal, axis=-1, keepdims=True)
        off = ((0.5 * way[:, None] ** 2 * bend - away) * normal).sum(-1)
        moves = np.einsum("ni,nij->nj", normal, jacobian)
        both = np.zeros((len(self._paint), 1 + moves.shape[1]))
        both[: len(off), 0], both[: len(off), 1:] = off, moves
        both[: len(off)] /= self.noise[:, None]
        both -= self._paint @ (self._paint.T @ both)
        return both[:, 0], both[:, 1:]


@dataclass(frozen=True, eq=False)
class LineStep:
    """A step of the free parameters, its information and its residuals.

    Attributes:
        step: (f,).
        information: (f, f) inverse covariance of the step, marginalized over the paint's unknowns.
        residuals: (n,) after subtraction of the paint's unknowns [px].
        weights: (n,) of the robust loss [1].
        spent: degrees of freedom that the fit takes from the samples [1].
    """

    step: Floats
    information: Floats
    residuals: Floats
    weights: Floats
    spent: float


def adjust(
    offsets: Floats,
    variances: Floats,
    by_camera: Floats,
    by_paint: Floats,
    unknowns: Integers,
    prior: tuple[Floats, Floats],
    scales: tuple[float, ...],
) -> LineStep:
    """Return the step that moves projected markings onto measured ones.

    Iteratively reweighted least squares with the Geman-McClure loss. The paint's unknowns have unit
    Gaussian priors: a thousand samples of one line determine its paint, but the camera only within
    the survey error of the line's ends.

    Args:
        offsets: (n,) measured minus projected, along the normal [px]; NaN = no measurement.
        variances: (n,) [px^2].
        by_camera: (n, f) derivatives of the projection by the free parameters.
        by_paint: (n, k) derivatives of the projection by unknowns of the paint.
        unknowns: (n, k) indices of these unknowns.
        prior: information (f, f) and mean (f,) of the step.
        scales: of the loss [standard deviations], one per iteration.
    """
    known = np.isfinite(offsets)
    weights = known.astype(np.float64)
    numbers, index = np.unique(unknowns, return_inverse=True)
    free = by_camera.shape[1]
    size = free + len(numbers)
    shift = np.where(known, offsets, 0.0)
    solution = np.zeros(size)
    normal = np.empty((size, size))
    told = np.empty((size, size))
    residuals = shift
    for scale in scales:
        if scale < np.inf:
            squared = residuals**2 / variances / scale**2
            weights = np.where(known, 1.0 / (1.0 + squared) ** 2, 0.0)
        normal[:] = 0.0
        right = np.zeros(size)
        _accumulate(shift, weights / variances, by_camera, by_paint, index, normal, right)
        told[:] = normal
        normal[:free, :free] += prior[0]
        right[:free] += prior[0] @ prior[1]
        normal[np.arange(free, size), np.arange(free, size)] += 1.0
        solution = np.linalg.solve(normal, right)
        residuals = shift - by_camera @ solution[:free]
        residuals -= (by_paint * solution[free:][index]).sum(axis=1)
    corner = normal[:free, free:]
    information = normal[:free, :free] - corner @ np.linalg.solve(normal[free:, free:], corner.T)
    spent = float(np.trace(np.linalg.solve(normal, told)))
    return LineStep(solution[:free], 0.5 * (information + information.T), residuals, weights, spent)


@compile_kernel
def _accumulate(
    shift: Floats,
    weights: Floats,
    by_camera: Floats,
    by_paint: Floats,
    index: Integers,
    normal: Floats,
    right: Floats,
) -> None:
    """Add the samples to the normal equations: the camera first, then the paint's unknowns."""
    free, paints = by_camera.shape[1], by_paint.shape[1]
    for i in range(len(shift)):
        w = weights[i]
        if w == 0.0:
            continue
        for a in range(free):
            left = w * by_camera[i, a]
            right[a] += left * shift[i]
            for b in range(free):
                normal[a, b] += left * by_camera[i, b]
            for b in range(paints):
                normal[a, free + index[i, b]] += left * by_paint[i, b]
                normal[free + index[i, b], a] += left * by_paint[i, b]
        for a in range(paints):
            left = w * by_paint[i, a]
            right[free + index[i, a]] += left * shift[i]
            for b in range(paints):
                normal[free + index[i, a], free + index[i, b]] += left * by_paint[i, b]


_MAX_PASSES: Final = 8
"""Maximum iterations of search and fit; one or two from ordinary clicks."""
_COARSE_ERROR: Final = 1.0
"""Standard deviation of a detected bar before its subpixel fit [px]."""
_FEW: Final = 500
"""Approximate number of samples in coarse iterations [1]."""
_MIN_REACH: Final = 1.5
"""Margin of the search beyond three standard deviations [px]."""
_FINE: Final = 5.5
"""Search width up to which bars are fitted to subpixel accuracy [px]."""
_BEST: Final = 1.0 / 3.0
"""Share of the samples to search where all have a large uncertainty [1]."""
_MOSTLY: Final = 0.8
"""Minimum share of the samples within this search width [1]."""
_MAX_FITS: Final = 4
"""Maximum fits to subpixel bars, each relinearized at the last camera."""
_SETTLED: Final = 0.02
"""Maximum sample displacement at which these fits stop [px]."""
_NO_WEIGHT: Final = 1e-3
"""Weight up to which a sample is excluded from the result [1]."""
_READING: Final = 0.05
"""Minimum standard deviation of a fitted bar [px]."""
_COARSE_SCALES: Final = (np.inf, 12.0, 6.0, 4.0, 3.0, 3.0)
_FINE_SCALES: Final = (12.0, 6.0)
"""Decreasing scales of the loss [standard deviations]: outliers lose their influence one by one,
which avoids the nearest local minimum."""


@dataclass(frozen=True, eq=False)
class MeasuredBars:
    """Bars across samples: offsets (n,) along the normals [px] and their variances (n,) [px^2]."""

    offsets: Floats
    variances: Floats


@dataclass(frozen=True, eq=False)
class LineFit:
    """A camera, its samples, their projections, the bars measured there, and the last fit."""

    camera: Camera
    samples: LineSamples
    seen: ProjectedLines
    measured: MeasuredBars
    adjusted: LineStep


class LineSearch:
    """Line search in one image, from a start with a Gaussian prior."""

    def __init__(
        self,
        start: CameraEstimate,
        pitch: PitchTemplate,
        grey: NDArray[np.uint8],
        survey_error: float,
        settings: LineRefinementSettings,
    ) -> None:
        self.start, self.grey, self.settings = start, grey, settings
        self.survey_error = survey_error
        self.whites = white_structures(pitch)
        spread = np.sqrt(np.diag(start.covariance))
        self.free = spread > 0.0
        covariance = start.covariance[np.ix_(self.free, self.free)]
        scale = spread[self.free]
        # Scaled, since the squares of radians and pixels differ by a factor of a million.
        shape = covariance / np.outer(scale, scale)
        inverse: Floats = np.linalg.inv(shape + 1e-12 * np.eye(len(scale)))
        self.information = inverse / np.outer(scale, scale)

    def look(self, camera: Camera, samples: LineSamples) -> ProjectedLines:
        """Return the samples projected into a camera's image."""
        s = self.settings
        return project_lines(camera, samples, s.line_width_m, self.survey_error, s.line_shift_px)

    def clear(
        self, camera: Camera, samples: LineSamples, seen: ProjectedLines
    ) -> NDArray[np.bool_]:
        """Return a mask of the samples (n,) with grass on both sides in the image."""
        room, half = 0.5 * seen.widths + CLEARANCE, 0.5 * self.settings.line_width_m
        return clear(camera, self.whites, half, seen.places, room, samples.marking)

    def run(self, begin: CameraEstimate, samples: LineSamples) -> LineFit | None:
        """Return the result of the coarse-to-fine search; None without lines."""
        camera, covariance = begin.camera, begin.covariance[np.ix_(self.free, self.free)]
        few = samples[np.arange(0, len(samples.marking), max(1, len(samples.marking) // _FEW))]
        found = None
        for left in reversed(range(_MAX_PASSES)):
            chosen = few
            seen = self.look(camera, few)
            if seen.visible.sum() < 0.5 * self.settings.min_found:
                return None
            reach = self._reach(seen, covariance)
            fine = left == 0 or bool((reach <= _FINE)[seen.visible].mean() >= _MOSTLY)
            if fine:
                seen = self.look(camera, samples)
                alone = self.clear(camera, samples, seen)
                chosen, seen = samples[alone], seen[alone]
                reach = self._reach(seen, covariance)
            if not seen.visible.any():
                return None
            measured = self._measure(seen, reach, fine)
            least = self.settings.min_found * len(chosen.marking) / len(samples.marking)
            if np.isfinite(measured.offsets).sum() < max(least, 1.0):
                return None
            found = self.converge(camera, chosen, seen, measured, fine)
            if fine:
                break
            camera = found.camera
            covariance = np.asarray(np.linalg.inv(found.adjusted.information))
        return found

    def reweight(self, found: LineFit, used: NDArray[np.bool_], inflation: Floats) -> LineFit:
        """Return the fit to the used samples (n,), with variances times `inflation` (n,)."""
        measured = MeasuredBars(
            np.where(used, found.measured.offsets, np.nan), found.measured.variances * inflation
        )
        scales = (2.0 * self.settings.loss_scale, *(self.settings.loss_scale,) * 2)
        adjusted = self._adjust(found.camera, found.seen, measured, scales)
        camera = step_camera(found.camera, self._full_step(adjusted.step))
        return replace(found, camera=camera, measured=measured, adjusted=adjusted)

    def distance(self, camera: Camera) -> float:
        """Return the Mahalanobis distance of a camera from the start."""
        gone = step_between(self.start.camera, camera)[self.free]
        return float(np.sqrt(gone @ self.information @ gone))

    def covariance(self, found: LineFit) -> Floats:
        """Return the (12, 12) covariance of a fit."""
        whole = np.zeros_like(self.start.covariance)
        whole[np.ix_(self.free, self.free)] = np.linalg.inv(found.adjusted.information)
        return np.asarray(0.5 * (whole + whole.T))

    def collect_bars(self, found: LineFit) -> Bars:
        """Return the bars that contribute to a fit."""
        seen, weights = found.seen, found.adjusted.weights
        used = weights > _NO_WEIGHT
        pixels = seen.places + found.measured.offsets[:, None] * seen.normals
        variances = found.measured.variances[used] / weights[used]
        return Bars(
            found.samples[used],
            pixels[used],
            np.sqrt(variances),
            seen.by_paint[used],
            seen.unknowns[used],
        )

    def converge(
        self,
        camera: Camera,
        samples: LineSamples,
        seen: ProjectedLines,
        measured: MeasuredBars,
        fine: bool,
    ) -> LineFit:
        """Return the converged fit to bars at fixed pixels."""
        bars = seen.places + measured.offsets[:, None] * seen.normals
        final = (self.settings.loss_scale,) * 3
        scales: tuple[float, ...] = (*_FINE_SCALES, *final) if fine else _COARSE_SCALES
        for _ in range(_MAX_FITS if fine else 1):
            adjusted = self._adjust(camera, seen, measured, scales)
            scales = (
                2.0 * self.settings.loss_scale,
                self.settings.loss_scale,
                self.settings.loss_scale,
            )
            camera = step_camera(camera, self._full_step(adjusted.step))
            moved = np.abs(seen.by_camera[:, self.free] @ adjusted.step)[seen.visible]
            seen = self.look(camera, samples)
            measured = replace(measured, offsets=((bars - seen.places) * seen.normals).sum(-1))
            if moved.max(initial=0.0) < _SETTLED:
                break
        return LineFit(camera, samples, seen, measured, adjusted)

    def _reach(self, seen: ProjectedLines, covariance: Floats) -> Floats:
        """Return the search widths (n,) of samples along their normals [px]."""
        rows = np.where(seen.visible[:, None], seen.by_camera[:, self.free], 0.0)
        own = np.where(seen.visible, (seen.by_paint**2).sum(-1), 0.0)
        variance = ((rows @ covariance) * rows).sum(-1) + own
        return np.asarray(3.0 * np.sqrt(variance) + _MIN_REACH)

    def _measure(self, seen: ProjectedLines, reach: Floats, fine: bool) -> MeasuredBars:
        """Return the bars matched to the samples, to a subpixel (`fine`) or to a pixel."""
        s, count = self.settings, len(reach)
        # If all uncertainties are large, begin with the third of smallest uncertainty.
        limit = max(s.search_px, float(np.quantile(reach[seen.visible], _BEST)))
        usable = seen.visible & (reach <= limit)
        offsets, strengths = np.empty((count, CANDIDATES)), np.empty((count, CANDIDATES))
        looked = np.where(usable, reach, -1.0)
        find_bars(self.grey, seen.sections, looked, s.contrast, offsets, strengths)
        # A candidate's merit grows with its strength and falls with its Mahalanobis distance.
        away = 3.0 * offsets / reach[:, None]
        with np.errstate(divide="ignore"):
            merit = np.where(np.isnan(offsets), -np.inf, np.log(strengths) - 0.5 * away**2)
        best = offsets[np.arange(count), merit.argmax(axis=1)]
        if not fine:
            return MeasuredBars(best, np.full(count, _COARSE_ERROR**2))
        exact, variances = np.empty(count), np.empty(count)
        fit_bars(self.grey, seen.sections, best, s.contrast, exact, variances)
        return MeasuredBars(exact, variances + _READING**2)

    def _adjust(
        self,
        camera: Camera,
        seen: ProjectedLines,
        measured: MeasuredBars,
        scales: tuple[float, ...],
    ) -> LineStep:
        """Return the step from a camera to the best one."""
        known = np.flatnonzero(seen.visible)
        adjusted = adjust(
            measured.offsets[known],
            measured.variances[known],
            np.ascontiguousarray(seen.by_camera[np.ix_(known, np.flatnonzero(self.free))]),
            np.ascontiguousarray(seen.by_paint[known]),
            seen.unknowns[known],
            self._prior(camera),
            scales,
        )
        residuals, weights = np.full(len(seen.visible), np.nan), np.zeros(len(seen.visible))
        residuals[known], weights[known] = adjusted.residuals, adjusted.weights
        return replace(adjusted, residuals=residuals, weights=weights)

    def _prior(self, camera: Camera) -> tuple[Floats, Floats]:
        """Return information and mean of the prior on the free parameters' step from `camera`."""
        gone = step_between(self.start.camera, camera)
        chain = step_jacobian(gone)[np.ix_(self.free, self.free)]
        information: Floats = chain.T @ self.information @ chain
        expected = np.linalg.solve(chain, -gone[self.free])
        return information, np.asarray(expected, dtype=np.float64)

    def _full_step(self, step: Floats) -> Floats:
        whole = np.zeros(len(self.free))
        whole[self.free] = step
        return whole
