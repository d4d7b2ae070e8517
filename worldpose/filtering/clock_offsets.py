"""Clock offsets of the cameras, estimated together with their poses.

Cameras that were adjusted to people have absorbed much of their clock offsets, since people who all
run one way look shifted. So clocks and cameras are estimated together here, with every joint free
to follow both.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Final

import numpy as np
from numpy.typing import NDArray

from data_contracts.arrays import Floats
from worldpose.filtering.residuals import Places, Residuals
from worldpose.geometry import Camera
from worldpose.static_calibration.parameters import by_step

STEP: Final = 7
"""Parameters of a camera's step: rotation, shift and focal length."""
EXPECTED: Final = np.array([*(0.003,) * 3, *(0.5,) * 3, 0.005])
"""Standard deviation of a camera's rotation [rad], shift [m] and focal length [1]: ten times the
error of careful calibration."""
LEAST: Final = 1e-6
"""Added to the information of a point [1/m^2]."""
ROUNDS: Final = 40
"""Iterations to learn the spread of clock offsets: exact clocks then come out 0.02 frames apart."""
LEAST_SPREAD: Final = 0.005
"""Minimum spread of clock offsets [frame]."""


@dataclass(frozen=True, eq=False)
class _Seen:
    """Observations of one camera, one entry per joint of each row that counts."""

    row: Places
    joint: Places
    place: Places
    """Index of the point."""
    held: Floats
    """(n, 2, 1 + STEP) weighted derivative of the keypoint by the camera's unknowns."""
    held_points: Floats
    """(n, 2, 3) weighted derivative by the point."""


@dataclass(frozen=True, eq=False)
class ClockEquations:
    """Normal equations of clocks and cameras, with joints eliminated (Schur complement)."""

    seen: tuple[_Seen, ...]
    """By camera."""
    used: NDArray[np.bool_]
    """(points,) bool, points with observations."""
    follow: Floats
    """(3 used, cameras (1 + STEP)) motion of these points with the unknowns."""
    matrix: Floats
    """(cameras (1 + STEP), cameras (1 + STEP))."""

    @classmethod
    def of(
        cls, cameras: Camera, joints: Floats, way: Floats, residuals: Residuals
    ) -> ClockEquations:
        """Return the equations; they use the weights of `residuals`, not its values.

        Args:
            cameras: batch (cameras,).
            joints: (frames, persons, 17, 3) [m], world, of bodies.
            way: (n, 17, 2) [px], image motion of each row's joints per frame; NaN = unknown.
            residuals: of these joints; `frame` indexes the first axis of `joints`.
        """
        persons, joint_count = joints.shape[1:3]
        count, width = cameras.batch_shape[0], 1 + STEP
        points = joints.reshape(-1, 3)
        weight = residuals.weight * np.isfinite(way).all(axis=-1)
        normal = np.tile(LEAST * np.eye(3), (len(points), 1, 1))
        mixed = np.zeros((len(points), 3, count, width))
        matrix = np.zeros((count, width, count, width))
        seen = []
        for camera in range(count):
            row, joint = np.nonzero((weight > 0.0) & (residuals.camera == camera)[:, None])
            place = (residuals.frame[row] * persons + residuals.person[row]) * joint_count + joint
            by_points = cameras[camera].project_with_jacobians(points[place])
            by_camera = by_step(cameras[camera], by_points)[..., :STEP]
            by_all = np.concatenate([way[row, joint][..., None], by_camera], axis=-1)
            held = weight[row, joint, None, None] * by_all
            held_points = weight[row, joint, None, None] * by_points.d_points
            matrix[camera, :, camera] = np.einsum("nak,nal->kl", held, by_all)
            # A camera sees a joint of a person at most once per frame.
            normal[place] += np.einsum("nai,naj->nij", held_points, by_points.d_points)
            mixed[place, :, camera] = np.einsum("nai,nak->nik", held_points, by_all)
            seen.append(_Seen(row, joint, place, held, held_points))
        used = normal[:, 0, 0] > LEAST
        flat = mixed[used].reshape(-1, 3, count * width)
        follow = np.asarray(np.linalg.solve(normal[used], flat), np.float64)
        follow = follow.reshape(-1, count * width)
        whole = matrix.reshape(count * width, -1) - flat.reshape(-1, count * width).T @ follow
        return cls(tuple(seen), used, follow, whole)

    def learn_lateness(self, residuals: Residuals) -> Floats:
        """Return clock offsets relative to the mean (cameras,) [frame]; positive = later time.

        Args:
            residuals: remaining residuals of the keypoints in the equations.
        """
        right = np.zeros((len(self.seen), 1 + STEP))
        pulled = np.zeros((len(self.used), 3))
        for camera, seen in enumerate(self.seen):
            missed = residuals.missed[seen.row, seen.joint]
            right[camera] = np.einsum("nak,na->k", seen.held, missed)
            pulled[seen.place] += np.einsum("nai,na->ni", seen.held_points, missed)
        side = right.reshape(-1) - self.follow.T @ pulled[self.used].reshape(-1)
        return _late(self.matrix, side, len(self.seen))


def _late(matrix: Floats, right: Floats, count: int) -> Floats:
    """Return each camera's first unknown; expectation-maximisation learns their spread.

    If nothing separates clocks from cameras, or all clocks agree, the offsets come out equal.
    """
    spread = 1.0
    for _ in range(ROUNDS):
        prior = np.tile(np.concatenate([[spread**-2], EXPECTED**-2]), count)
        inverse = np.linalg.inv(matrix + np.diag(prior))
        late = (inverse @ right).reshape(count, -1)[:, 0]
        variance = np.diagonal(inverse).reshape(count, -1)[:, 0]
        spread = max(LEAST_SPREAD, float(np.sqrt(np.mean(late**2 + variance))))
    return np.asarray(late - late.mean())
