"""Covariance of every frame's camera and of the parameters shared by all frames."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Final

import numpy as np

from data_contracts.arrays import Floats, Integers
from worldpose.broadcast_calibration.evidence import CLICK, PLAYER
from worldpose.broadcast_calibration.moving_camera import CLIP_SIZE, FRAME_SIZE
from worldpose.broadcast_calibration.normal_equations import point_row
from worldpose.broadcast_calibration.solving import Problem, Solution
from worldpose.compiled import compiled
from worldpose.errors import DegenerateError
from worldpose.geometry.optimize.banded import BandedFactor

_LENS: Final = 3
"""Parameters of a frame's step before those of its lens."""
_STRETCHES: Final = 64
"""Maximum intervals per clip with a common error of lens second differences [1]."""
_STRETCH: Final = 3.0
"""Cell size within which a marking has one common paint error [m]."""


@dataclass(frozen=True, eq=False)
class Uncertainty:
    """Covariance of a moving camera.

    Attributes:
        frame: (frames, 12, 12) joint covariance of a frame's step and the clip's; 0 for fixed
            parameters.
    """

    frame: Floats

    @property
    def clip(self) -> Floats:
        """(5, 5) of center [m] and principal point [px]."""
        return np.asarray(self.frame[0, FRAME_SIZE:, FRAME_SIZE:])


def uncertainty_of(
    solution: Solution,
    problem: Problem,
    line_shift: float = 0.0,
    player_shift: float = 0.0,
    smooth_frames: float = 1.0,
) -> Uncertainty:
    """Return the covariance of a solution, marginalized over paint errors.

    The inverse of the system covers noise that is independent per sample. The error of a piece of a
    marking, or of a person, lasts for the whole clip and does not average out: the function
    propagates the remaining gradient of each such source to the solution and adds it, which makes
    the covariance too large by a factor of two without such errors. A shift of all lines in the
    image, or of all keypoints of all people, leaves no gradient, since the camera follows it: the
    function propagates such shifts by their given size. The same applies to correlated second
    differences of the lens: a zoom lasts for many frames, and their errors are correlated over
    them. Fixed parameters of the problem count as exact.

    Args:
        solution: the camera and the paint errors.
        problem: evidence, smoothness and priors of the solution.
        line_shift: of all painted lines in the image, each axis, standard deviation [px].
        player_shift: of all keypoints in all frames, each axis, standard deviation [standard
            deviations of a keypoint].
        smooth_frames: correlation time of the lens's second differences [frame].

    Raises:
        DegenerateError: the system is singular.
    """
    system = solution.equations
    factor = BandedFactor.of(system.blocks)
    if not factor.determined:
        raise DegenerateError(
            "broadcast camera: a frame's numbers have neither evidence nor prior. Pick a key frame "
            "near the frames without lines."
        )
    by_shared = factor.solve(system.border)
    count = system.border.shape[2]
    flat = system.border.reshape(-1, count)
    reduced = system.corner - flat.T @ by_shared.reshape(-1, count)
    shared = np.linalg.inv(0.5 * (reduced + reduced.T))
    whole = np.empty((len(by_shared), FRAME_SIZE + CLIP_SIZE, FRAME_SIZE + CLIP_SIZE))
    whole[:, :FRAME_SIZE, :FRAME_SIZE] = factor.inverse_blocks()
    whole[:, :FRAME_SIZE, :FRAME_SIZE] += by_shared @ shared @ np.swapaxes(by_shared, -1, -2)
    pulls, rest = _left_pulls(solution, problem, count, line_shift, player_shift)
    bent = _bends(problem, len(by_shared), smooth_frames)
    rest = np.concatenate([rest, np.zeros((count, bent.shape[2]))], axis=1)
    own = factor.solve(np.concatenate([pulls, bent], axis=2))
    rest = shared @ (rest - flat.T @ own.reshape(len(flat), -1))
    moved = np.concatenate(
        [own - by_shared @ rest, np.broadcast_to(rest, (len(own), *rest.shape))], axis=1
    )[:, : FRAME_SIZE + CLIP_SIZE]
    across = -(by_shared @ shared)[..., :CLIP_SIZE]
    whole[:, :FRAME_SIZE, FRAME_SIZE:] = across
    whole[:, FRAME_SIZE:, :FRAME_SIZE] = np.swapaxes(across, -1, -2)
    whole[:, FRAME_SIZE:, FRAME_SIZE:] = shared[:CLIP_SIZE, :CLIP_SIZE]
    whole += moved @ np.swapaxes(moved, -1, -2)
    # The system has ones for fixed parameters, to stay regular; their covariance is zero.
    clip = np.broadcast_to(~problem.free_clip, (len(whole), CLIP_SIZE))
    held = np.concatenate([problem.held(len(whole)), clip], axis=1)
    whole[held[:, :, None] | held[:, None, :]] = 0.0
    return Uncertainty(0.5 * (whole + np.swapaxes(whole, -1, -2)))


def _left_pulls(
    solution: Solution, problem: Problem, shared: int, line_shift: float, player_shift: float
) -> tuple[Floats, Floats]:
    """Return the gradients (frames, 7, n) and (shared, n) of each lasting error at the solution.

    The last columns are a shift of all lines along x and y, of all people along x and y, and the
    sum over all people.
    """
    points, camera = problem.points, solution.camera
    chosen = points.kind != CLICK
    cell = np.floor(points.world[:, :2] / _STRETCH).astype(np.int64)
    cell[points.kind == PLAYER] = 0
    key = np.column_stack([points.kind, points.source, cell])[chosen]
    sources, cluster = np.unique(key, axis=0, return_inverse=True)
    columns = len(sources) + 4
    by_frame, by_shared = np.zeros((len(camera), FRAME_SIZE, columns)), np.zeros((shared, columns))
    people = points.kind[chosen] == PLAYER
    deviation = 1.0 / np.maximum(np.linalg.norm(points.whitening[chosen, 0], axis=-1), 1e-12)
    shift = np.where(people, player_shift * deviation, line_shift)
    _add_pulls(
        camera.center,
        camera.principal_point,
        camera.focal,
        camera.rotation,
        camera.distortion,
        points.frame[chosen],
        points.world[chosen],
        points.image[chosen],
        points.whitening[chosen],
        points.weight[chosen],
        points.loss[chosen],
        problem.ends[chosen],
        points.shares[chosen],
        solution.beside,
        cluster.astype(np.int64).ravel(),
        shift,
        len(sources) + 2 * people.astype(np.int64),
        by_frame,
        by_shared,
    )
    together = np.flatnonzero(sources[:, 0] == PLAYER)
    by_frame, by_shared = (
        np.concatenate([each, each[..., together].sum(axis=-1, keepdims=True)], axis=-1)
        for each in (by_frame, by_shared)
    )
    by_frame[problem.held(len(camera))] = 0.0
    by_shared[:CLIP_SIZE][~problem.free_clip] = 0.0
    return by_frame, by_shared


def _bends(problem: Problem, frames: int, lasting: float) -> Floats:
    """Return the gradients (frames, 7, n) of common errors of second differences.

    One column per lens parameter and interval of about `lasting` frames, for an error of one
    standard deviation; none without correlation.
    """
    length = max(round(lasting), -(-frames // _STRETCHES))
    numbers = np.flatnonzero(np.isfinite(problem.smoothness) & problem.free_frame)
    numbers = numbers[numbers >= _LENS]
    starts = range(0, frames - 2, length) if lasting > 1.0 else range(0)
    # Intervals longer than the correlation time have a smaller common error.
    common = np.sqrt(min(1.0, lasting / length))
    bends = np.zeros((frames, FRAME_SIZE, len(numbers), len(starts)))
    for place, begin in enumerate(starts):
        end = min(begin + length, frames - 2)
        for kind, number in enumerate(numbers):
            # The sum of (1, -2, 1) over an interval is its last difference less its first one.
            column = bends[:, number, kind, place]
            np.add.at(column, [begin, begin + 1, end, end + 1], [1.0, -1.0, -1.0, 1.0])
            column *= common / problem.smoothness[number]
    if problem.known is not None:
        bends[problem.known] = 0.0
    return bends.reshape(frames, FRAME_SIZE, -1)


@compiled
def _add_pulls(
    center: Floats,
    principal: Floats,
    focal: Floats,
    rotation: Floats,
    distortion: Floats,
    frame: Integers,
    world: Floats,
    image: Floats,
    whitening: Floats,
    weight: Floats,
    loss: Floats,
    ends: Integers,
    shares: Floats,
    beside: Floats,
    cluster: Integers,
    shift: Floats,
    common: Integers,
    by_frame: Floats,
    by_shared: Floats,
) -> None:
    """Add every point's gradient to its cluster's columns; arguments as `add_points`.

    The columns `common` (n,) and the next get a shift [px] of the points (n,) along x and y.
    """
    pixel, rows, place = np.empty(2), np.empty((2, 12)), np.empty(3)
    for i in range(len(frame)):
        t = frame[i]
        place[:] = world[i]
        for end in range(2):
            if ends[i, end] >= 0:
                place += shares[i, end] * beside[ends[i, end]]
        if not point_row(
            rotation[t], center, principal, focal[t], distortion[t], place, pixel, rows
        ):
            continue
        u, v = pixel[0] - image[i, 0], pixel[1] - image[i, 1]
        one = whitening[i, 0, 0] * u + whitening[i, 0, 1] * v
        two = whitening[i, 1, 0] * u + whitening[i, 1, 1] * v
        pull = weight[i] / (1.0 + (one * one + two * two) / loss[i] ** 2) ** 2
        for source in range(3):
            # The residual, or a shift along x, or along y, in standard deviations.
            if source == 0:
                column, e, f = cluster[i], one, two
            else:
                column = common[i] + source - 1
                e = shift[i] * whitening[i, 0, source - 1]
                f = shift[i] * whitening[i, 1, source - 1]
            # Gradient by the pixel, x and y.
            x = pull * (e * whitening[i, 0, 0] + f * whitening[i, 1, 0])
            y = pull * (e * whitening[i, 0, 1] + f * whitening[i, 1, 1])
            for j in range(7):
                by_frame[t, j, column] += x * rows[0, j] + y * rows[1, j]
            for j in range(5):
                by_shared[j, column] += x * rows[0, 7 + j] + y * rows[1, 7 + j]
            for end in range(2):
                if ends[i, end] >= 0:
                    for j in range(3):
                        moved = -(x * rows[0, 7 + j] + y * rows[1, 7 + j]) * shares[i, end]
                        by_shared[5 + 3 * ends[i, end] + j, column] += moved
