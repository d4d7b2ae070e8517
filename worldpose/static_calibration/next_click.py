"""Selection of the most informative points and markings to click next."""

from __future__ import annotations

from itertools import pairwise

import numpy as np
from numpy.typing import NDArray

from worldpose.pitch import PitchTemplate
from worldpose.static_calibration.ground_error import surface_motion
from worldpose.static_calibration.parameters import CameraEstimate, project_with_jacobian

_NEARBY = 45.0
"""Maximum distance of proposed points from the mean of the given ones [m]."""
_PLACES = 5.0
"""Grid spacing of the summed gain over the pitch [m]."""
_DRAWN = 5
"""Assumed number of drawn pixels per marking [1]."""


def most_helpful(
    estimate: CameraEstimate,
    pitch: PitchTemplate,
    clicked: tuple[str, ...],
    noise: float,
    count: int = 3,
) -> tuple[str, ...]:
    """Return the points and markings whose clicks would lower the expected ground error most.

    Greedy selection among the visible points and markings.

    Args:
        estimate: the current camera.
        pitch: the template.
        clicked: names that already have clicks.
        noise: of a click [px].
        count: maximum number of names.
    """
    motion = _seen_motion(estimate, pitch)
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
    while candidates and len(chosen) < count:
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


def off_the_line(
    pitch: PitchTemplate, points_world: NDArray[np.float64], count: int = 4
) -> tuple[str, ...]:
    """Return points of the pitch near the given ones and farthest off the line through them."""
    middle = points_world.mean(axis=0)
    _, _, axes = np.linalg.svd(points_world[:, :2] - middle[:2])
    offsets = {
        name: place[:2] - middle[:2] for name, place in pitch.points.items() if "post" not in name
    }
    near = {name: off for name, off in offsets.items() if np.linalg.norm(off) < _NEARBY}
    ranked = sorted(near, key=lambda name: -abs(float(near[name] @ axes[1])))
    return tuple(ranked[:count])


def _seen_motion(estimate: CameraEstimate, pitch: PitchTemplate) -> NDArray[np.float64]:
    """Return derivatives (n, 2, 12) of visible places on the pitch by the camera's step [m]."""
    x = np.arange(-0.5 * pitch.length, 0.5 * pitch.length + 1e-9, _PLACES)
    y = np.arange(-0.5 * pitch.width, 0.5 * pitch.width + 1e-9, _PLACES)
    along, across = (grid.ravel() for grid in np.meshgrid(x, y))
    places = np.stack([along, across, pitch.height(along, across)], axis=1)
    seen = _inside(estimate, estimate.camera.project(places))
    motion = surface_motion(estimate.camera, pitch, places[seen])
    return motion[np.isfinite(motion).all(axis=(1, 2))]


def _candidates(estimate: CameraEstimate, pitch: PitchTemplate) -> dict[str, NDArray[np.float64]]:
    """Return residual derivatives (k, 12) by a step [px] of each visible point and marking."""
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
        if len(visible) < _DRAWN:
            continue
        chosen = visible[np.linspace(0, len(visible) - 1, _DRAWN).astype(np.int64)]
        along = np.gradient(pixels[visible], axis=0)[np.searchsorted(visible, chosen)]
        normal = np.stack([-along[:, 1], along[:, 0]], axis=1)
        normal /= np.maximum(np.linalg.norm(normal, axis=1, keepdims=True), 1e-12)
        found[name] = np.einsum("ni,nij->nj", normal, by_step[chosen])
    return found


def _inside(estimate: CameraEstimate, pixels: NDArray[np.float64]) -> NDArray[np.bool_]:
    with np.errstate(invalid="ignore"):
        within = (pixels >= 0.0) & (pixels <= estimate.camera.image_size - 1.0)
    return np.asarray(within.all(axis=1))
