"""Equations in which changes of cameras show, and the noise of their estimates.

Errors of detectors and calibrations last, and views share them. So the noise is measured: a camera
with the estimates d_1, d_2 in the w seconds before and after a moment, of covariances C_1, C_2, has

    T = (d_2 - d_1)^T (C_1 + C_2)^-1 (d_2 - d_1).

The median of T over all moments, over that of chi-square, is the variance of its noise. A step is
one at which T is far larger; for drifts, T compares long blocks with the mean of their neighbours.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Final, Literal, Self

import numpy as np
from scipy.ndimage import convolve1d
from scipy.special import chdtri

from data_contracts.arrays import Flags, Floats, Integers
from data_contracts.keypoints import KeypointDetections
from worldpose.camera_consistency.health import LIMBS
from worldpose.geometry.cameras import Camera
from worldpose.triangulation.clocks import MovingJoints, shift_in_time, sum_equations
from worldpose.triangulation.residuals import Rig
from worldpose.triangulation.settings import TriangulationSettings
from worldpose.triangulation.synchronization import PRIOR

Kind = Literal["clock", "view"]
UNKNOWNS: Final[dict[Kind, Integers]] = {"clock": np.arange(1), "view": np.arange(1, 5)}
"""Of a camera, as of `sum_equations`."""
WIDTH: Final = 5
"""Number of unknowns of a camera."""
Noise = dict[tuple[Kind, bool], Floats]
"""Variance of the noise of each camera (cameras,) [1], by kind and whether for drifts."""
LOOSE: Final = TriangulationSettings(max_deviation=30.0)
"""Deviations accepted while views may be displaced."""


@dataclass(frozen=True, eq=False)
class ChangeSums:
    """Normal equations of all cameras in bins of frames; unknowns as of `sum_equations`.

    Attributes:
        matrix: (bins, unknowns, unknowns).
        score: (bins, unknowns).
        rows: (bins,) middle of each bin [frame].
        focal: (cameras,) focal lengths [px].
        are_clocks_asked: a user asks for changes of clocks, and sees the evidence: the noise of a
            clock is that of seconds about their neighbours.
    """

    matrix: Floats
    score: Floats
    rows: Floats
    fps: float
    focal: Floats
    are_clocks_asked: bool = False

    @classmethod
    def join(cls, parts: Sequence[ChangeSums], cameras: Camera, fps: float) -> Self:
        """Return the equations of several stretches of a clip, of a batch of cameras."""
        size = WIDTH * len(cameras.focal)
        every = np.concatenate([np.zeros((0, size, size)), *(one.matrix for one in parts)])
        pulls = np.concatenate([np.zeros((0, size)), *(one.score for one in parts)])
        middles = np.concatenate([np.zeros(0), *(one.rows for one in parts)])
        # Two stretches may share a bin.
        rows, number = np.unique(middles, return_inverse=True)
        matrix, score = np.zeros((len(rows), *every.shape[1:])), np.zeros((len(rows), size))
        np.add.at(matrix, number, every)
        np.add.at(score, number, pulls)
        return cls(matrix, score, rows, fps, cameras.focal.mean(axis=-1))

    @property
    def cameras(self) -> int:
        """Number of cameras."""
        return int(self.score.shape[1]) // WIDTH

    def select(self, chosen: Flags) -> ChangeSums:
        """Return the equations of some bins."""
        matrix, score = self.matrix[chosen], self.score[chosen]
        return replace(self, matrix=matrix, score=score, rows=self.rows[chosen])

    def of_camera(self, camera: int, kind: Kind) -> tuple[Floats, Floats]:
        """Return the equations (bins, k, k), (bins, k) of one camera, the others as they are."""
        own = WIDTH * camera + UNKNOWNS[kind]
        return self.matrix[:, own[:, None], own], self.score[:, own]

    def without_camera(self, camera: int) -> ChangeSums:
        """Return the equations of a camera that may be anywhere in each bin."""
        own = WIDTH * camera + np.arange(WIDTH)
        held = self.matrix[:, own[:, None], own] + np.diag(1e-9 * _INFORMATION)
        follow = self.matrix[:, :, own] @ np.linalg.inv(held)
        matrix = self.matrix - follow @ self.matrix[:, own]
        score = self.score - (follow @ self.score[:, own, None])[..., 0]
        matrix[:, own], matrix[:, :, own], score[:, own] = 0.0, 0.0, 0.0
        return replace(self, matrix=matrix, score=score)

    def steps(self, camera: int, kind: Kind) -> Floats:
        """Return T (bins,) of a step before each bin; NaN where a side is short."""
        matrix, score = self.of_camera(camera, kind)
        prior = np.diag(_INFORMATION[UNKNOWNS[kind]])
        near = min(3.0 * self.fps, 0.2 * (np.ptp(self.rows) + 1.0))
        inner = (self.rows - self.rows[0] >= 0.5 * near) & (self.rows[-1] - self.rows >= 0.5 * near)
        here = np.arange(len(self.rows))
        # As many bins on both sides of frames that are left out.
        count = near / np.diff(self.rows).min(initial=near)
        first, last = (
            np.clip(here + n, 0, len(here)) for n in (-math.floor(count), math.ceil(count))
        )
        before, one = _solve_blocks(matrix, score, first, here, prior)
        after, other = _solve_blocks(matrix, score, here, last, prior)
        off = after - before
        values = (off * np.linalg.solve(one + other, off[..., None])[..., 0]).sum(axis=1)
        return np.where(inner, values, np.nan)

    def bends(self, camera: int, kind: Kind) -> Floats:
        """Return T (n,) of long blocks and the mean of their neighbours."""
        matrix, score = self.of_camera(camera, kind)
        ends = np.linspace(0, len(self.rows), 7).astype(int)
        prior = np.diag(_INFORMATION[UNKNOWNS[kind]])
        values, covariance = _solve_blocks(matrix, score, ends[:-1], ends[1:], prior)
        off = values[1:-1] - 0.5 * (values[:-2] + values[2:])
        spread = covariance[1:-1] + 0.25 * (covariance[:-2] + covariance[2:])
        return np.asarray((off * np.linalg.solve(spread, off[..., None])[..., 0]).sum(axis=1))

    def departures(self, cameras: Camera, bins: int, length: int) -> Floats:
        """Return the shift of each view [px] and its clock offset [frame], (bins, cameras, 2).

        They are those of the second around each bin of `length` rows, as the people whom the other
        cameras place show them. Where people tell nothing, they are 0.
        """
        number = (self.rows // length).astype(int)
        matrix = np.zeros((bins, self.cameras, WIDTH, WIDTH))
        blocks = self.matrix.reshape(-1, *(self.cameras, WIDTH) * 2)
        matrix[number] = np.einsum("bcicj->bcij", blocks)
        score = np.zeros((bins, self.cameras, WIDTH))
        score[number] = self.score.reshape(-1, self.cameras, WIDTH)
        matrix, score = (
            convolve1d(each, np.ones(5), axis=0, mode="constant") for each in (matrix, score)
        )
        off = np.linalg.solve(matrix + np.diag(_INFORMATION), score[..., None])[..., 0]
        shift = cameras.focal.mean(axis=-1) * np.hypot(off[..., 1], off[..., 2])
        return np.stack([shift, off[..., 0]], axis=-1)

    def sway(self, camera: int) -> tuple[float, float]:
        """Return the usual size of a view's change in a second [rad], and its gain [1].

        Both are 0 below three seconds: two differ by one step, whatever moves the camera.
        """
        own = WIDTH * camera + np.arange(WIDTH)
        matrix, score = self.matrix[:, own[:, None], own], self.score[:, own]
        second = np.flatnonzero(np.diff(self.rows // max(1.0, round(self.fps)), prepend=-1.0))
        if len(second) < 3:
            return 0.0, 0.0
        ends = np.append(second, len(self.rows))
        prior = np.diag(_INFORMATION)
        late, covariance = _solve_blocks(matrix, score, ends[:-1], ends[1:], prior)
        late, covariance = late[:, 1:], covariance[:, 1:, 1:]
        late -= np.median(late, axis=0)
        gain = (late * np.linalg.solve(covariance, late[..., None])[..., 0]).sum(axis=1)
        return float(np.median(np.linalg.norm(late, axis=1))), float(np.median(gain)) / WIDTH

    def noise(self) -> Noise:
        """Return the noise by kind, and whether for drifts."""
        noise: Noise = {}
        for kind, unknowns in UNKNOWNS.items():
            usual = float(chdtri(len(unknowns), 0.5))
            steps = [_median(self.steps(c, kind)) for c in range(self.cameras)]
            bends = [_median(self.bends(c, kind)) for c in range(self.cameras)]
            own = np.maximum(1.0, np.array(steps) / usual)
            noise[kind, False] = np.maximum(own, np.median(own))
            # A clip has few long blocks: those of all cameras tell together.
            noise[kind, True] = np.maximum(noise[kind, False], np.median(bends) / usual)
        if self.are_clocks_asked:
            noise["clock", False] = noise["clock", True] = self._clock_noise()
        return noise

    def _clock_noise(self) -> Floats:
        """Return the variance of a clock in seconds about its neighbours (cameras,) [1]."""
        first = np.flatnonzero(np.diff(self.rows // max(1.0, round(self.fps)), prepend=-1.0))
        # All cameras together: what changes in one shows in none of the others.
        prior = np.diag(np.tile([1e-2, *PRIOR], self.cameras))
        inverse = np.linalg.inv(np.add.reduceat(self.matrix, first) + prior)
        late = (inverse @ np.add.reduceat(self.score, first)[..., None])[:, ::WIDTH, 0]
        own = np.diagonal(inverse, axis1=1, axis2=2)[:, ::WIDTH]
        off = late[1:-1] - 0.5 * (late[:-2] + late[2:])
        if not len(off):
            return np.ones(self.cameras)
        variance = own[1:-1] + 0.25 * (own[:-2] + own[2:])
        middle = np.median(off**2 / variance, axis=0) / float(chdtri(1, 0.5))
        return np.asarray(np.maximum(1.0, middle))


_INFORMATION: Final = 1e-2 * np.array([1e-2, *PRIOR])
"""Weak information on the unknowns of a camera in a block of bins."""


def _median(values: Floats) -> float:
    known = values[np.isfinite(values)]
    return float(np.median(known)) if len(known) else 0.0


def _solve_blocks(
    matrix: Floats, score: Floats, first: Integers, last: Integers, prior: Floats
) -> tuple[Floats, Floats]:
    """Return solutions (n, k) of blocks of bins from a first to before a last, and covariances."""
    held, pull = (
        np.concatenate([np.zeros_like(each[:1]), np.cumsum(each, axis=0)])
        for each in (matrix, score)
    )
    covariance = np.linalg.inv(held[last] - held[first] + prior)
    return (covariance @ (pull[last] - pull[first])[..., None])[..., 0], covariance


def sum_joints(
    cameras: Camera,
    seen: KeypointDetections,
    joints: Floats,
    start: int,
    fps: float,
    bins: tuple[int, int],
    settings: TriangulationSettings = LOOSE,
) -> ChangeSums:
    """Return the equations of a chunk of a clip; its first and last rows give velocities only.

    `seen` has tracked people (frames, cameras, detections), joints (frames, persons, 17, 3) [m] are
    in the world. `start` is the row of the first of these frames in the clip, at `fps` rows per
    second; `bins` are as of `choose_bins`.
    """
    (length, every), limbs = bins, np.full_like(joints, np.nan)
    limbs[:, :, LIMBS] = joints[:, :, LIMBS]
    rows = choose_rows(len(joints), start, fps, every)
    people = shift_in_time(seen[rows], np.zeros(1))
    rig = Rig.from_cameras(cameras)
    moving = MovingJoints.at_rows(rig, people, limbs, rows, half_window(fps), settings)
    if not len(moving.at):
        return ChangeSums.join([], cameras, fps)
    number = (start + moving.frame) // length
    added = sum_equations(replace(moving, person=number), with_cameras=True)
    middles = np.asarray(np.unique(number) * length + 0.5 * (length - 1), np.float64)
    return ChangeSums(added.information, added.score, middles, fps, cameras.focal.mean(axis=-1))


def half_window(fps: float) -> int:
    """Return half the rows over which velocity is computed: 0.06 s."""
    return max(1, round(0.06 * fps))


def choose_rows(count: int, start: int, fps: float, every: int) -> Integers:
    """Return the rows of a chunk that are used."""
    rows = np.arange(half_window(fps), count - half_window(fps))
    return np.asarray(rows[(start + rows) % every == every // 2])


def choose_bins(terms: int, fps: float) -> tuple[int, int]:
    """Return the rows of a bin of 0.2 s, and every how many rows one is used."""
    length = max(1, round(0.2 * fps))
    # Rows of long clips cost time. Neighbouring rows have errors in common, but of a step of one
    # frame, every third row tells four times as much as one of a bin.
    return length, min(length, 1 + terms // 50_000)
