"""Expected error of positions on the pitch, and the clicks that would reduce it most."""

from __future__ import annotations

from collections.abc import Collection
from dataclasses import dataclass
from itertools import pairwise

import numpy as np

from data_contracts.arrays import Flags, Floats
from worldpose.geometry.cameras import Camera
from worldpose.pitch.template import PitchTemplate
from worldpose.static_calibration.parameters import CameraEstimate, project_with_jacobian


@dataclass(frozen=True, eq=False)
class GroundErrorMap:
    """Expected ground error over the pitch: the coverage map of one camera.

    Attributes:
        x: (columns,) [m], world; y: (rows,) [m].
        expected: (rows, columns) [m], root mean square distance on the surface between a place and
            the back-projection of its true pixel; NaN outside the field of view.
    """

    x: Floats
    y: Floats
    expected: Floats

    @property
    def median(self) -> float:
        """Median over the field of view [m]; infinite if the camera sees nothing."""
        return self._quantile(0.5)

    @property
    def p95(self) -> float:
        """95th percentile over the field of view [m]."""
        return self._quantile(0.95)

    def _quantile(self, share: float) -> float:
        seen = self.expected[np.isfinite(self.expected)]
        return float(np.quantile(seen, share)) if seen.size else float("inf")


def ground_error_map(estimate: CameraEstimate, pitch: PitchTemplate, step: float) -> GroundErrorMap:
    """Return the expected ground error of an estimate on a grid over the pitch, with a step [m]."""
    margin = 2.0  # beyond the outer lines [m]: people stand there
    x, y = (
        np.linspace(-half, half, int(np.ceil(2.0 * half / step)) + 1)
        for half in (0.5 * pitch.length + margin, 0.5 * pitch.width + margin)
    )
    across, along = np.meshgrid(y, x, indexing="ij")
    places = np.stack([along, across, pitch.height(along, across)], axis=-1).reshape(-1, 3)
    expected = expected_ground_error(estimate, pitch, places)
    pixels = estimate.camera.project(places)
    with np.errstate(invalid="ignore"):
        seen = ((pixels >= -0.5) & (pixels <= estimate.camera.image_size - 0.5)).all(axis=1)
    return GroundErrorMap(x, y, np.where(seen, expected, np.nan).reshape(across.shape))


def pitch_places(pitch: PitchTemplate, spacing: float) -> Floats:
    """Return the places (n, 3) [m] of a grid over the pitch with a spacing [m], world."""
    x = np.arange(-0.5 * pitch.length, 0.5 * pitch.length + 1e-9, spacing)
    y = np.arange(-0.5 * pitch.width, 0.5 * pitch.width + 1e-9, spacing)
    along, across = (grid.ravel() for grid in np.meshgrid(x, y))
    return np.stack([along, across, pitch.height(along, across)], axis=1)


def expected_ground_error(estimate: CameraEstimate, pitch: PitchTemplate, places: Floats) -> Floats:
    """Return the expected ground error (n,) [m] at places (n, 3) [m] on the surface, world.

    It is NaN where the camera cannot image the place.
    """
    motion = surface_motion(estimate.camera, pitch, places)
    squared = np.einsum("nij,jk,nik->n", motion, estimate.covariance, motion)
    return np.asarray(np.sqrt(np.maximum(squared, 0.0)))


def surface_motion(camera: Camera, pitch: PitchTemplate, places: Floats) -> Floats:
    """Return derivatives (n, 2, 12) [m] of back-projected places by the step of a single camera.

    The pixel of a place (n, 3) [m] on the surface moves with the step; the place on the surface
    with this pixel moves by the inverse of the pixel's derivative along the surface. NaN where the
    camera cannot image the place.
    """
    step = 0.01  # [m]
    _, by_step = project_with_jacobian(camera, places)
    by_place = camera.project_with_jacobians(places).d_points
    slopes = [
        (pitch.height(places[:, 0] + dx, places[:, 1] + dy) - places[:, 2]) / step
        for dx, dy in ((step, 0.0), (0.0, step))
    ]
    surface = by_place[:, :, :2] + by_place[:, :, 2:] * np.stack(slopes, axis=-1)[:, None, :]
    (a, b), (c, d) = np.moveaxis(surface, 0, -1)
    area = a * d - b * c
    with np.errstate(invalid="ignore", divide="ignore"):
        # A square metre of less image is at the horizon.
        area = np.where(np.abs(area) > 1e-9, area, np.nan)
    inverse = np.moveaxis(np.array([[d, -b], [-c, a]]) / area, -1, 0)
    return np.asarray(inverse @ by_step)


_NAMED_POINTS = 4
"""Points to name in a message [1]: as many as a camera needs."""


def propose_clicks(
    estimate: CameraEstimate, pitch: PitchTemplate, clicked: tuple[str, ...], noise: float
) -> tuple[str, ...]:
    """Return the points and markings whose clicks would lower the expected ground error most.

    Greedy selection among the visible points and markings without a click; the noise is that of a
    click [px].
    """
    motion = _visible_motion(estimate, pitch)
    if not len(motion):
        return ()
    merit = np.einsum("nij,nik->jk", motion, motion)
    candidates = {
        name: rows / noise
        for name, rows in _candidates(estimate, pitch).items()
        if name not in clicked
    }
    covariance = estimate.covariance
    chosen: list[str] = []
    while candidates and len(chosen) < 3:
        best, gain, best_update = "", 0.0, np.zeros_like(covariance)
        for name, rows in candidates.items():
            through = covariance @ rows.T
            # If clicks barely determine the camera, variances exceed the precision of float64: the
            # matrix is then singular.
            inverse = np.linalg.pinv(np.eye(len(rows)) + rows @ through, hermitian=True)
            update = through @ inverse @ through.T
            if float((update * merit).sum()) > gain:
                best, gain, best_update = name, float((update * merit).sum()), update
        if not best:
            break
        covariance = covariance - best_update
        chosen.append(best)
        del candidates[best]
    return tuple(chosen)


def points_off_line(pitch: PitchTemplate, points_world: Floats) -> tuple[str, ...]:
    """Return four points of the pitch near given ones and farthest off the line through them."""
    middle = points_world.mean(axis=0)
    _, _, axes = np.linalg.svd(points_world[:, :2] - middle[:2])
    offsets = {
        name: place[:2] - middle[:2] for name, place in pitch.points.items() if "post" not in name
    }
    near = {name: off for name, off in offsets.items() if np.linalg.norm(off) < 45.0}
    ranked = sorted(near, key=lambda name: -abs(float(near[name] @ axes[1])))
    return tuple(ranked[:_NAMED_POINTS])


def _visible_motion(estimate: CameraEstimate, pitch: PitchTemplate) -> Floats:
    """Return derivatives (n, 2, 12) of visible places on the pitch by the camera's step [m]."""
    places = pitch_places(pitch, 5.0)
    seen = _inside(estimate, estimate.camera.project(places))
    motion = surface_motion(estimate.camera, pitch, places[seen])
    return motion[np.isfinite(motion).all(axis=(1, 2))]


def _candidates(estimate: CameraEstimate, pitch: PitchTemplate) -> dict[str, Floats]:
    """Return residual derivatives (k, 12) by a step [px] of each visible point and marking."""
    pixels_per_marking = 5  # assumed
    names = tuple(pitch.points)
    pixels, by_step = project_with_jacobian(estimate.camera, pitch.positions(names))
    inside = _inside(estimate, pixels)
    found = {names[i]: by_step[i] for i in np.flatnonzero(inside)}
    samples = [pitch.marking_points(name, 1.0) for name in pitch.marking_names]
    pixels, by_step = project_with_jacobian(estimate.camera, np.concatenate(samples))
    inside = _inside(estimate, pixels)
    for name, (first, stop) in zip(
        pitch.marking_names, pairwise(np.cumsum([0, *map(len, samples)])), strict=True
    ):
        visible = first + np.flatnonzero(inside[first:stop])
        if len(visible) < pixels_per_marking:
            continue
        chosen = visible[np.linspace(0, len(visible) - 1, pixels_per_marking).astype(np.int64)]
        along = np.gradient(pixels[visible], axis=0)[np.searchsorted(visible, chosen)]
        normal = np.stack([-along[:, 1], along[:, 0]], axis=1)
        normal /= np.maximum(np.linalg.norm(normal, axis=1, keepdims=True), 1e-12)
        found[name] = np.einsum("ni,nij->nj", normal, by_step[chosen])
    return found


def _inside(estimate: CameraEstimate, pixels: Floats) -> Flags:
    with np.errstate(invalid="ignore"):
        within = (pixels >= 0.0) & (pixels <= estimate.camera.image_size - 1.0)
    return np.asarray(within.all(axis=1))


def points_in_view(camera: Camera, pitch: PitchTemplate, lines: Collection[str]) -> tuple[str, ...]:
    """Return four points on the ground that a camera sees, ends of some lines first, far apart."""
    names = [name for name, place in pitch.points.items() if place[2] < 0.5]
    pixels = camera.project(pitch.positions(names))
    inside = np.all((pixels >= 0.0) & (pixels <= camera.image_size - 1.0), axis=1).tolist()
    left = {name: pixel for name, pixel, seen in zip(names, pixels, inside, strict=True) if seen}
    shown = [line for name, line in pitch.lines.items() if name in lines]
    ends = {end for line in shown for end in (line.start, line.end)}
    away = dict.fromkeys(left, np.inf)
    chosen: list[str] = []
    while left and len(chosen) < _NAMED_POINTS:
        best = max(left, key=lambda name: (name in ends, away[name]))
        here = left.pop(best)
        chosen.append(best)
        away = {n: min(away[n], float(np.linalg.norm(at - here))) for n, at in left.items()}
    return tuple(chosen)
