"""How well every frame's camera is known, and what is common to all frames."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Final

import numpy as np
from numpy.typing import NDArray

from worldpose.body_fitting.banded import BandedFactor
from worldpose.broadcast_calibration.evidence import CLICK, MARKING, PLAYER
from worldpose.broadcast_calibration.moving_camera import CLIP_SIZE, FRAME_SIZE
from worldpose.broadcast_calibration.normal_equations import point_row
from worldpose.broadcast_calibration.solving import Problem, Solution
from worldpose.compiled import compiled
from worldpose.errors import DegenerateError

Floats = NDArray[np.float64]
Integers = NDArray[np.int64]


_STRETCH: Final = 3.0
"""Of a marking, whose paint errs as one [m]."""


@dataclass(frozen=True, eq=False)
class Uncertainty:
    """Covariance of a moving camera.

    Attributes:
        frame: (frames, 12, 12) of a frame's step and the clip's, together.
    """

    frame: Floats

    @property
    def clip(self) -> Floats:
        """(5, 5) of center [m] and principal point [px]."""
        return np.asarray(self.frame[0, FRAME_SIZE:, FRAME_SIZE:])


def uncertainty_of(solution: Solution, problem: Problem, line_shift: float = 0.0) -> Uncertainty:
    """Return the covariance of a solution, the places of the painted markings accounted for.

    Noise that is new in every sample comes with the inverse of the system. What a stretch of a
    marking, or a person, gets wrong lasts for the whole clip and does not average out: the pull
    that each of them is left with as a whole is carried to the solution and added, so that the
    covariance is too wide by a factor of two where there is no such error. A shift of all lines in
    the picture leaves no pull, since the camera goes along with it: it is carried by its size.

    Args:
        solution: the camera, and where its markings lie.
        problem: what it rests on.
        line_shift: of all painted lines in the picture, each axis, standard deviation [px].

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
    columns = _left_pulls(solution, problem, system.border.shape[2], line_shift)
    if columns is not None:
        own = factor.solve(columns[0])
        rest = shared @ (columns[1] - flat.T @ own.reshape(len(flat), -1))
        moved = np.concatenate(
            [own - by_shared @ rest, np.broadcast_to(rest, (len(own), *rest.shape))], axis=1
        )[:, : FRAME_SIZE + CLIP_SIZE]
        lasting = moved @ np.swapaxes(moved, -1, -2)
    else:
        lasting = np.zeros_like(whole)
    across = -(by_shared @ shared)[..., :CLIP_SIZE]
    whole[:, :FRAME_SIZE, FRAME_SIZE:] = across
    whole[:, FRAME_SIZE:, :FRAME_SIZE] = np.swapaxes(across, -1, -2)
    whole[:, FRAME_SIZE:, FRAME_SIZE:] = shared[:CLIP_SIZE, :CLIP_SIZE]
    whole += lasting
    return Uncertainty(0.5 * (whole + np.swapaxes(whole, -1, -2)))


def _left_pulls(
    solution: Solution, problem: Problem, shared: int, line_shift: float
) -> tuple[Floats, Floats] | None:
    """Return each lasting source's gradient (frames, 7, n) and (shared, n) at the solution.

    Behind them are those of a shift of all lines along x and y, and of all people together: what a
    detector gets wrong of everybody pulls against the lines.
    """
    points, camera = problem.points, solution.camera
    chosen = points.kind != CLICK
    if not chosen.any():
        return None
    cell = np.floor(points.world[:, :2] / _STRETCH).astype(np.int64)
    cell[points.kind == PLAYER] = 0
    key = np.column_stack([points.kind, points.source, cell])[chosen]
    sources, cluster = np.unique(key, axis=0, return_inverse=True)
    count = len(sources)
    columns = count + 2
    by_frame, by_shared = np.zeros((len(camera), FRAME_SIZE, columns)), np.zeros((shared, columns))
    shift = np.where(points.kind[chosen] == MARKING, line_shift, 0.0)
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
        by_frame,
        by_shared,
    )
    people = np.flatnonzero(sources[:, 0] == PLAYER)
    by_frame, by_shared = (
        np.concatenate([each, each[..., people].sum(axis=-1, keepdims=True)], axis=-1)
        for each in (by_frame, by_shared)
    )
    fixed = ~problem.free_frame
    by_frame[:, fixed] = 0.0
    by_shared[:CLIP_SIZE][~problem.free_clip] = 0.0
    if problem.known is not None:
        by_frame[problem.known] = 0.0
    return by_frame, by_shared


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
    by_frame: Floats,
    by_shared: Floats,
) -> None:
    """Add every point's gradient to its cluster's columns; arguments as `add_points`.

    The last two columns are for a shift [px] of the points (n,) along x and y.
    """
    last = by_shared.shape[1] - 2
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
            # What is left, or a shift along x, or along y, in standard deviations.
            if source == 0:
                column, e, f = cluster[i], one, two
            else:
                column = last + source - 1
                e = shift[i] * whitening[i, 0, source - 1]
                f = shift[i] * whitening[i, 1, source - 1]
            # By the pixel itself, x and y.
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
