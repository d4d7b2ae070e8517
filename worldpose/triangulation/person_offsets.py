"""Image offset of each person in each camera, caused by calibration errors (T4).

A camera's calibration error moves all joints of a person by about the same vector in the image,
because people are small. The vector is unknown and normal; its variance is that of calibration.
The alternative of the paper shifts every image of a person so that the rays of the mid-hip meet.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from data_contracts.arrays import Floats
from data_contracts.conventions import COCO17
from data_contracts.keypoints import KeypointDetections
from worldpose.compiled import compile_kernel
from worldpose.geometry import camera_model
from worldpose.geometry.cameras import Camera
from worldpose.triangulation.batched_gauss_newton import (
    EXTRA,
    LANES,
    MATRIX,
    POINT,
    PRECISION,
    RIGHT,
    ROWS,
    SCALE,
    SHARPNESS,
    STATE,
    USED,
    A,
    B,
    step,
)
from worldpose.triangulation.noise_model import NoiseModel
from worldpose.triangulation.observations import Observations, Rig, gather, linearize, no_shift
from worldpose.triangulation.reports import Histogram
from worldpose.triangulation.settings import TriangulationSettings
from worldpose.triangulation.solving import Solution, solve_joints

RADIAL = [0, 1, 4]
"""k1, k2, k3 among the five coefficients."""
HIPS = [COCO17.index("left_hip"), COCO17.index("right_hip")]


@dataclass(frozen=True, eq=False)
class StatedErrors:
    """Variance of people's image positions caused by calibration errors.

    Attributes:
        variance: (frames, cameras, persons) per axis [px^2]; 0 where the position is unknown.
        scale: (frames, cameras, persons) image scale there [px/m]; 0 where unknown.
    """

    variance: Floats
    scale: Floats

    def position_std(self, factor: float) -> tuple[Histogram, ...]:
        """Return the standard deviation at people [m], variance times `factor`, by camera."""
        there = self.variance > 0.0
        variance = np.where(there, self.variance, 0.0) / np.where(there, self.scale, 1.0) ** 2
        root = np.sqrt(factor * variance)
        return tuple(Histogram.of(root[:, c][there[:, c]]) for c in range(there.shape[1]))


def stated_errors(
    cameras: Camera,
    joints: Floats,
    settings: TriangulationSettings,
    camera_covariance: Floats | None,
) -> StatedErrors:
    """Return the variance of each person's position in each image.

    Args:
        cameras: batch (cameras,).
        joints: (frames, persons, joints, 3) [m], world; their mean is the person's position.
        settings: `calibration_error_m` replaces a missing covariance.
        camera_covariance: (cameras, 12, 12) covariance of steps in the order of `PARAMETERS`, or
            None.
    """
    found = np.isfinite(joints[..., 0])
    number = np.maximum(found.sum(axis=-1), 1)[..., None]
    places = np.where(found[..., None], joints, 0.0).sum(axis=-2) / number
    known = found.any(axis=-1)
    pose = cameras.cam_from_world
    shape = (len(joints), len(cameras.focal), joints.shape[1])
    variance, scale = np.zeros(shape), np.zeros(shape)
    for camera in range(shape[1]):
        depth = places @ pose.rotation[camera, 2] + pose.translation[camera, 2]
        # A missing camera sees no person.
        before = known & (depth > 0.0) & bool(np.isfinite(cameras.focal[camera]).all())
        size = np.sqrt(cameras.focal[camera].prod()) / np.where(before, depth, 1.0)
        scale[:, camera] = np.where(before, size, 0.0)
        if camera_covariance is None:
            variance[:, camera] = (settings.calibration_error_m * scale[:, camera]) ** 2
            continue
        seen = cameras[camera].project_with_jacobians(places[before])
        by_focal = (seen.d_intrinsics[..., :2] * cameras.focal[camera]).sum(-1, keepdims=True)
        steps = (seen.d_pose, by_focal, seen.d_intrinsics[..., 2:], seen.d_distortion[..., RADIAL])
        jacobian = np.concatenate(steps, axis=-1)
        spread = ((jacobian @ camera_covariance[camera]) * jacobian).sum(axis=(-2, -1)) / 2.0
        variance[:, camera][before] = np.where(np.isfinite(spread), spread, 0.0)
    return StatedErrors(variance, scale)


def learn_factor(
    observations: Observations,
    noise: tuple[float, float],
    first: Solution,
    stated: Floats,
) -> float:
    """Return the most probable factor on the stated variance for a sample of frames.

    All cameras share the factor: a camera's own error is a single draw, which does not determine
    its variance. Arguments are those of `estimate_offsets`.
    """
    factor, known = 1.0, first.inliers.any(axis=-1) & (stated > 0.0)
    scale = np.where(known, stated, 1.0)
    damping = 4.0  # Weight of the factor before an update, in degrees of freedom.
    # The last update changes it by a few percent.
    for _ in range(6 if known.any() else 0):
        offsets, variance = np.zeros((*stated.shape, 2)), np.zeros(stated.shape)
        _body_offsets(
            observations._replace(shift=no_shift()),
            noise,
            first.joints,
            first.inliers,
            factor * stated,
            offsets,
            variance,
            np.empty((0, 0, 0, 3, 3)),
        )
        squares = np.where(known, (offsets**2).sum(axis=-1) / scale, 0.0).sum()
        # Degrees of freedom that the observations determine (MacKay 1992).
        freedom = np.where(known, 2.0 * (1.0 - variance / (factor * scale)), 0.0).sum()
        factor = max(1e-3, float((squares + damping * factor) / (freedom + damping)))
    return factor


def estimate_offsets(
    observations: Observations,
    noise: tuple[float, float],
    first: Solution,
    variance: Floats,
) -> tuple[Floats, Floats]:
    """Return the most probable offsets of people in the images, estimated with the joints.

    T4 of the paper uses the mid-hip residual in each image as the offset, which adds the detector's
    hip error to every joint. All joints together determine the offset more accurately, and cameras
    that agree get none.

    Args:
        observations: observations of all tracked people; their shift is not used.
        noise: [px], [m].
        first: the joints without offsets.
        variance: (frames, cameras, persons) calibration variance per axis [px^2].

    Returns:
        Offsets (frames, cameras, persons, 3) [px] with a zero, and their contribution to the
        covariance of joints (frames, persons, joints, 3, 3) [m^2].
    """
    offsets, unknown = np.zeros((*variance.shape, 2)), np.zeros(variance.shape)
    further = np.zeros((*first.joints.shape, 3))
    _body_offsets(
        observations._replace(shift=no_shift()),
        noise,
        first.joints,
        first.inliers,
        variance,
        offsets,
        unknown,
        further,
    )
    return np.concatenate([offsets, np.zeros((*variance.shape, 1))], axis=-1), further


def estimate_midhip_shift(
    rig: Rig, detections: KeypointDetections, settings: TriangulationSettings
) -> Floats:
    """Return the mid-hip residual of each person in each image, with zero as third component.

    With the shift subtracted, reprojection residuals are those of the paper's second stage,
    relative to the mid-hip. The shift is 0 in an image without both hips, and for a person without
    a mid-hip.

    Returns:
        (frames, cameras, persons, 3) [px].
    """
    index = detections.detection_index
    middle = detections.keypoints[..., HIPS, :].mean(axis=-2, keepdims=True, dtype=np.float64)
    sure = detections.confidence[..., HIPS].min(axis=-1, keepdims=True)
    precision = NoiseModel.nominal(1).precision(sure)
    observed = Observations.from_rig(rig, middle, precision, index)
    joints = solve_joints(observed, settings).joints[:, :, 0]
    image = np.empty((len(rig.cameras), joints[..., 0].size, 2))
    points = np.ascontiguousarray(np.broadcast_to(joints.reshape(1, -1, 3), (*image.shape[:2], 3)))
    camera_model.project(rig.cameras, points, image)
    image = image.reshape(-1, *joints.shape[:2], 2).swapaxes(0, 1)
    place = np.maximum(index, 0).astype(np.int64)[..., None]
    pixels = np.take_along_axis(middle[..., 0, :], place, axis=2)
    there = (index >= 0) & (np.take_along_axis(precision[..., 0], place[..., 0], axis=2) > 0.0)
    shift = np.where(there[..., None], pixels - image, 0.0)
    shift = np.where(np.isfinite(shift), shift, 0.0)
    return np.concatenate([shift, np.zeros((*index.shape, 1))], axis=-1)


@compile_kernel
def _body_offsets(
    observations: Observations,
    noise: tuple[float, float],
    joints: Floats,
    inliers: NDArray[np.bool_],
    prior: Floats,
    offsets: Floats,
    variance: Floats,
    further: Floats,
) -> None:
    """Write the most probable offsets of people in the images, estimated with the joints.

    All joints of a person in one image share the same offset, normal with variance `prior`. The
    joints are eliminated (Schur complement), which leaves two unknowns per camera.

    Args:
        observations: observations of all tracked people, without a shift.
        noise: [px], [m].
        joints: (frames, persons, joints, 3) [m] solved without offsets.
        inliers: (frames, cameras, persons, joints).
        prior: (frames, cameras, persons) [px^2].
        offsets: (frames, cameras, persons, 2) [px], written.
        variance: (frames, cameras, persons) [px^2] per axis, of the offsets, written.
        further: (frames, persons, joints, 3, 3) [m^2], contribution of the offsets to the joints'
            covariance, written; no frames = not wanted.
    """
    cameras, depths = observations.cameras, observations.depths
    frames, count, persons = observations.detection_index.shape
    joint_count = observations.precision.shape[3]
    tiles, state = np.empty((count, ROWS * LANES)), np.zeros(STATE * LANES)
    slot = np.empty(count, np.int64)
    for t in range(frames):
        for n in range(persons):
            for c in range(count):
                tiles[c, PRECISION : PRECISION + LANES] = 0.0
            gather(observations, (t * persons + n) * joint_count, tiles)
            size = 0
            for c in range(count):
                linearize(tiles[c], cameras, c)
                tiles[c, USED : USED + LANES] = 0.0
                some = False
                for j in range(joint_count):
                    if inliers[t, c, n, j]:
                        tiles[c, USED + j] = 1.0
                        some = True
                slot[c] = -1
                if some and prior[t, c, n] > 0.0:
                    slot[c] = size
                    size += 2
            if size == 0:
                continue
            for j in range(joint_count):
                for k in range(3):
                    state[POINT + k * LANES + j] = joints[t, n, j, k]
            state[SHARPNESS : SHARPNESS + LANES] = 0.0
            step(tiles, depths, noise, state)
            h, right = np.zeros((size, size)), np.zeros(size)
            for c in range(count):
                if slot[c] >= 0:
                    h[slot[c], slot[c]] = h[slot[c] + 1, slot[c] + 1] = 1.0 / prior[t, c, n]
            # Rows of `moves` follow each other in memory, so that inner loops are vector code.
            w, moves = np.zeros((3, size)), np.zeros((joint_count, 3, size))
            for j in range(joint_count):
                if not math.isfinite(joints[t, n, j, 0]):
                    continue
                x, y, z = joints[t, n, j]
                w[:] = 0.0
                for c in range(count):
                    at = slot[c]
                    if at < 0 or tiles[c, USED + j] == 0.0:
                        continue
                    tile, p = tiles[c], depths[c]
                    inverse = 1.0 / (p[0] * x + p[1] * y + p[2] * z + p[3])
                    g = tile[PRECISION + j]
                    weight = g / (
                        noise[0] ** 2
                        + tile[SCALE + j] * inverse * inverse * noise[1] ** 2
                        + g * tile[EXTRA + j]
                    )
                    for axis in range(2):
                        o = (A if axis == 0 else B) + j
                        a, b, d = tile[o], tile[o + LANES], tile[o + 2 * LANES]
                        e = (a * x + b * y + d * z + tile[o + 3 * LANES]) * inverse
                        w[0, at + axis] = weight * (a - e * p[0]) * inverse
                        w[1, at + axis] = weight * (b - e * p[1]) * inverse
                        w[2, at + axis] = weight * (d - e * p[2]) * inverse
                        h[at + axis, at + axis] += weight
                        # The errors are projection less observation: the offset's sign flips.
                        right[at + axis] -= weight * e
                xx, xy, xz = (
                    state[MATRIX + j],
                    state[MATRIX + LANES + j],
                    state[MATRIX + 2 * LANES + j],
                )
                yy, yz = state[MATRIX + 3 * LANES + j], state[MATRIX + 4 * LANES + j]
                zz = state[MATRIX + 5 * LANES + j]
                both = moves[j]
                for i in range(size):
                    u, v, q = w[0, i], w[1, i], w[2, i]
                    both[0, i] = u * xx + v * xy + q * xz
                    both[1, i] = u * xy + v * yy + q * yz
                    both[2, i] = u * xz + v * yz + q * zz
                    for k in range(3):
                        right[i] -= both[k, i] * state[RIGHT + k * LANES + j]
                for i in range(size):
                    u, v, q = both[0, i], both[1, i], both[2, i]
                    for k in range(size):
                        h[i, k] -= u * w[0, k] + v * w[1, k] + q * w[2, k]
            covariance = np.linalg.inv(h)
            for c in range(count):
                at = slot[c]
                if at < 0:
                    continue
                for axis in range(2):
                    total = 0.0
                    for k in range(size):
                        total += covariance[at + axis, k] * right[k]
                    offsets[t, c, n, axis] = total
                variance[t, c, n] = 0.5 * (covariance[at, at] + covariance[at + 1, at + 1])
            if len(further):
                rows = moves.reshape(3 * joint_count, size)
                spread = rows @ covariance
                for j in range(joint_count):
                    for i in range(3):
                        for k in range(i + 1):
                            total = (rows[3 * j + i] * spread[3 * j + k]).sum()
                            further[t, n, j, i, k] = further[t, n, j, k, i] = total
