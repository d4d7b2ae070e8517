"""Objective of a static camera's fit to clicks, and its terms, compiled.

With clicked points x_i of places X_i on the pitch, pixels x_d drawn along markings M_d, and the
projection Pi of camera L:

    E(L) = 1/2 sum_i rho_click(|Pi(X_i; L) - x_i|^2 / s_i^2)
         + 1/2 sum_d rho_drawn(dist(x_d, Pi(M_d; L))^2 / s_d^2)
         + 1/2 |prior(L)|^2.

The first term is stage 2 of the paper, with noise s_i [px] and a loss rho: squares, or Cauchy's
while outliers are searched. The paper has neither the second term nor the prior. The third stage,
on painted lines, has its residuals in `line_search.Bars`.

A camera is a row of `worldpose.geometry.camera_model`; derivatives are by a step of `PARAMETERS`.
"""

from __future__ import annotations

from typing import Final, NamedTuple

import numpy as np

from data_contracts.arrays import Flags, Floats, Integers
from worldpose.compiled import compile_kernel
from worldpose.geometry.camera_model import STEP, observe, to_camera_axes
from worldpose.geometry.lens_models import (
    WIDTH,
    LensModel,
    by_coefficients,
    fold_squared,
    load_camera,
    radial,
)
from worldpose.geometry.optimize.losses import cauchy_loss, cauchy_weight

PRIORS: Final = 9
"""Rows of the prior: focal, cx, cy, k1, k2, k3, height, distance, roll."""

_LOST_RESIDUAL: Final = 1e3
"""Residual [px] of points that the camera cannot image: larger than any true residual."""


class Measurements(NamedTuple):
    """Clicks, drawn markings and prior of a camera fit; see `ClickEvidence` and `CameraProblem`."""

    points_world: Floats
    points_image: Floats
    samples_world: Floats
    bounds: Integers
    drawn_image: Floats
    drawn_marking: Integers
    prior: Floats
    free: Flags
    click_noise: Floats
    drawn_noise: Floats
    half_diagonal: float
    click_loss: float
    drawn_loss: float


@compile_kernel
def linearize(
    c: Floats, given: Measurements, information: Floats, observed: Floats, gradient: Floats
) -> float:
    """Return the objective at a camera (WIDTH,); write its Gauss-Newton matrix and gradient.

    Written are `information` (12, 12), zero for fixed parameters, `observed` (12, 12), the part of
    clicks and drawn markings, and `gradient` (12,).
    """
    n, d = len(given.points_world), len(given.drawn_image)
    click, by_click = np.empty((n, 2)), np.empty((n, 2, STEP))
    off, by_off = np.empty(d), np.empty((d, STEP))
    known, by_known = np.empty(PRIORS), np.empty((PRIORS, STEP))
    click_residuals(c, given.points_world, given.points_image, click, by_click)
    drawn_residuals(
        c,
        given.half_diagonal,
        given.samples_world,
        given.bounds,
        given.drawn_image,
        given.drawn_marking,
        off,
        by_off,
    )
    prior_residuals(c, given.prior, known, by_known)
    gradient[:] = 0.0
    observed[:] = 0.0
    total = 0.0
    for i in range(n):
        variance = given.click_noise[i] ** 2
        squared = (click[i, 0] ** 2 + click[i, 1] ** 2) / variance
        total += cauchy_loss(squared, given.click_loss)
        weight = cauchy_weight(squared, given.click_loss) / variance
        for k in range(2):
            _add(by_click[i, k], click[i, k], weight, observed, gradient)
    for i in range(d):
        variance = given.drawn_noise[i] ** 2
        total += cauchy_loss(off[i] ** 2 / variance, given.drawn_loss)
        weight = cauchy_weight(off[i] ** 2 / variance, given.drawn_loss) / variance
        _add(by_off[i], off[i], weight, observed, gradient)
    information[:] = observed
    for i in range(PRIORS):
        total += known[i] ** 2
        _add(by_known[i], known[i], 1.0, information, gradient)
    for j in range(STEP):
        if not given.free[j]:
            information[j, :] = information[:, j] = 0.0
            observed[j, :] = observed[:, j] = 0.0
            gradient[j] = 0.0
    return 0.5 * total if total < np.inf else np.inf


@compile_kernel
def _add(by: Floats, residual: float, weight: float, system: Floats, gradient: Floats) -> None:
    for j in range(STEP):
        scaled = weight * by[j]
        gradient[j] += scaled * residual
        for k in range(STEP):
            system[j, k] += scaled * by[k]


@compile_kernel
def click_residuals(
    c: Floats, world: Floats, pixels: Floats, residual: Floats, jacobian: Floats
) -> None:
    """Write residuals Pi(X'_i) - x_i (n, 2) and their derivatives (n, 2, 12) by a step [px].

    Beyond the radius where the lens folds, the magnification at that radius applies, so that image
    radii keep growing. If points folded back into the image, a strong distortion would fit a point
    under a wrong name.
    """
    # The lens, and the one without distortion that continues it.
    rows = np.empty((2, WIDTH))
    rows[0] = rows[1] = c
    fold = fold_squared(load_camera(rows, 0))
    rows[:, 21] = np.inf
    magnification = 1.0
    if fold < np.inf:
        magnification = radial(load_camera(rows, 0), fold)[0]
        rows[1, 0], rows[1, 1] = magnification * c[0], magnification * c[1]
        rows[1, 4:9] = rows[1, 22:] = 0.0  # Brown's model, too
    lens, straight = load_camera(rows, 0), load_camera(rows, 1)
    at_fold = by_coefficients(lens, fold)
    by_point = np.empty((2, 3))
    for i in range(len(world)):
        px, py, pz = world[i, 0], world[i, 1], world[i, 2]
        by_step, beyond = jacobian[i], False
        status, u, v, _ = observe(lens, px, py, pz, by_step, by_point)
        if fold < np.inf and status == 0:
            x, y, z = to_camera_axes(lens, px, py, pz)
            beyond = x * x + y * y > fold * z * z
            if beyond:
                status, u, v, _ = observe(straight, px, py, pz, by_step, by_point)
        if status != 0:
            residual[i] = _LOST_RESIDUAL
            by_step[:] = 0.0
            continue
        residual[i, 0], residual[i, 1] = u - pixels[i, 0], v - pixels[i, 1]
        if beyond:
            # The derivative of the fold radius is left out: the loop rejects steps that do not
            # lower the cost.
            for k in range(2):
                plane = by_step[k, 6] / magnification
                by_step[k, 9], by_step[k, 10] = plane * at_fold[0], plane * at_fold[1]
                by_step[k, 11] = plane * at_fold[2]


@compile_kernel
def nearest_on_markings(
    c: Floats,
    reach: float,
    samples: Floats,
    bounds: Integers,
    pixels: Floats,
    marking: Integers,
    place: Floats,
    normal: Floats,
) -> None:
    """Write the nearest place on its marking of each drawn pixel, and the unit normal there.

    Samples (s, 3) [m], world, from `bounds[k]` to `bounds[k + 1]` (m + 1,) belong to marking k;
    `pixels` (d, 2) [px] have `marking` (d,). `reach` is half the image diagonal [px]. Written are
    `place` (d, 3) [m], world, NaN where the marking is not in front of the camera `c` (WIDTH,), and
    `normal` (d, 2) from the marking to the pixel, either sign.
    """
    max_radius = 1.5  # beyond, Brown's polynomials may fold a marking back into the image
    camera = load_camera(c.reshape(1, WIDTH), 0)
    cap = fold_squared(camera)
    if camera.model == LensModel.BROWN.value:
        cap = min((max_radius * reach / camera.fx) ** 2, cap)
    image = np.empty((len(samples), 2))
    for i in range(len(samples)):
        x, y, z = to_camera_axes(camera, samples[i, 0], samples[i, 1], samples[i, 2])
        if z < 0.5:
            image[i] = np.nan
            continue
        x, y = x / z, y / z
        factor = radial(camera, min(x * x + y * y, cap))[0]
        image[i, 0] = camera.fx * x * factor + camera.cx
        image[i, 1] = camera.fy * y * factor + camera.cy
    for i in range(len(pixels)):
        best = np.inf
        place[i] = np.nan
        normal[i] = 0.0
        for j in range(bounds[marking[i]], bounds[marking[i] + 1] - 1):
            ax, ay = image[j, 0], image[j, 1]
            dx, dy = image[j + 1, 0] - ax, image[j + 1, 1] - ay
            ex, ey = pixels[i, 0] - ax, pixels[i, 1] - ay
            length = max(dx * dx + dy * dy, 1e-18)
            share = min(max((ex * dx + ey * dy) / length, 0.0), 1.0)
            ox, oy = ex - share * dx, ey - share * dy
            distance = ox * ox + oy * oy
            # A NaN on either end compares false.
            if distance < best:
                best = distance
                for k in range(3):
                    place[i, k] = (1.0 - share) * samples[j, k] + share * samples[j + 1, k]
                root = np.sqrt(length)
                normal[i, 0], normal[i, 1] = -dy / root, dx / root
                off = np.sqrt(distance)
                # Beyond the marking's end the nearest point is the end itself.
                if (share == 0.0 or share == 1.0) and off > 1e-9:
                    normal[i, 0], normal[i, 1] = ox / off, oy / off


@compile_kernel
def drawn_residuals(
    c: Floats,
    reach: float,
    samples: Floats,
    bounds: Integers,
    pixels: Floats,
    marking: Integers,
    residual: Floats,
    jacobian: Floats,
) -> None:
    """Write distances (d,) of drawn pixels to their projected markings, and derivatives (d, 12).

    The derivative ignores the place along the marking: at the nearest point the distance is
    stationary in it, so that the derivative is the normal times that of the point's pixel.
    """
    n = len(pixels)
    place = np.empty((n, 3))
    normal = np.empty((n, 2))
    nearest_on_markings(c, reach, samples, bounds, pixels, marking, place, normal)
    both = np.empty((n, 2))
    by_step = np.empty((n, 2, STEP))
    click_residuals(c, place, pixels, both, by_step)
    for i in range(n):
        if np.isnan(place[i, 0]) or both[i, 0] == _LOST_RESIDUAL:
            residual[i] = _LOST_RESIDUAL
            jacobian[i] = 0.0
            continue
        residual[i] = normal[i, 0] * both[i, 0] + normal[i, 1] * both[i, 1]
        for j in range(STEP):
            jacobian[i, j] = normal[i, 0] * by_step[i, 0, j] + normal[i, 1] * by_step[i, 1, j]


@compile_kernel
def prior_residuals(c: Floats, prior: Floats, residual: Floats, jacobian: Floats) -> None:
    """Write the prior's residuals (9,) and derivatives (9, 12).

    Args:
        c: (WIDTH,) camera.
        prior: (21,) log focal, its spread; cx, cy, their spread; half diagonal [px]; spreads of
            k1, k2, k3; log height, its spread; log distance, its spread; spread of the roll; the
            minimum height [m]; spreads of k1, k2, k3 as coefficients; the middles of k1, k2, k3 as
            displacements of the corner.
        residual: (9,), written.
        jacobian: (9, 12), written.
    """
    jacobian[:] = 0.0
    residual[0] = (np.log(c[0]) - prior[0]) / prior[1]
    jacobian[0, 6] = 1.0 / prior[1]
    for k in range(2):
        residual[1 + k] = (c[2 + k] - prior[2 + k]) / prior[4]
        jacobian[1 + k, 7 + k] = 1.0 / prior[4]
    squared = (prior[5] / c[0]) ** 2
    power = 1.0
    for k in range(3):
        power *= squared
        # The displacement of the image corner: it shrinks with the focal length.
        value = c[8] if k == 2 else c[4 + k]
        spread = np.hypot(prior[6 + k], prior[15 + k] * power)
        residual[3 + k] = (value * power - prior[18 + k]) / spread
        jacobian[3 + k, 9 + k] = power / spread
        # Displacement and spread both depend on the focal length.
        wide = (prior[15 + k] * power / spread) ** 2
        jacobian[3 + k, 6] = -2.0 * (k + 1.0) * (value * power / spread - residual[3 + k] * wide)
    # The center moves by -R^T d with the step's shift d, and not with its rotation.
    x = -(c[9] * c[18] + c[12] * c[19] + c[15] * c[20])
    y = -(c[10] * c[18] + c[13] * c[19] + c[16] * c[20])
    z = -(c[11] * c[18] + c[14] * c[19] + c[17] * c[20])
    high = max(z, prior[14])
    # Below the minimum height the tangent continues the logarithm: no camera is underground, where
    # mirrored names would put it.
    residual[6] = (np.log(high) + (z - high) / high - prior[9]) / prior[10]
    far = max(np.sqrt(x * x + y * y), 1.0)
    # Cameras under a roof or on a drone are near the centre spot: the pull outwards ends at two
    # standard deviations, below the nearest stands.
    near = -2.0
    residual[7] = max((np.log(far) - prior[11]) / prior[12], near)
    for k in range(3):
        jacobian[6, 3 + k] = -c[11 + 3 * k] / high / prior[10]
        along = (x * c[9 + 3 * k] + y * c[10 + 3 * k]) / far
        jacobian[7, 3 + k] = -along / far / prior[12] if residual[7] > near else 0.0
    residual[8] = c[11] / prior[13]
    jacobian[8, 1] = c[17] / prior[13]
    jacobian[8, 2] = -c[14] / prior[13]
