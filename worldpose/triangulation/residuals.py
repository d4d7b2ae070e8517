"""The objective of triangulation, and its terms with their derivatives.

One joint X in one frame, from the cameras c that see it:

    E_data(X) = sum_c rho(|e_c|^2 / sigma_c^2),     e_c = pi_c(X) - (x_c - o_c)
    sigma_c^2 = (sigma_px^2 + s_c sigma_m^2) / g_c + v_c

pi_c is the projection, x_c the keypoint [px], and o_c the offset of the person in the image, which
calibration errors cause. sigma_px and sigma_m are the stated noise [px, m], s_c is the image area
of a square metre at the joint [px^2/m^2], g_c the precision that the noise model gives the keypoint
[1], and v_c the calibration's variance where o_c is not estimated [px^2]. rho is the identity over
the inlier views; while these are searched, it is the loss of Geman and McClure. The paper's
variant, `offsets="midhip"`, takes o_c from the mid-hip: then e_c is (pi_c(X) - pi_c(X_midhip)) -
(x_c - x_midhip,c).

The same joint in all frames t of its track, where rho is the loss of Geman and McClure, with the
penalty lambda = (fps^2 / acceleration)^2:

    E_track(X_1 ... X_T) = sum_t E_data(X_t) + lambda E_smooth
    E_smooth = sum_t |(X_t+1 - X_t) - (X_t - X_t-1)|^2

The offsets of one person in one frame, together with all joints j of the person:

    E_body(o, X) = sum_j E_data(X_j) + sum_c |o_c|^2 / tau_c^2

tau_c is the standard deviation that the calibration gives the person's position [px].

The kernels compute 64 joints at a time, one SIMD lane per joint. Each observation is linearised at
its own pixel: with X = (x, y, z, 1) and depth p X, its error is (a X, b X) / (p X) [px], so that no
lens is inverted again. `solve` minimizes E_data, `person_offsets` E_body, `smoothing` E_track.
"""

from __future__ import annotations

import math
from typing import Final, NamedTuple, Self

import numpy as np
from numpy.typing import NDArray

from data_contracts.arrays import AnyFloats, Floats
from worldpose.compiled import compile_kernel
from worldpose.geometry.camera_model import is_finite
from worldpose.geometry.cameras import Camera
from worldpose.geometry.lens_models import LensModel, distort, distort_brown, load_camera, undistort
from worldpose.geometry.rays import RayStatus

LANES: Final = 64
"""Joints per tile: 16 cameras x 64 joints fit the L2 cache of a processor core."""

TILE: Final = np.dtype(
    [
        # (4, lanes): rows a and b of the linearised observation.
        ("a", np.float64, (4, LANES)),
        ("b", np.float64, (4, LANES)),
        # Image area of a unit area at depth one [px^2].
        ("scale", np.float64, (LANES,)),
        # g; 0 = no observation.
        ("precision", np.float64, (LANES,)),
        # v [px^2].
        ("extra", np.float64, (LANES,)),
        # 1 = inlier or assumed to be one, 0 = left out.
        ("used", np.float64, (LANES,)),
        # |e|^2 / sigma^2, written by `add_data`; infinite behind the camera.
        ("squared", np.float64, (LANES,)),
        # Leverage of the observation, at most 2, written by `write_leverages`.
        ("leverage", np.float64, (LANES,)),
    ]
)
"""Observations of 64 joints by one camera."""

STATE: Final = np.dtype(
    [
        # X (3, lanes) [m].
        ("point", np.float64, (3, LANES)),
        # Inverse scale of the Geman-McClure loss in units of variance; 0 = least squares.
        ("sharpness", np.float64, (LANES,)),
        # Normal equations: xx xy xz yy yz zz of the matrix, and the right side.
        ("matrix", np.float64, (6, LANES)),
        ("right", np.float64, (3, LANES)),
        # Squared length of the last step [m^2].
        ("step", np.float64, (LANES,)),
        # Numbers of views, of views within the limit, and of those whose inlier state changed.
        ("seen", np.float64, (LANES,)),
        ("inside", np.float64, (LANES,)),
        ("changed", np.float64, (LANES,)),
        # Largest finite squared error.
        ("worst", np.float64, (LANES,)),
        # Of the used views: sum of squared pixel errors [px^2], number, and spread: the largest
        # squared sine of an angle between two rays.
        ("pixels", np.float64, (LANES,)),
        ("views", np.float64, (LANES,)),
        ("spread", np.float64, (LANES,)),
    ]
)
"""64 joints: their points, equations and statistics."""

RAYS: Final = np.dtype([("direction", np.float64, (3, LANES))])
"""Unit directions from one camera to 64 points."""

Tiles = NDArray[np.void]
"""(cameras,) of `TILE`."""
Tile = np.void
"""One of `TILE`."""
State = np.void
"""One of `STATE`."""


class Rig(NamedTuple):
    """Cameras in the memory layout of the kernels.

    Attributes:
        cameras: (cameras, WIDTH) rows as in `worldpose.geometry.camera_model`.
        depths: (cameras, 4), depth of (x, y, z, 1) [m]; 1 where a camera is missing.
        centers: (cameras, 3) [m], world.
    """

    cameras: Floats
    depths: Floats
    centers: Floats

    @classmethod
    def from_cameras(cls, cameras: Camera) -> Self:
        """Return the rig of a batch (cameras,)."""
        pose = cameras.cam_from_world
        rows = cameras.numbers
        depths = np.concatenate([pose.rotation[:, 2], pose.translation[:, 2:]], axis=-1)
        # 0 x NaN is NaN: a camera of weight 0 needs a finite depth nevertheless.
        missing = [not is_finite(rows, c) for c in range(len(rows))]
        depths[missing] = [0.0, 0.0, 0.0, 1.0]
        return cls(rows, depths, np.ascontiguousarray(cameras.center))


class Observations(NamedTuple):
    """Weighted keypoints of tracked people in all cameras, as the kernels take them.

    Attributes:
        keypoints: (frames, cameras, detections, joints, 2) [px].
        precision: (frames, cameras, detections, joints) g; 0 or NaN = no observation.
        detection_index: (frames, cameras, persons), index of the detection; -1 = not seen.
        shift: (frames, cameras, persons, 3), offset o [px] and variance v [px^2]; no frames = none.
        rig: the cameras.
    """

    keypoints: AnyFloats
    precision: Floats
    detection_index: NDArray[np.integer]
    shift: Floats
    rig: Rig

    @classmethod
    def of(
        cls,
        rig: Rig,
        keypoints: AnyFloats,
        precision: Floats,
        index: NDArray[np.integer],
        shift: Floats | None = None,
    ) -> Self:
        """Return observations; arguments as the attributes, by default without offsets.

        Arrays are contiguous and have one type: numba compiles a kernel again for every other.
        """
        return cls(
            np.ascontiguousarray(keypoints),
            np.ascontiguousarray(precision),
            np.ascontiguousarray(index, dtype=np.int64),
            no_shift() if shift is None else shift,
            rig,
        )


def no_shift() -> Floats:
    """Return the empty shift, which moves no observation."""
    return np.zeros((0, 0, 0, 3))


class Buffers(NamedTuple):
    """Memory of a kernel that solves one tile after another.

    Attributes:
        tiles: (cameras,) of `TILE`.
        state: (1,) of `STATE`.
        rays: (cameras,) of `RAYS`.
        trial_tiles: (cameras,) of `TILE`, to try other views of one joint.
        trial_state: (1,) of `STATE`.
    """

    tiles: Tiles
    state: NDArray[np.void]
    rays: NDArray[np.void]
    trial_tiles: Tiles
    trial_state: NDArray[np.void]

    @classmethod
    def of(cls, cameras: int) -> Self:
        """Return buffers for a number of cameras."""
        tiles = np.zeros((2, cameras), TILE)
        states = np.zeros((2, 1), STATE)
        return cls(tiles[0], states[0], np.zeros(cameras, RAYS), tiles[1], states[1])


@compile_kernel
def read_tile(observations: Observations, first: int, tiles: Tiles) -> None:
    """Write `a`, `b`, `scale`, `precision`, `extra` of 64 joints in the tiles (cameras,).

    They are linearised observations. `first` is the first joint, counted over frames, persons,
    joints.
    """
    for camera in range(len(tiles)):
        _gather(observations, first, camera, tiles[camera])
        _linearize(tiles[camera], observations.rig.cameras, camera)


@compile_kernel
def _gather(observations: Observations, first: int, camera: int, tile: Tile) -> None:
    """Write pixels to the first rows of `a` and `b`, precision and additional variance."""
    index, shift = observations.detection_index, observations.shift
    u, v = tile["a"][0], tile["b"][0]
    precision, extra = tile["precision"], tile["extra"]
    frames, _, persons = index.shape
    joints = observations.precision.shape[3]
    last = min(LANES, frames * persons * joints - first)
    precision[:] = 0.0
    extra[:] = 0.0
    j = 0
    while j < last:
        # Consecutive joints of one person.
        joint, which = (first + j) % joints, (first + j) // joints
        run = min(joints - joint, last - j)
        frame, person = which // persons, which % persons
        detection = index[frame, camera, person]
        if detection >= 0:
            pixels = observations.keypoints[frame, camera, detection, joint : joint + run]
            weights = observations.precision[frame, camera, detection, joint : joint + run]
            for k in range(run):
                u[j + k], v[j + k] = pixels[k, 0], pixels[k, 1]
                precision[j + k] = weights[k]
            if len(shift):
                for k in range(run):
                    u[j + k] -= shift[frame, camera, person, 0]
                    v[j + k] -= shift[frame, camera, person, 1]
                    extra[j + k] = shift[frame, camera, person, 2]
        j += run
    center = observations.rig.cameras[camera, 2:4]
    for j in range(LANES):
        x, y, g = u[j], v[j], precision[j]
        there = (g > 0.0) & (g < math.inf) & (abs(x) + abs(y) < math.inf)
        u[j] = x if there else center[0]
        v[j] = y if there else center[1]
        precision[j] = g if there else 0.0


@compile_kernel
def _linearize(tile: Tile, cameras: Floats, camera: int) -> None:
    """Turn a camera's pixels into equations, but those where the camera or lens gives no ray."""
    a, b, scale, precision = tile["a"], tile["b"], tile["scale"], tile["precision"]
    if not is_finite(cameras, camera):
        a[:], b[:], scale[:], precision[:] = 0.0, 0.0, 0.0, 0.0
        tile["extra"][:] = 0.0
        return
    c, is_brown = cameras[camera], cameras[camera, 25] == LensModel.BROWN.value
    # Undistorted x and y, the derivatives of the distortion, and whether they are exact.
    plane = np.empty((6, LANES))
    over_u, over_v = 1.0 / c[0], 1.0 / c[1]
    for j in range(LANES):
        xd, yd = (a[0, j] - c[2]) * over_u, (b[0, j] - c[3]) * over_v
        square = xd * xd + yd * yd
        over = 1.0 / (1.0 + square * (c[4] + square * c[5]))
        x, y = xd * over, yd * over
        # Newton steps that invert most of Brown's lenses to rounding; others are inverted below.
        for _ in range(2):
            fx, fy, dxx, dxy, dyy = distort_brown(x, y, c[4], c[5], c[6], c[7], c[8])
            over = 1.0 / (dxx * dyy - dxy * dxy)
            fx, fy = fx - xd, fy - yd
            x -= (dyy * fx - dxy * fy) * over
            y -= (dxx * fy - dxy * fx) * over
        fx, fy, dxx, dxy, dyy = distort_brown(x, y, c[4], c[5], c[6], c[7], c[8])
        misfit = max(abs(fx - xd), abs(fy - yd))
        # Largest accepted misfit of an inverse on the plane z = 1.
        inside = misfit <= 1e-13 and x * x + y * y < c[21] * c[21]
        plane[0, j], plane[1, j] = x, y
        plane[2, j], plane[3, j], plane[4, j] = dxx, dxy, dyy
        plane[5, j] = 1.0 if inside else 0.0
    for j in range(LANES):
        if plane[5, j] == 0.0 or not is_brown:
            numbers = load_camera(cameras, camera)
            x, y, status = undistort(numbers, (a[0, j] - c[2]) / c[0], (b[0, j] - c[3]) / c[1])
            if status != RayStatus.OK.value:
                x = y = precision[j] = 0.0
            _, _, dxx, dxy, dyy = distort(numbers, x, y)
            plane[0, j], plane[1, j] = x, y
            plane[2, j], plane[3, j], plane[4, j] = dxx, dxy, dyy
    for j in range(LANES):
        x, y, dxx, dxy, dyy = plane[0, j], plane[1, j], plane[2, j], plane[3, j], plane[4, j]
        m00, m01, m10, m11 = c[0] * dxx, c[0] * dxy, c[1] * dxy, c[1] * dyy
        scale[j] = abs(m00 * m11 - m01 * m10)
        there = 1.0 if precision[j] > 0.0 else 0.0
        m00, m01, m10, m11 = there * m00, there * m01, there * m10, there * m11
        for k in range(4):
            # Row k of the rotation is at 9 + 3 k, the translation at 18.
            p = c[9 + k] if k < 3 else c[18]
            q = c[12 + k] if k < 3 else c[19]
            r = c[15 + k] if k < 3 else c[20]
            p, q = p - x * r, q - y * r
            a[k, j] = m00 * p + m01 * q
            b[k, j] = m10 * p + m11 * q


@compile_kernel
def clear(state: State) -> None:
    """Set the normal equations to zero."""
    state["matrix"][:] = 0.0
    state["right"][:] = 0.0


@compile_kernel
def add_linear_data(tile: Tile, state: State) -> None:
    """Add one camera's linear equations a X = 0, b X = 0 to the sums."""
    matrix, right = state["matrix"], state["right"]
    used, scale, precision = tile["used"], tile["scale"], tile["precision"]
    for row in (tile["a"], tile["b"]):
        for j in range(LANES):
            w = used[j] * scale[j]
            w = w if precision[j] > 0.0 else 0.0
            x, y, z, r = row[0, j], row[1, j], row[2, j], row[3, j]
            matrix[0, j] += w * x * x
            matrix[1, j] += w * x * y
            matrix[2, j] += w * x * z
            matrix[3, j] += w * y * y
            matrix[4, j] += w * y * z
            matrix[5, j] += w * z * z
            right[0, j] -= w * x * r
            right[1, j] -= w * y * r
            right[2, j] -= w * z * r


@compile_kernel
def add_data(tile: Tile, depth: Floats, noise: tuple[float, float], state: State) -> None:
    """Add one camera's part of E_data to the normal equations at the points.

    Args:
        tile: one camera's observations; writes `squared`.
        depth: (4,), p of the camera.
        noise: sigma_px [px] and sigma_m [m].
        state: points and sharpness of the loss; writes the sums.
    """
    p, q, r, s = depth[0], depth[1], depth[2], depth[3]
    pixel, metric = noise[0] ** 2, noise[1] ** 2
    a, b, point = tile["a"], tile["b"], state["point"]
    matrix, right, sharpness = state["matrix"], state["right"], state["sharpness"]
    scale, precision, extra = tile["scale"], tile["precision"], tile["extra"]
    used, errors = tile["used"], tile["squared"]
    for j in range(LANES):
        x, y, z = point[0, j], point[1, j], point[2, j]
        away = p * x + q * y + r * z + s
        a0, a1, a2, b0, b1, b2 = a[0, j], a[1, j], a[2, j], b[0, j], b[1, j], b[2, j]
        along = a0 * x + a1 * y + a2 * z + a[3, j]
        across = b0 * x + b1 * y + b2 * z + b[3, j]
        inverse = 1.0 / away
        e, f = along * inverse, across * inverse
        size = scale[j] * inverse * inverse
        g = precision[j]
        weight = g / (pixel + size * metric + g * extra[j])
        squared = (e * e + f * f) * weight
        down = inverse / (1.0 + squared * sharpness[j])
        errors[j] = squared if away > 0.0 else np.inf
        # The derivative of an error is (a - e p) / depth: the weight has its squared depth.
        weight *= down * down * used[j]
        weight = weight if away > 0.0 else 0.0
        ax, ay, az = a0 - e * p, a1 - e * q, a2 - e * r
        bx, by, bz = b0 - f * p, b1 - f * q, b2 - f * r
        wax, way, waz = weight * ax, weight * ay, weight * az
        wbx, wby, wbz = weight * bx, weight * by, weight * bz
        matrix[0, j] += wax * ax + wbx * bx
        matrix[1, j] += wax * ay + wbx * by
        matrix[2, j] += wax * az + wbx * bz
        matrix[3, j] += way * ay + wby * by
        matrix[4, j] += way * az + wby * bz
        matrix[5, j] += waz * az + wbz * bz
        right[0, j] -= wax * along + wbx * across
        right[1, j] -= way * along + wby * across
        right[2, j] -= waz * along + wbz * across


@compile_kernel
def write_leverages(tile: Tile, depth: Floats, noise: tuple[float, float], state: State) -> None:
    """Write the leverage of one camera's observations; the matrix is already inverted."""
    p, q, r, s = depth[0], depth[1], depth[2], depth[3]
    pixel, metric = noise[0] ** 2, noise[1] ** 2
    a, b, point, matrix = tile["a"], tile["b"], state["point"], state["matrix"]
    scale, precision, extra = tile["scale"], tile["precision"], tile["extra"]
    used, leverage = tile["used"], tile["leverage"]
    for j in range(LANES):
        x, y, z = point[0, j], point[1, j], point[2, j]
        inverse = 1.0 / (p * x + q * y + r * z + s)
        base = pixel + scale[j] * inverse * inverse * metric
        g = precision[j]
        weight = used[j] * g / (base + g * extra[j]) * inverse * inverse
        xx, xy, xz = matrix[0, j], matrix[1, j], matrix[2, j]
        yy, yz, zz = matrix[3, j], matrix[4, j], matrix[5, j]
        total = 0.0
        for k in range(2):
            u, v, w, t = a[0, j], a[1, j], a[2, j], a[3, j]
            if k == 1:
                u, v, w, t = b[0, j], b[1, j], b[2, j], b[3, j]
            e = (u * x + v * y + w * z + t) * inverse
            u, v, w = u - e * p, v - e * q, w - e * r
            total += u * u * xx + v * v * yy
            total += w * w * zz
            total += 2.0 * u * v * xy
            total += 2.0 * w * (u * xz + v * yz)
        leverage[j] = weight * total


@compile_kernel
def add_smoothness(points: Floats, penalty: float, band: Floats, right: Floats) -> None:
    """Add lambda E_smooth of a track to its normal equations.

    Args:
        points: (frames, 3) [m].
        penalty: lambda [1/m^2].
        band: (3 frames, 7), `band[i, k]` = entry (i, i - k) of the matrix; added to.
        right: (3 frames,); added to.
    """
    for t in range(2, len(points)):
        for axis in range(3):
            i = 3 * t + axis
            bend = points[t, axis] - 2.0 * points[t - 1, axis] + points[t - 2, axis]
            right[i] -= penalty * bend
            right[i - 3] += 2.0 * penalty * bend
            right[i - 6] -= penalty * bend
            band[i, 0] += penalty
            band[i - 3, 0] += 4.0 * penalty
            band[i - 6, 0] += penalty
            band[i, 3] -= 2.0 * penalty
            band[i - 3, 3] -= 2.0 * penalty
            band[i, 6] += penalty
