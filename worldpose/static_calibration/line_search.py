"""Coarse-to-fine search for painted lines, samples of small uncertainty first.

`LineSearch` alternates between measuring bars across projected markings and a robust least-squares
fit of the camera to them, with a prior. `Bars` are the result: measured bars of painted lines, and
their residuals at nearby cameras.
"""

from __future__ import annotations

from dataclasses import astuple, dataclass, replace
from functools import cached_property
from typing import Final, TypeVar

import numpy as np

from data_contracts.arrays import Flags, Floats, Image, Integers
from worldpose.compiled import compile_kernel
from worldpose.geometry.cameras import Camera
from worldpose.geometry.optimize.losses import geman_mcclure_weight
from worldpose.pitch.template import PitchTemplate
from worldpose.static_calibration.line_detection import CANDIDATES, CLEARANCE, find_bars, fit_bars
from worldpose.static_calibration.line_samples import (
    LineSamples,
    PaintNoise,
    PaintUnknowns,
    ProjectedLines,
    clear,
    project_lines,
    stated_noise,
    white_structures,
)
from worldpose.static_calibration.parameters import (
    CameraOnPitch,
    by_step,
    step_camera,
    step_jacobian,
)
from worldpose.static_calibration.settings import LineRefinementSettings


@dataclass(frozen=True, eq=False)
class Bars:
    """Bars in the image, each with its marking sample.

    Attributes:
        samples: (n,) marking samples.
        pixels: (n, 2) positions of the bars [px].
        noise: (n,) across the marking, standard deviation [px].
        surface: (2,) crown and end fall at the samples [m].
        by_paint: (n, 11) derivatives of the marking by the paint's unknowns.
        unknowns: (n, 11) numbers of these, see `ProjectedLines`.
        paint: noise of the paint.
    """

    samples: LineSamples
    pixels: Floats
    noise: Floats
    surface: Floats
    by_paint: Floats
    unknowns: Integers
    paint: PaintNoise

    @cached_property
    def _paint(self) -> Floats:
        """Orthonormal basis of the paint's unknowns, in residuals and priors."""
        numbers, index = np.unique(self.unknowns, return_inverse=True)
        count = len(self.noise)
        columns = np.zeros((count + len(numbers), len(numbers)))
        np.add.at(columns, (np.arange(count)[:, None], index), self.by_paint / self.noise[:, None])
        columns[count:] = np.eye(len(numbers))
        return np.linalg.qr(columns)[0]

    def whiten_residuals(self, camera: Camera, surface: Floats) -> tuple[Floats, Floats]:
        """Return whitened residuals (m,) of markings against bars, and derivatives (m, 14).

        Residuals and derivatives are projected off the paint's unknowns and their priors, so that m
        is larger than the number of bars.
        """
        off, moves = self.whiten_raw(camera, surface)
        both = np.zeros((len(self._paint), 1 + moves.shape[1]))
        both[: len(off), 0], both[: len(off), 1:] = off, moves
        both -= self._paint @ (self._paint.T @ both)
        return both[:, 0], both[:, 1:]

    def whiten_raw(self, camera: Camera, surface: Floats) -> tuple[Floats, Floats]:
        """Return whitened residuals (n,) against exact paint, and derivatives (n, 14).

        Residuals are distances to the nearest point: a marking that slides along itself fits as
        well as before.
        """
        stride = 0.1  # [m], for finite differences of the projection
        samples = self.samples.raise_surface(surface - self.surface)
        before, after = (camera.project(samples.beside(way)) for way in (-stride, stride))
        seen = camera.project_with_jacobians(samples.points_world)
        middle, by_height = seen.points_image, seen.d_points[..., 2:]
        jacobian = np.concatenate(
            [by_step(camera, seen), by_height * samples.by_surface[:, None]], axis=-1
        )
        along, bend = 0.5 * (after - before), after + before - 2.0 * middle
        away = self.pixels - middle
        way = (away * along).sum(-1) / (along**2).sum(-1)
        normal = np.stack([-along[:, 1], along[:, 0]], axis=-1)
        normal /= np.linalg.norm(normal, axis=-1, keepdims=True)
        off = ((0.5 * way[:, None] ** 2 * bend - away) * normal).sum(-1)
        moves = np.einsum("ni,nij->nj", normal, jacobian)
        return off / self.noise, moves / self.noise[:, None]


@dataclass(frozen=True, eq=False)
class LineStep:
    """A step of the free parameters, its information and its residuals.

    Attributes:
        step: (f,).
        information: (f, f) inverse covariance of the step, marginalized over the paint's unknowns.
        residuals: (n,) after subtraction of the paint's unknowns [px].
        weights: (n,) weights of the robust loss [1].
        spent: degrees of freedom that the fit takes from the samples [1].
        paint: the paint's unknowns.
    """

    step: Floats
    information: Floats
    residuals: Floats
    weights: Floats
    spent: float
    paint: PaintUnknowns


def solve_line_step(
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

    `offsets` (n,) are measured minus projected, along the normal [px], NaN = no measurement, with
    `variances` (n,) [px^2]. `by_camera` (n, f) and `by_paint` (n, k) are derivatives of the
    projection by free parameters and by the paint's unknowns, `unknowns` (n, k) the indices of
    these. The prior is information (f, f) and mean (f,) of the step; `scales` of the loss are one
    per iteration [standard deviations].
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
            weights = np.where(known, geman_mcclure_weight(residuals**2 / variances, scale), 0.0)
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
    spread: Floats = np.linalg.inv(normal)
    spent = float((spread * told.T).sum())
    paint = PaintUnknowns(numbers, solution[free:], 1.0 - np.diag(spread)[free:])
    information = 0.5 * (information + information.T)
    return LineStep(solution[:free], information, residuals, weights, spent, paint)


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


_COARSE_SCALES: Final = (np.inf, 12.0, 6.0, 4.0, 3.0, 3.0)


@dataclass(frozen=True, eq=False)
class MeasuredLines:
    """A camera, the pitch's surface (2,), n samples on it, their projections and the bars there.

    Bars have offsets (n,) along the normals [px] and variances (n,) [px^2].
    """

    camera: Camera
    surface: Floats
    samples: LineSamples
    seen: ProjectedLines
    offsets: Floats
    variances: Floats


@dataclass(frozen=True, eq=False)
class LineFit(MeasuredLines):
    """The same, and the last step to this camera and surface."""

    adjusted: LineStep


Lines = TypeVar("Lines", bound=MeasuredLines)


class LineSearch:
    """Line search in one image, from a start with a Gaussian prior."""

    def __init__(
        self,
        start: CameraOnPitch,
        pitch: PitchTemplate,
        grey: Image,
        survey_error: float,
        settings: LineRefinementSettings,
    ) -> None:
        # The noise of a real pitch on artificial turf.
        begin = PaintNoise(points_m=0.0, unevenness_m=0.02, shift_px=0.0, reading=2.5)
        self.start, self.grey, self.settings = start, grey, settings
        self.least = stated_noise(survey_error, settings.line_shift_px)
        self.noise = PaintNoise(
            *(max(pair) for pair in zip(astuple(self.least), astuple(begin), strict=True))
        )
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
        return project_lines(camera, samples, self.settings.line_width_m, self.noise)

    def clear(self, camera: Camera, samples: LineSamples, seen: ProjectedLines) -> Flags:
        """Return a mask of the samples (n,) with grass on both sides in the image."""
        room, half = 0.5 * seen.widths + CLEARANCE, 0.5 * self.settings.line_width_m
        return clear(camera, self.whites, half, seen.places, room, samples.marking)

    def run(self, begin: CameraOnPitch, samples: LineSamples) -> LineFit | None:
        """Return the result of the coarse-to-fine search from a camera and surface, if any."""
        coarse = 500  # approximate number of samples in coarse passes
        camera, covariance = begin.camera, begin.covariance[np.ix_(self.free, self.free)]
        surface = begin.surface
        few = samples[np.arange(0, len(samples.marking), max(1, len(samples.marking) // coarse))]
        found = None
        # One or two passes suffice from ordinary clicks.
        for left in reversed(range(8)):
            chosen = few
            seen = self.look(camera, few)
            if seen.visible.sum() < 0.5 * self.settings.min_found:
                return None
            reach, sure = self._reach(seen, covariance)
            # Bars are fitted to subpixel accuracy once four of five samples need a narrow search.
            fine = left == 0 or bool((sure <= 5.5)[seen.visible].mean() >= 0.8)
            if fine:
                seen = self.look(camera, samples)
                alone = self.clear(camera, samples, seen)
                chosen, seen = samples[alone], seen[alone]
                reach, _ = self._reach(seen, covariance)
            if not seen.visible.any():
                return None
            bars = self._measure(seen, reach, chosen.marking if fine else None)
            least = self.settings.min_found * len(chosen.marking) / len(samples.marking)
            if np.isfinite(bars[0]).sum() < max(least, 1.0):
                return None
            found = self.converge(MeasuredLines(camera, surface, chosen, seen, *bars), fine)
            if fine:
                break
            change = found.surface - surface
            samples, few = samples.raise_surface(change), few.raise_surface(change)
            camera, surface = found.camera, found.surface
            covariance = np.asarray(np.linalg.inv(found.adjusted.information))
        return found

    def reweight(self, found: LineFit, used: Flags, inflation: Floats) -> LineFit:
        """Return the fit to the used samples (n,), with variances times `inflation` (n,)."""
        now = replace(
            found,
            offsets=np.where(used, found.offsets, np.nan),
            variances=found.variances * inflation,
        )
        scales = (2.0 * self.settings.loss_scale, *(self.settings.loss_scale,) * 2)
        adjusted = self._adjust(now, scales)
        return replace(self._step(now, adjusted.step), adjusted=adjusted)

    def learn_noise(self, found: LineFit) -> LineFit:
        """Return the fit at the noise that its residuals show; `noise` becomes that noise.

        The camera is free meanwhile: uneven paint must not explain a start that the lines
        contradict.
        """
        own = found.variances / self.noise.reading**2
        scale = self.settings.loss_scale
        for _ in range(40):
            before = self.noise
            variances = own * before.reading**2
            seen = self.look(found.camera, found.samples)
            now = replace(found, seen=seen, variances=variances)
            adjusted = self._adjust(now, (np.inf, 2.0 * scale, scale), trust=1e-3)
            known = np.isfinite(adjusted.residuals)
            scaled = (adjusted.residuals / np.sqrt(variances))[known]
            self.noise = before.update(self.least, adjusted.paint, scaled)
            change = np.divide(astuple(self.noise), astuple(before)) - 1.0
            if np.abs(change).max() < 0.01:
                break
        seen, variances = self.look(found.camera, found.samples), own * self.noise.reading**2
        return self.converge(replace(found, seen=seen, variances=variances), True)

    def distance(self, found: LineFit) -> float:
        """Return the Mahalanobis distance of a fit from the start."""
        gone = self.start.step_to(found.camera, found.surface)[self.free]
        return float(np.sqrt(gone @ self.information @ gone))

    def covariance(self, found: LineFit) -> Floats:
        """Return the (14, 14) covariance of a fit."""
        whole = np.zeros_like(self.start.covariance)
        whole[np.ix_(self.free, self.free)] = np.linalg.inv(found.adjusted.information)
        return np.asarray(0.5 * (whole + whole.T))

    def collect_bars(self, found: LineFit) -> Bars:
        """Return the bars that contribute to a fit."""
        seen, weights = found.seen, found.adjusted.weights
        used = weights > 1e-3
        pixels = seen.places + found.offsets[:, None] * seen.normals
        variances = found.variances[used] / weights[used]
        return Bars(
            found.samples[used],
            pixels[used],
            np.sqrt(variances),
            found.surface,
            seen.by_paint[used],
            seen.unknowns[used],
            self.noise,
        )

    def converge(self, at: MeasuredLines, fine: bool) -> LineFit:
        """Return the converged fit to bars at fixed pixels, fitted to a subpixel if fine."""
        # Decreasing scales of the loss [standard deviations]: outliers lose their
        # influence one by one, which avoids the nearest local minimum.
        fine_scales = (12.0, 6.0)
        bars = at.seen.places + at.offsets[:, None] * at.seen.normals
        final = (self.settings.loss_scale,) * 3
        scales: tuple[float, ...] = (*fine_scales, *final) if fine else _COARSE_SCALES
        for _ in range(4 if fine else 1):
            adjusted = self._adjust(at, scales)
            scales = (2.0 * self.settings.loss_scale, *(self.settings.loss_scale,) * 2)
            moved = np.abs(at.seen.by_camera[:, self.free] @ adjusted.step)[at.seen.visible]
            at = self._step(at, adjusted.step)
            seen = self.look(at.camera, at.samples)
            offsets = ((bars - seen.places) * seen.normals).sum(-1)
            at = replace(at, seen=seen, offsets=offsets)
            if moved.max(initial=0.0) < 0.02:
                break
        parts = (at.camera, at.surface, at.samples, at.seen, at.offsets, at.variances)
        return LineFit(*parts, adjusted)

    def _step(self, at: Lines, step: Floats) -> Lines:
        """Return camera, surface and samples after a step (f,) of the free parameters."""
        whole = np.zeros(len(self.free))
        whole[self.free] = step
        return replace(
            at,
            camera=step_camera(at.camera, whole[:-2]),
            surface=at.surface + whole[-2:],
            samples=at.samples.raise_surface(whole[-2:]),
        )

    def _reach(self, seen: ProjectedLines, covariance: Floats) -> tuple[Floats, Floats]:
        """Return the search widths (n,) of samples along their normals [px].

        The second ones leave out the paint's own errors, which a search does not reduce.
        """
        margin = 1.5  # beyond three standard deviations [px]
        rows = np.where(seen.visible[:, None], seen.by_camera[:, self.free], 0.0)
        own = np.where(seen.visible, (seen.by_paint**2).sum(-1), 0.0)
        variance = ((rows @ covariance) * rows).sum(-1)
        whole, camera = 3.0 * np.sqrt(variance + own), 3.0 * np.sqrt(variance)
        return whole + margin, camera + margin

    def _measure(
        self, seen: ProjectedLines, reach: Floats, marking: Integers | None
    ) -> tuple[Floats, Floats]:
        """Return offsets and variances (n,) of the bars matched to the samples."""
        s, count = self.settings, len(reach)
        # If all uncertainties are large, begin with the third of smallest uncertainty.
        limit = max(s.search_px, float(np.quantile(reach[seen.visible], (1.0 / 3.0))))
        usable = seen.visible & (reach <= limit)
        offsets, strengths = np.empty((count, CANDIDATES)), np.empty((count, CANDIDATES))
        looked = np.where(usable, reach, -1.0)
        find_bars(self.grey, seen.sections, looked, s.contrast, offsets, strengths)
        if marking is not None:
            _drop_faint(offsets, strengths, marking, seen.widths)
        # A candidate's merit grows with its strength and falls with its Mahalanobis distance.
        away = 3.0 * offsets / reach[:, None]
        with np.errstate(divide="ignore"):
            merit = np.where(np.isnan(offsets), -np.inf, np.log(strengths) - 0.5 * away**2)
        best = offsets[np.arange(count), merit.argmax(axis=1)]
        if marking is None:
            return best, np.ones(count)
        exact, variances = np.empty(count), np.empty(count)
        fit_bars(self.grey, seen.sections, best, s.contrast, exact, variances)
        return exact, (variances + 0.05**2) * self.noise.reading**2

    def _adjust(self, at: MeasuredLines, scales: tuple[float, ...], trust: float = 1.0) -> LineStep:
        """Return the step from a camera to the best one."""
        seen = at.seen
        information, mean = self._prior(at)
        known = np.flatnonzero(seen.visible)
        adjusted = solve_line_step(
            at.offsets[known],
            at.variances[known],
            np.ascontiguousarray(seen.by_camera[np.ix_(known, np.flatnonzero(self.free))]),
            np.ascontiguousarray(seen.by_paint[known]),
            seen.unknowns[known],
            (trust * information, mean),
            scales,
        )
        residuals, weights = np.full(len(seen.visible), np.nan), np.zeros(len(seen.visible))
        residuals[known], weights[known] = adjusted.residuals, adjusted.weights
        return replace(adjusted, residuals=residuals, weights=weights)

    def _prior(self, at: MeasuredLines) -> tuple[Floats, Floats]:
        """Return information and mean of the prior on the free parameters' step from a fit."""
        gone = self.start.step_to(at.camera, at.surface)
        chain = step_jacobian(gone)[np.ix_(self.free, self.free)]
        information: Floats = chain.T @ self.information @ chain
        expected = np.linalg.solve(chain, -gone[self.free])
        return information, np.asarray(expected, dtype=np.float64)


def _drop_faint(offsets: Floats, strengths: Floats, marking: Integers, widths: Floats) -> None:
    """Overwrite bars (n, c) with NaN that are far fainter than most of their marking.

    Rough grass has bars as well; paint of one marking is about equally bright along it, and blurred
    where it is narrower than a pixel.
    """
    # From 1.5 px of width, the middle of paint is as bright as the paint.
    bright = strengths / np.minimum(widths / 1.5, 1.0)[:, None]
    for index in np.unique(marking):
        mine = marking == index
        strongest = bright[mine, 0]
        if (strongest > 0.0).any():
            faint = bright[mine] < 0.5 * np.median(strongest[strongest > 0.0])
            offsets[mine] = np.where(faint, np.nan, offsets[mine])
