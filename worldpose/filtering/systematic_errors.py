"""Systematic errors of keypoints: bias by viewing direction, and clock offsets.

Both are learned from all people of a clip together. The next iteration subtracts them from each
keypoint; they contain no error of a single person.

From the side, a detector puts a hip closer to the front than from ahead: an error that all people
and cameras share and that more views of the same side do not average out. Bodies fitted to all
views reveal it.

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
from worldpose.body_fitting.evidence import body_axes
from worldpose.compiled import map_in_threads
from worldpose.filtering.judging import (
    BodyViews,
    Places,
    Residuals,
    TriangulatedDetections,
    body_residuals,
    judge_detections,
    learn_keypoint_spread,
)
from worldpose.filtering.settings import FilteringSettings
from worldpose.geometry.cameras import Camera
from worldpose.static_calibration.parameters import by_step

WAVES: Final = (2, 3)
"""Harmonics of the azimuth. A constant bias and the first harmonic are those of a point next to the
joint, which the offsets of body fitting cover; higher harmonics would let the bias vary within a
sixth of a turn."""
TERMS: Final = 2 * len(WAVES)


@dataclass(frozen=True, eq=False)
class ViewBias:
    """Bias of keypoints by viewing direction.

    Attributes:
        coefficient: (17, 2, 4) [m], of each joint along the image axes: cosines, then sines, of the
            multiples of the azimuth in `WAVES`.
    """

    coefficient: Floats

    @classmethod
    def none(cls) -> ViewBias:
        """Return the zero bias of a detector with equal errors from all directions."""
        return cls(np.zeros((17, 2, TERMS)))

    def shift(self, azimuth: NDArray[np.floating], scale: NDArray[np.floating]) -> Floats:
        """Return the bias of keypoints (..., 17, 2) [px].

        The azimuth (...) [rad] is that of the camera seen from the body, NaN = unknown, the scale
        (...) [px/m].
        """
        waves = _waves(azimuth) * np.asarray(scale)[..., None]
        return np.asarray(np.einsum("...w,jaw->...ja", waves, self.coefficient))


def find_azimuths(cameras: Camera, joints: Floats) -> Floats:
    """Return the azimuth of each camera as seen from bodies (frames, cameras, persons) [rad].

    0 is in front of a body, a quarter turn to its left; NaN without a body. Joints are (frames,
    persons, 17, 3) [m], world.
    """
    axes = body_axes(joints)
    middle = joints[..., (5, 6, 11, 12), :].mean(axis=-2)
    away = cameras.center[:, None] - middle[:, None]
    ahead, left = (np.einsum("fcpa,fpa->fcp", away, axes[..., k]) for k in (0, 1))
    return np.asarray(np.arctan2(left, ahead))


def learn_view_bias(residuals: Residuals, azimuth: Floats, scale: Floats) -> ViewBias:
    """Return the bias by viewing direction, by linear least squares of residuals of bodies.

    Each row has an azimuth (n,) [rad] and a scale (n,) [px/m].
    """
    weight = residuals.weight * (np.isfinite(azimuth) & np.isfinite(scale))[:, None]
    waves = np.nan_to_num(_waves(azimuth) * scale[:, None])
    missed = np.where(weight[..., None] > 0.0, residuals.missed, 0.0)
    matrix = np.einsum("nw,nj,nv->jwv", waves, weight, waves, optimize=True)
    right = np.einsum("nw,nj,nja->jwa", waves, weight, missed, optimize=True)
    # Prior standard deviation of each coefficient [m]: a hundredth of a body.
    matrix = matrix + np.eye(TERMS) / 0.02**2
    return ViewBias(np.linalg.solve(matrix, right).swapaxes(-1, -2).astype(np.float64))


def _waves(azimuth: NDArray[np.floating]) -> Floats:
    angles = np.asarray(azimuth, dtype=np.float64)[..., None] * np.array(WAVES)
    return np.concatenate([np.cos(angles), np.sin(angles)], axis=-1)


STEP: Final = 7
"""Parameters of a camera's step: rotation, shift and focal length."""
EXPECTED: Final = np.array([*(0.003,) * 3, *(0.5,) * 3, 0.005])
"""Standard deviation of a camera's rotation [rad], shift [m] and focal length [1]: ten times the
error of careful calibration."""


@dataclass(frozen=True, eq=False)
class SystematicErrors:
    """Systematic errors of a clip's detector, by viewing direction, and of its clocks.

    `late` (cameras,) is the clock offset of each camera relative to the cameras' mean [frame];
    positive = the camera shows a later time.
    """

    view_bias: ViewBias
    late: Floats

    @classmethod
    def none(cls, cameras: int) -> SystematicErrors:
        """Return zero errors."""
        return cls(ViewBias.none(), np.zeros(cameras))

    def shift(self, motion: BodyMotion, views: BodyViews) -> Floats:
        """Return the systematic error of keypoints (frames, cameras, persons, 17, 2) [px].

        The shift is NaN where a body, or its motion, is unknown.
        """
        sides = self.view_bias.shift(motion.azimuth, _scale(views))
        return np.asarray(sides + self.late[:, None, None, None] * motion.image_motion)

    def clock_offsets_in(self, offsets: Floats, motion: BodyMotion) -> Floats:
        """Return the part of the clock offsets that people's offsets contain (cameras,) [frame].

        People's offsets (frames, cameras, persons, 2) [px] belong to joints triangulated without
        clock offsets, so a camera seems to see people displaced along their motion.
        """
        image_motion = np.nan_to_num(motion.image_motion.mean(axis=-2))
        along = (np.nan_to_num(offsets) * image_motion).sum(axis=(0, 2, 3))
        held = along / np.maximum((image_motion**2).sum(axis=(0, 2, 3)), 1e-12)
        return np.asarray(np.clip(held, np.minimum(self.late, 0.0), np.maximum(self.late, 0.0)))


@dataclass(frozen=True, eq=False)
class BodyMotion:
    """Azimuth and image motion of bodies in all images."""

    azimuth: Floats
    """(frames, cameras, persons) azimuth of the camera, seen from the body [rad]."""
    image_motion: Floats
    """(frames, cameras, persons, 17, 2) motion of joints per frame [px]."""


def watch_motion(cameras: Camera, joints: Floats, step: Floats) -> BodyMotion:
    """Return azimuth and image motion of bodies in all images of a batch (cameras,).

    Joints (frames, persons, 17, 3) [m], world, move by a step of that shape per frame.
    """
    ends = [
        cameras.project((joints + part * step).reshape(len(joints), 1, -1, 3))
        for part in (-0.5, 0.5)
    ]
    shape = (len(joints), cameras.batch_shape[0], *joints.shape[1:3], 2)
    return BodyMotion(find_azimuths(cameras, joints), (ends[1] - ends[0]).reshape(shape))


def learn_systematic_errors(
    cameras: Camera,
    joints: Floats,
    views: BodyViews,
    motion: BodyMotion,
    suspects: TriangulatedDetections,
    settings: FilteringSettings,
    fps: float,
) -> SystematicErrors:
    """Return the systematic errors of keypoints that fit their bodies.

    Args:
        cameras: batch (cameras,).
        joints: (frames, persons, 17, 3) [m], world, of the bodies, as the detector sees them.
        views: projections of the bodies in all images.
        motion: motion of the bodies.
        suspects: detections in these frames.
        settings: limits of the consistency check.
        fps: frame rate of these frames [1/s].
    """
    systematic = SystematicErrors.none(cameras.batch_shape[0])
    # Correlation time of a detector's error, to a factor e [s].
    repeated = max(1.0, 2.0 * 0.3 * fps)
    # Passes of judging and learning: the second judges with the result of the first.
    for _ in range(2):
        corrected = suspects.subtract(systematic.shift(motion, views))
        spread = learn_keypoint_spread(views, corrected)
        judged = judge_detections(views, corrected, spread, settings)
        residuals = body_residuals(views, suspects, judged, spread, repeated)
        at = residuals.frame, residuals.camera, residuals.person
        azimuth, image_motion, scale = (
            motion.azimuth[at],
            motion.image_motion[at],
            _scale(views)[at],
        )
        clocks = ClockEquations.from_residuals(cameras, joints, image_motion, residuals)
        # Alternations between view bias and clock offsets within a pass.
        for _ in range(3):
            late = systematic.late[residuals.camera, None, None]
            bias = learn_view_bias(
                residuals.less(late * np.nan_to_num(image_motion)), azimuth, scale
            )
            sides = np.nan_to_num(bias.shift(azimuth, scale))
            systematic = SystematicErrors(bias, clocks.learn_clock_offsets(residuals.less(sides)))
    return systematic


def _scale(views: BodyViews) -> Floats:
    """Return the image scale at a body's hips (frames, cameras, persons) [px/m]."""
    return np.asarray(views.scale[..., (11, 12)].mean(axis=-1))


@dataclass(frozen=True, eq=False)
class _CameraEquations:
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

    seen: tuple[_CameraEquations, ...]
    """By camera."""
    used: NDArray[np.bool_]
    """(points,) bool, points with observations."""
    follow: Floats
    """(3 used, cameras (1 + STEP)) motion of these points with the unknowns."""
    matrix: Floats
    """(cameras (1 + STEP), cameras (1 + STEP))."""

    @classmethod
    def from_residuals(
        cls, cameras: Camera, joints: Floats, image_motion: Floats, residuals: Residuals
    ) -> ClockEquations:
        """Return the equations; they use the weights of `residuals`, not its values.

        Joints (frames, persons, 17, 3) [m], world, of bodies move by `image_motion` (n, 17, 2) [px]
        per frame, NaN = unknown. `frame` of the residuals indexes the first axis of `joints`.
        """
        persons, joint_count = joints.shape[1:3]
        count, width = cameras.batch_shape[0], 1 + STEP
        points = joints.reshape(-1, 3)
        weight = residuals.weight * np.isfinite(image_motion).all(axis=-1)
        min_information = 1e-6  # Added to the information of a point [1/m^2].
        normal = np.tile(min_information * np.eye(3), (len(points), 1, 1))
        mixed = np.zeros((len(points), 3, count, width))
        matrix = np.zeros((count, width, count, width))

        def observe(camera: int) -> tuple[_CameraEquations, Floats, Floats, Floats]:
            row, joint = np.nonzero((weight > 0.0) & (residuals.camera == camera)[:, None])
            place = (residuals.frame[row] * persons + residuals.person[row]) * joint_count + joint
            by_points = cameras[camera].project_with_jacobians(points[place])
            by_camera = by_step(cameras[camera], by_points)[..., :STEP]
            by_all = np.concatenate([image_motion[row, joint][..., None], by_camera], axis=-1)
            held = weight[row, joint, None, None] * by_all
            held_points = weight[row, joint, None, None] * by_points.d_points
            return (
                _CameraEquations(row, joint, place, held, held_points),
                np.einsum("nak,nal->kl", held, by_all),
                np.einsum("nai,naj->nij", held_points, by_points.d_points),
                np.einsum("nai,nak->nik", held_points, by_all),
            )

        seen = []
        for camera, (own, block, by_point, both) in enumerate(
            map_in_threads(observe, range(count))
        ):
            matrix[camera, :, camera] = block
            # A camera sees a joint of a person at most once per frame.
            normal[own.place] += by_point
            mixed[own.place, :, camera] = both
            seen.append(own)
        used = normal[:, 0, 0] > min_information
        flat = mixed[used].reshape(-1, 3, count * width)
        follow = (np.linalg.inv(normal[used]) @ flat).reshape(-1, count * width)
        reduced = matrix.reshape(count * width, -1) - flat.reshape(-1, count * width).T @ follow
        return cls(tuple(seen), used, follow, reduced)

    def learn_clock_offsets(self, residuals: Residuals) -> Floats:
        """Return clock offsets relative to the mean (cameras,) [frame]; positive = later time."""
        right = np.zeros((len(self.seen), 1 + STEP))
        pulled = np.zeros((len(self.used), 3))
        for camera, seen in enumerate(self.seen):
            missed = residuals.missed[seen.row, seen.joint]
            right[camera] = np.einsum("nak,na->k", seen.held, missed)
            pulled[seen.place] += np.einsum("nai,na->ni", seen.held_points, missed)
        side = right.reshape(-1) - self.follow.T @ pulled[self.used].reshape(-1)
        return _solve_clock_offsets(self.matrix, side, len(self.seen))


def _solve_clock_offsets(matrix: Floats, right: Floats, count: int) -> Floats:
    """Return each camera's first unknown; expectation-maximisation learns their spread.

    If nothing separates clocks from cameras, or all clocks agree, the offsets come out equal.
    """
    spread = 1.0
    # Iterations to learn the spread of clock offsets: exact clocks then come out 0.02 frames apart.
    for _ in range(40):
        prior = np.tile(np.concatenate([[spread**-2], EXPECTED**-2]), count)
        inverse = np.linalg.inv(matrix + np.diag(prior))
        late = (inverse @ right).reshape(count, -1)[:, 0]
        variance = np.diagonal(inverse).reshape(count, -1)[:, 0]
        # Minimum spread of clock offsets [frame].
        spread = max(0.005, float(np.sqrt(np.mean(late**2 + variance))))
    return np.asarray(late - late.mean())
