"""Covariance of every frame's camera and of the parameters shared by all frames."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import ArrayLike, NDArray
from scipy.special import chdtri

from data_contracts.arrays import Floats, Integers
from worldpose.broadcast_calibration.clip_problem import ClipProblem
from worldpose.broadcast_calibration.evidence import (
    CLICK,
    MARKING,
    PLAYER,
    PointArrays,
    PointEvidence,
)
from worldpose.broadcast_calibration.moving_camera import CLIP_SIZE, FRAME_SIZE, MovingCamera
from worldpose.broadcast_calibration.residuals import displace_point, displacement, point_row
from worldpose.broadcast_calibration.solver import ClipSolution, factorize
from worldpose.compiled import compile_kernel
from worldpose.geometry.camera_model import STEP
from worldpose.geometry.cameras import camera_arrays, camera_from_arrays
from worldpose.geometry.lens_models import load_camera
from worldpose.geometry.optimize.losses import geman_mcclure_weight


@dataclass(frozen=True, eq=False)
class Uncertainty:
    """Covariance (frames, 12, 12) of a moving camera: of a frame's step and the clip's jointly.

    It is 0 for fixed parameters.
    """

    frame: Floats

    @property
    def clip(self) -> Floats:
        """Return the covariance (5, 5) of center [m] and principal point [px]."""
        return np.asarray(self.frame[0, FRAME_SIZE:, FRAME_SIZE:])


def static_covariance(camera: MovingCamera, uncertainty: Uncertainty) -> Floats:
    """Return the covariance (frames, 12, 12) of each frame's camera as that of a static camera.

    A static camera's step is in the order of `CAMERA_STEP`, with a shift in its own axes instead
    of the center's in the world.
    """
    size = FRAME_SIZE + CLIP_SIZE
    chain = np.zeros((len(camera), size, size))
    chain[:, range(3), range(3)] = 1.0
    chain[:, 3:6, FRAME_SIZE : FRAME_SIZE + 3] = -camera.rotation
    order = [3, FRAME_SIZE + 3, FRAME_SIZE + 4, 4, 5, 6]
    chain[:, range(6, size), order] = 1.0
    return np.asarray(chain @ uncertainty.frame @ np.swapaxes(chain, -1, -2))


def moving_arrays(moving: MovingCamera, uncertainty: Uncertainty) -> dict[str, NDArray[Any]]:
    """Return the stored arrays of a moving camera and its covariance, by name."""
    covariance, camera = uncertainty.frame, camera_arrays(moving.camera)
    del camera["lens_model"]
    return {
        **camera,
        "image_size": moving.image_size,
        "center": moving.center,
        "covariance": covariance[:, :FRAME_SIZE, :FRAME_SIZE],
        "shared_covariance": covariance[:, :FRAME_SIZE, FRAME_SIZE:],
        "clip_covariance": uncertainty.clip,
    }


def moving_from_arrays(arrays: Mapping[Any, ArrayLike]) -> tuple[MovingCamera, Uncertainty]:
    """Return the moving camera of stored arrays, and its covariance."""
    names = ("covariance", "shared_covariance", "clip_covariance")
    own, across, shared = (np.asarray(arrays[name]) for name in names)
    whole = np.empty((len(own), FRAME_SIZE + CLIP_SIZE, FRAME_SIZE + CLIP_SIZE))
    whole[:, :FRAME_SIZE, :FRAME_SIZE] = own
    whole[:, :FRAME_SIZE, FRAME_SIZE:] = across
    whole[:, FRAME_SIZE:, :FRAME_SIZE] = np.swapaxes(across, -1, -2)
    whole[:, FRAME_SIZE:, FRAME_SIZE:] = shared
    return MovingCamera.from_batch(camera_from_arrays(arrays)), Uncertainty(whole)


def compute_uncertainty(
    solution: ClipSolution,
    problem: ClipProblem,
    line_shift: float = 0.0,
    player_shift: float = 0.0,
    smooth_frames: float = 1.0,
) -> Uncertainty:
    """Return the covariance of a solution, marginalized over paint errors.

    The inverse of the system covers noise that is independent per sample. The error of a piece of a
    marking or of a person lasts for the whole clip and does not average out: the function
    propagates the remaining gradient of each such source to the solution and adds it, which makes
    the covariance too large by a factor of two without such errors. A shift of all lines in the
    image, `line_shift` along each axis [px], or of all keypoints of all people, `player_shift`
    along each axis [deviations of a keypoint], leaves no gradient, since the camera follows it: the
    function propagates such shifts by their given size. The same applies to correlated second
    differences of the lens: a zoom lasts for many frames, and their errors are correlated over
    `smooth_frames` of them. Fixed parameters of the problem count as exact. DegenerateError if the
    system is singular.
    """
    factor = factorize(solution.equations.system)
    frames, _, count = factor.border.shape
    shared = factor.shared_covariance()
    whole = np.empty((frames, FRAME_SIZE + CLIP_SIZE, FRAME_SIZE + CLIP_SIZE))
    whole[:, :FRAME_SIZE, :FRAME_SIZE] = factor.frame_covariance(shared)
    gradients, rest = _lasting_gradients(solution, problem, count, line_shift, player_shift)
    bent = _zoom_gradients(problem, frames, smooth_frames)
    own, rest = factor.solve(
        np.concatenate([gradients, bent], axis=2),
        np.concatenate([rest, np.zeros((count, bent.shape[2]))], axis=1),
    )
    moved = np.concatenate(
        [own, np.broadcast_to(rest[:CLIP_SIZE], (frames, CLIP_SIZE, rest.shape[1]))], axis=1
    )
    across = -(factor.answer @ shared)[..., :CLIP_SIZE]
    whole[:, :FRAME_SIZE, FRAME_SIZE:] = across
    whole[:, FRAME_SIZE:, :FRAME_SIZE] = np.swapaxes(across, -1, -2)
    whole[:, FRAME_SIZE:, FRAME_SIZE:] = shared[:CLIP_SIZE, :CLIP_SIZE]
    whole += moved @ np.swapaxes(moved, -1, -2)
    # The system has ones for fixed parameters, to stay regular; their covariance is zero.
    clip = np.broadcast_to(~problem.free_clip, (len(whole), CLIP_SIZE))
    held = np.concatenate([problem.fixed_mask(len(whole)), clip], axis=1)
    whole[held[:, :, None] | held[:, None, :]] = 0.0
    return Uncertainty(0.5 * (whole + np.swapaxes(whole, -1, -2)))


def lasting_samples(points: PointEvidence, off: Floats) -> float:
    """Return how many samples of lines count as one, by their residuals (n, 2) [px].

    The mean over all pieces of markings of the squared mean residual, over that of independent
    samples.
    """
    lines = np.flatnonzero(points.kind == MARKING)
    if not len(lines):
        return 1.0
    some = points[lines]
    white = np.einsum("nj,nj->n", some.whitening[:, 0], off[lines])
    weight = geman_mcclure_weight((white / some.loss) ** 2, 1.0)
    _, cluster = np.unique(_cells(some), axis=0, return_inverse=True)
    sums, counts = (np.bincount(cluster.ravel(), each) for each in (weight * white, weight))
    return float(np.mean(sums**2 / np.maximum(counts, 1.0)))


def _cells(points: PointEvidence) -> Integers:
    """Return the kind, marking or person, and piece of the marking (n, 4) of each point."""
    # Within 3 m a marking has one common paint error.
    cell = np.floor(points.world[:, :2] / 3.0).astype(np.int64)
    cell[points.kind == PLAYER] = 0
    return np.column_stack([points.kind, points.source, cell])


def paint_variance(solution: ClipSolution) -> Floats:
    """Return the posterior variance (painted, 3) of a solution's paint errors [std^2]."""
    covariance = factorize(solution.equations.system).shared_covariance()
    return np.asarray(covariance.diagonal()[CLIP_SIZE:].reshape(-1, 3))


def _lasting_gradients(
    solution: ClipSolution,
    problem: ClipProblem,
    shared: int,
    line_shift: float,
    player_shift: float,
) -> tuple[Floats, Floats]:
    """Return the gradients (frames, 7, n) and (shared, n) of each lasting error at the solution.

    The last columns are a shift of all lines along x and y, of all people along x and y, and the
    sum over all people.
    """
    points, camera = problem.points, solution.camera
    chosen = points.kind != CLICK
    key = _cells(points[chosen])
    sources, cluster = np.unique(key, axis=0, return_inverse=True)
    columns = len(sources) + 4
    by_frame, by_shared = np.zeros((len(camera), FRAME_SIZE, columns)), np.zeros((shared, columns))
    people = points.kind[chosen] == PLAYER
    deviation = 1.0 / np.maximum(np.linalg.norm(points.whitening[chosen, 0], axis=-1), 1e-12)
    shift = np.where(people, player_shift * deviation, line_shift)
    weights = problem.weights
    clusters = _Clusters(
        np.where(people, weights.player, weights.field),
        cluster.astype(np.int64).ravel(),
        shift,
        len(sources) + 2 * people.astype(np.int64),
    )
    evidence = points[chosen].arrays(problem.ends[chosen], problem.size_row)
    _add_gradients(camera.rows, evidence, solution.paint_offsets, clusters, by_frame, by_shared)
    of_people = np.flatnonzero(sources[:, 0] == PLAYER)
    by_frame, by_shared = (
        np.concatenate([each, each[..., of_people].sum(axis=-1, keepdims=True)], axis=-1)
        for each in (by_frame, by_shared)
    )
    by_frame[problem.fixed_mask(len(camera))] = 0.0
    by_shared[:CLIP_SIZE][~problem.free_clip] = 0.0
    return by_frame, by_shared


def _zoom_gradients(problem: ClipProblem, frames: int, lasting: float) -> Floats:
    """Return gradients (frames, 7, n) of common errors of the zoom's second differences.

    One column per interval of about `lasting` frames, for an error of one standard deviation; none
    without correlation.
    """
    zoom = 3  # of a frame's parameters
    length = max(round(lasting), -(-frames // 64))
    used = lasting > 1.0 and np.isfinite(problem.smoothness[zoom]) and problem.free_frame[zoom]
    starts = range(0, frames - 2, length) if used else range(0)
    # Intervals longer than the correlation time have a smaller common error.
    common = np.sqrt(min(1.0, lasting / length))
    bends = np.zeros((frames, FRAME_SIZE, len(starts)))
    for place, begin in enumerate(starts):
        end = min(begin + length, frames - 2)
        # The sum of (1, -2, 1) over an interval is its last difference less its first one.
        column = bends[:, zoom, place]
        np.add.at(column, [begin, begin + 1, end, end + 1], [1.0, -1.0, -1.0, 1.0])
        column *= common / problem.smoothness[zoom]
    if problem.known is not None:
        bends[problem.known] = 0.0
    return bends


class _Clusters(NamedTuple):
    """Assignment of points to lasting errors."""

    weight: Floats
    """(n,) weight of the term of each point [1]."""
    column: Integers
    """(n,) column of the point's own error."""
    shift: Floats
    """(n,) common shift [px]."""
    shift_column: Integers
    """(n,) column of a shift along x; the next is along y."""


@compile_kernel
def _add_gradients(
    cameras: Floats,
    points: PointArrays,
    paint_offsets: Floats,
    clusters: _Clusters,
    by_frame: Floats,
    by_shared: Floats,
) -> None:
    """Add every point's gradient to the columns of its lasting errors; see `add_points`."""
    image, whitening, shift = points.image, points.whitening, clusters.shift
    pixel, rows, place = np.empty(2), np.empty((2, 12)), np.empty(3)
    by_step, by_point = np.empty((2, STEP)), np.empty((2, 3))
    for i in range(len(shift)):
        t = points.frame[i]
        displace_point(points, i, paint_offsets, place)
        if not point_row(load_camera(cameras, t), place, pixel, rows, by_step, by_point):
            continue
        u, v = pixel[0] - image[i, 0], pixel[1] - image[i, 1]
        one = whitening[i, 0, 0] * u + whitening[i, 0, 1] * v
        two = whitening[i, 1, 0] * u + whitening[i, 1, 1] * v
        factor = clusters.weight[i] * geman_mcclure_weight(one * one + two * two, points.loss[i])
        for source in range(3):
            # The residual, or a shift along x, or along y, in standard deviations.
            if source == 0:
                column, e, f = clusters.column[i], one, two
            else:
                column = clusters.shift_column[i] + source - 1
                e = shift[i] * whitening[i, 0, source - 1]
                f = shift[i] * whitening[i, 1, source - 1]
            # Gradient by the pixel, x and y.
            x = factor * (e * whitening[i, 0, 0] + f * whitening[i, 1, 0])
            y = factor * (e * whitening[i, 0, 1] + f * whitening[i, 1, 1])
            for j in range(7):
                by_frame[t, j, column] += x * rows[0, j] + y * rows[1, j]
            for j in range(5):
                by_shared[j, column] += x * rows[0, 7 + j] + y * rows[1, 7 + j]
            for one in range(12):
                row, share = displacement(points, i, one)
                if row >= 0:
                    moved = -(x * rows[0, 7 + one % 3] + y * rows[1, 7 + one % 3]) * share
                    by_shared[5 + 3 * row + one % 3, column] += moved


@dataclass(frozen=True, eq=False)
class PooledCenter:
    """Common camera center of several clips.

    Attributes:
        center: (3,) [m], world; NaN if the clips are inconsistent.
        covariance: (3, 3) [m^2].
        agree: whether one center explains all clips.
        distance: (clips,) Mahalanobis distance of each clip from the common center.
    """

    center: Floats
    covariance: Floats
    agree: bool
    distance: Floats


def pool_centers(centers: Sequence[Floats], covariances: Sequence[Floats]) -> PooledCenter:
    """Return the mean of several clips' centers (3,) [m], weighted by covariances (3, 3) [m^2]."""
    information = [np.linalg.inv(covariance) for covariance in covariances]
    whole = np.linalg.inv(np.sum(information, axis=0))
    middle = whole @ np.sum([i @ c for i, c in zip(information, centers, strict=True)], axis=0)
    squared = np.array(
        [(c - middle) @ i @ (c - middle) for c, i in zip(centers, information, strict=True)]
    )
    freedom = 3 * (len(centers) - 1)
    agree = freedom == 0 or bool(squared.sum() < chdtri(freedom, 1e-3))
    nothing = np.full(3, np.nan)
    return PooledCenter(middle if agree else nothing, np.asarray(whole), agree, np.sqrt(squared))


def drawn_to(
    camera: MovingCamera, uncertainty: Uncertainty, pooled: PooledCenter
) -> tuple[MovingCamera, Uncertainty]:
    """Return a clip's cameras conditioned on the pooled center, and their covariance.

    Rotation, focal length and distortion follow the center by their covariance with it.
    """
    known = uncertainty.frame
    place = slice(FRAME_SIZE, FRAME_SIZE + 3)
    along = known[:, :, place] @ np.linalg.inv(known[:, place, place])
    step = along @ (pooled.center - camera.center)
    moved = camera.take_step(step[:, :FRAME_SIZE], step[0, FRAME_SIZE:])
    gained = known[:, place, place] - pooled.covariance
    left = known - along @ gained @ np.swapaxes(along, -1, -2)
    return moved, Uncertainty(0.5 * (left + np.swapaxes(left, -1, -2)))
