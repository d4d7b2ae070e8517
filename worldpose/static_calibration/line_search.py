"""Coarse-to-fine search for painted lines, samples of small uncertainty first (C4)."""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Final

import numpy as np
from numpy.typing import NDArray

from data_contracts.arrays import Floats
from worldpose.geometry import Camera
from worldpose.pitch import PitchTemplate
from worldpose.static_calibration.bar_fits import fit_bars
from worldpose.static_calibration.clearance import clear, whites_of
from worldpose.static_calibration.edges import BESIDE, CANDIDATES, find_bars
from worldpose.static_calibration.line_adjustment import Adjusted, adjust
from worldpose.static_calibration.line_profiles import Bars
from worldpose.static_calibration.line_samples import LineSamples, SeenLines, see_lines
from worldpose.static_calibration.line_settings import LineRefinementSettings
from worldpose.static_calibration.parameters import CameraEstimate, stepped

_ROUNDS: Final = 8
"""Maximum iterations of search and fit; one or two from ordinary clicks."""
_COARSE_ERROR: Final = 1.0
"""Standard deviation of a detected bar before its subpixel fit [px]."""
_FEW: Final = 500
"""Approximate number of samples in coarse iterations [1]."""
_LEAST_REACH: Final = 1.5
"""Margin of the search beyond three standard deviations [px]."""
_FINE: Final = 5.5
"""Search width up to which bars are fitted to subpixel accuracy [px]."""
_BEST: Final = 1.0 / 3.0
"""Share of the samples to search where all have a large uncertainty [1]."""
_MOSTLY: Final = 0.8
"""Minimum share of the samples within this search width [1]."""
_TURNS: Final = 4
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
class Measured:
    """Bars across samples: offsets (n,) along the normals [px] and their variances (n,) [px^2]."""

    offsets: Floats
    variances: Floats


@dataclass(frozen=True, eq=False)
class Found:
    """A camera, its samples, their projections, the bars measured there, and the last fit."""

    camera: Camera
    samples: LineSamples
    seen: SeenLines
    measured: Measured
    adjusted: Adjusted


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
        self.whites = whites_of(pitch)
        spread = np.sqrt(np.diag(start.covariance))
        self.free = spread > 0.0
        covariance = start.covariance[np.ix_(self.free, self.free)]
        scale = spread[self.free]
        # Scaled, since the squares of radians and pixels differ by a factor of a million.
        shape = covariance / np.outer(scale, scale)
        inverse: Floats = np.linalg.inv(shape + 1e-12 * np.eye(len(scale)))
        self.information = inverse / np.outer(scale, scale)

    def look(self, camera: Camera, samples: LineSamples) -> SeenLines:
        """Return the samples projected into a camera's image."""
        s = self.settings
        return see_lines(camera, samples, s.line_width, self.survey_error, s.line_shift)

    def clear(self, camera: Camera, samples: LineSamples, seen: SeenLines) -> NDArray[np.bool_]:
        """Return a mask of the samples (n,) with grass on both sides in the image."""
        room, half = 0.5 * seen.widths + BESIDE, 0.5 * self.settings.line_width
        return clear(camera, self.whites, half, seen.places, room, samples.marking)

    def run(self, begin: CameraEstimate, samples: LineSamples) -> Found | None:
        """Return the result of the coarse-to-fine search; None without lines."""
        camera, covariance = begin.camera, begin.covariance[np.ix_(self.free, self.free)]
        few = samples[np.arange(0, len(samples.marking), max(1, len(samples.marking) // _FEW))]
        found = None
        for left in reversed(range(_ROUNDS)):
            chosen = few
            seen = self.look(camera, few)
            if seen.visible.sum() < 0.5 * self.settings.least_found:
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
            least = self.settings.least_found * len(chosen.marking) / len(samples.marking)
            if np.isfinite(measured.offsets).sum() < max(least, 1.0):
                return None
            found = self._settle(camera, chosen, seen, measured, fine)
            if fine:
                break
            camera = found.camera
            covariance = np.asarray(np.linalg.inv(found.adjusted.information))
        return found

    def reweighed(self, found: Found, used: NDArray[np.bool_], inflation: Floats) -> Found:
        """Return the fit to the used samples (n,), with variances times `inflation` (n,)."""
        measured = Measured(
            np.where(used, found.measured.offsets, np.nan), found.measured.variances * inflation
        )
        scales = (2.0 * self.settings.loss, *(self.settings.loss,) * 2)
        adjusted = self._adjust(found.camera, found.seen, measured, scales)
        camera = stepped(found.camera, self._whole(adjusted.step))
        return replace(found, camera=camera, measured=measured, adjusted=adjusted)

    def distance(self, camera: Camera) -> float:
        """Return the Mahalanobis distance of a camera from the start."""
        gone = difference(self.start.camera, camera)[self.free]
        return float(np.sqrt(gone @ self.information @ gone))

    def covariance_of(self, found: Found) -> Floats:
        """Return the (12, 12) covariance of a fit."""
        whole = np.zeros_like(self.start.covariance)
        whole[np.ix_(self.free, self.free)] = np.linalg.inv(found.adjusted.information)
        return np.asarray(0.5 * (whole + whole.T))

    def bars_of(self, found: Found) -> Bars:
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

    def _settle(
        self,
        camera: Camera,
        samples: LineSamples,
        seen: SeenLines,
        measured: Measured,
        fine: bool,
    ) -> Found:
        """Return the converged fit to bars at fixed pixels."""
        bars = seen.places + measured.offsets[:, None] * seen.normals
        final = (self.settings.loss,) * 3
        scales: tuple[float, ...] = (*_FINE_SCALES, *final) if fine else _COARSE_SCALES
        for _ in range(_TURNS if fine else 1):
            adjusted = self._adjust(camera, seen, measured, scales)
            scales = (2.0 * self.settings.loss, self.settings.loss, self.settings.loss)
            camera = stepped(camera, self._whole(adjusted.step))
            moved = np.abs(seen.by_camera[:, self.free] @ adjusted.step)[seen.visible]
            seen = self.look(camera, samples)
            measured = replace(measured, offsets=((bars - seen.places) * seen.normals).sum(-1))
            if moved.max(initial=0.0) < _SETTLED:
                break
        return Found(camera, samples, seen, measured, adjusted)

    def _reach(self, seen: SeenLines, covariance: Floats) -> Floats:
        """Return the search widths (n,) of samples along their normals [px]."""
        rows = np.where(seen.visible[:, None], seen.by_camera[:, self.free], 0.0)
        own = np.where(seen.visible, (seen.by_paint**2).sum(-1), 0.0)
        variance = ((rows @ covariance) * rows).sum(-1) + own
        return np.asarray(3.0 * np.sqrt(variance) + _LEAST_REACH)

    def _measure(self, seen: SeenLines, reach: Floats, fine: bool) -> Measured:
        """Return the bars matched to the samples, to a subpixel (`fine`) or to a pixel."""
        s, count = self.settings, len(reach)
        # If all uncertainties are large, begin with the third of smallest uncertainty.
        limit = max(s.reach, float(np.quantile(reach[seen.visible], _BEST)))
        usable = seen.visible & (reach <= limit)
        offsets, strengths = np.empty((count, CANDIDATES)), np.empty((count, CANDIDATES))
        across = seen.places, seen.normals, seen.widths, seen.curvatures
        looked = np.where(usable, reach, -1.0)
        find_bars(self.grey, *across, looked, s.contrast, offsets, strengths)
        # A candidate's merit grows with its strength and falls with its Mahalanobis distance.
        away = 3.0 * offsets / reach[:, None]
        with np.errstate(divide="ignore"):
            merit = np.where(np.isnan(offsets), -np.inf, np.log(strengths) - 0.5 * away**2)
        best = offsets[np.arange(count), merit.argmax(axis=1)]
        if not fine:
            return Measured(best, np.full(count, _COARSE_ERROR**2))
        exact, variances = np.empty(count), np.empty(count)
        fit_bars(self.grey, *across, best, s.contrast, exact, variances)
        return Measured(exact, variances + _READING**2)

    def _adjust(
        self,
        camera: Camera,
        seen: SeenLines,
        measured: Measured,
        scales: tuple[float, ...],
    ) -> Adjusted:
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
        """Return information and mean of the prior on the free parameters' step from a camera."""
        gone = difference(self.start.camera, camera)
        chain = turned(gone)[np.ix_(self.free, self.free)]
        information: Floats = chain.T @ self.information @ chain
        expected = np.linalg.solve(chain, -gone[self.free])
        return information, np.asarray(expected, dtype=np.float64)

    def _whole(self, step: Floats) -> Floats:
        whole = np.zeros(len(self.free))
        whole[self.free] = step
        return whole


def turned(gone: Floats) -> Floats:
    """Return the derivative (12, 12) of a step (12,) by a further step after it."""
    chain = np.eye(len(gone))
    x, y, z = gone[3:6]
    # A further rotation also rotates the translation so far.
    chain[3:6, :3] = -np.array([[0.0, -z, y], [z, 0.0, -x], [-y, x, 0.0]])
    return chain


def difference(start: Camera, camera: Camera) -> Floats:
    """Return the (12,) step from one camera to another."""
    moved = camera.cam_from_world @ start.cam_from_world.inverse()
    return np.concatenate(
        [
            moved.rotvec,
            moved.translation,
            np.log(camera.focal[:1] / start.focal[:1]),
            camera.principal_point - start.principal_point,
            (camera.distortion - start.distortion)[[0, 1, 4]],
        ]
    )
