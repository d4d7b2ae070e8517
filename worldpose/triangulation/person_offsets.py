"""Image offset of each person in each camera, caused by calibration errors.

A camera's calibration error moves all joints of a person by about the same vector in the image,
because people are small. The vector is unknown and normal; its variance is that of calibration.
The alternative of the paper shifts every image of a person so that the rays of the mid-hip meet.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from data_contracts.arrays import AnyFloats, Flags, Floats
from data_contracts.conventions import COCO17_HIPS
from data_contracts.keypoints import KeypointDetections
from worldpose.compiled import compile_kernel
from worldpose.geometry import camera_model
from worldpose.geometry.cameras import Camera
from worldpose.triangulation.noise_model import NoiseModel
from worldpose.triangulation.report import Histogram
from worldpose.triangulation.residuals import (
    Buffers,
    Observations,
    Rig,
    State,
    Tile,
    Tiles,
    no_shift,
    read_tile,
)
from worldpose.triangulation.settings import TriangulationSettings
from worldpose.triangulation.solve import SolvedJoints, solve_joints, take_step


@dataclass(frozen=True, eq=False)
class StatedErrors:
    """Variance of people's image positions caused by calibration errors.

    Attributes:
        variance: (frames, cameras, persons) per axis [px^2]; 0 where the position is unknown.
        scale: (frames, cameras, persons) image scale there [px/m]; 0 where unknown.
    """

    variance: Floats
    scale: Floats

    def position_std(self, factor: float, shown: Flags) -> tuple[Histogram, ...]:
        """Return the standard deviation at people [m], variance times `factor`, by camera.

        `shown` (frames, cameras, persons) are the people that a camera detects: beyond its image
        the derivatives of its lens grow without limit, and displace nobody.
        """
        there = shown & (self.variance > 0.0)
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

    A person's position is the mean of the joints (frames, persons, joints, 3) [m], world. The
    covariance (cameras, 12, 12) is of steps in the order of `PARAMETERS`; `calibration_error_m`
    replaces a missing one.
    """
    found = np.isfinite(joints[..., 0])
    number = np.maximum(found.sum(axis=-1), 1)[..., None]
    places = np.where(found[..., None], joints, 0.0).sum(axis=-2) / number
    known = found.any(axis=-1)
    pose = cameras.cam_from_world
    shape = (len(joints), len(cameras.focal), joints.shape[1])
    variance, scale = np.zeros(shape), np.zeros(shape)
    # k1, k2, k3 among the five coefficients.
    radial = [0, 1, 4]
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
        steps = (seen.d_pose, by_focal, seen.d_intrinsics[..., 2:], seen.d_distortion[..., radial])
        jacobian = np.concatenate(steps, axis=-1)
        spread = ((jacobian @ camera_covariance[camera]) * jacobian).sum(axis=(-2, -1)) / 2.0
        variance[:, camera][before] = np.where(np.isfinite(spread), spread, 0.0)
    return StatedErrors(variance, scale)


def learn_factor(
    observations: Observations, noise: tuple[float, float], first: SolvedJoints, stated: Floats
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
        _solve_bodies(
            observations._replace(shift=no_shift()),
            noise,
            first,
            factor * stated,
            Buffers.of(stated.shape[1]),
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
    observations: Observations, noise: tuple[float, float], first: SolvedJoints, variance: Floats
) -> tuple[Floats, Floats]:
    """Return the most probable offsets of people in the images, estimated with the joints.

    The paper uses the mid-hip residual in each image as the offset, which adds the detector's
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
    _solve_bodies(
        observations._replace(shift=no_shift()),
        noise,
        first,
        variance,
        Buffers.of(variance.shape[1]),
        offsets,
        unknown,
        further,
    )
    return np.concatenate([offsets, np.zeros((*variance.shape, 1))], axis=-1), further


def estimate_midhip_shift(
    rig: Rig, detections: KeypointDetections, settings: TriangulationSettings
) -> Floats:
    """Return the mid-hip residual of each person in each image, with zero as third component.

        X* = arg min sum_c |(Pi(X) - Pi(X_mid)) - (x - x_mid)|^2

    With the shift x_mid - Pi(X_mid) subtracted from x, `residuals.add_data` minimizes this. It is 0
    in an image without both hips, and for a person without a mid-hip.

    Returns:
        (frames, cameras, persons, 3) [px].
    """
    index = detections.detection_index
    hips = detections.keypoints[..., COCO17_HIPS, :]
    middle = hips.mean(axis=-2, keepdims=True, dtype=np.float64)
    sure = detections.confidence[..., COCO17_HIPS].min(axis=-1, keepdims=True)
    precision = NoiseModel.nominal(1).precision(sure)
    observed = Observations.of(rig, middle, precision, index)
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


class _Equations(NamedTuple):
    """Normal equations of a person's offsets, two unknowns per camera.

    Attributes:
        matrix: (unknowns, unknowns).
        right: (unknowns,).
        mixed: (3, unknowns) products of one joint and the offsets.
    """

    matrix: Floats
    right: Floats
    mixed: Floats


@compile_kernel
def _solve_bodies(
    observations: Observations,
    noise: tuple[float, float],
    first: SolvedJoints,
    prior: Floats,
    buffers: Buffers,
    offsets: Floats,
    variance: Floats,
    further: Floats,
) -> None:
    """Minimize E_body of each person; the joints are eliminated (Schur complement).

    Observations have no shift; noise is [px], [m]; `first` has joints and inliers without offsets,
    and `prior` tau^2 (frames, cameras, persons) [px^2]. Written are `offsets` (frames, cameras,
    persons, 2) [px], their `variance` per axis (frames, cameras, persons) [px^2], and `further`
    (frames, persons, joints, 3, 3) [m^2], their contribution to the joints' covariance; no frames =
    not wanted.
    """
    frames, count, persons = observations.detection_index.shape
    joint_count = observations.precision.shape[3]
    joints, inliers = first.joints, first.inliers
    tiles, state, depths = buffers.tiles, buffers.state[0], observations.rig.depths
    slot = np.empty(count, np.int64)
    for t in range(frames):
        for n in range(persons):
            read_tile(observations, (t * persons + n) * joint_count, tiles)
            size = _assign_unknowns(inliers[t, :, n], prior[t, :, n], tiles, slot)
            if size == 0:
                continue
            for j in range(joint_count):
                for k in range(3):
                    state["point"][k, j] = joints[t, n, j, k]
            state["sharpness"][:] = 0.0
            take_step(tiles, depths, noise, state)
            h, right = np.zeros((size, size)), np.zeros(size)
            w = np.zeros((3, size))
            equations = _Equations(h, right, w)
            for c in range(count):
                if slot[c] >= 0:
                    h[slot[c], slot[c]] = h[slot[c] + 1, slot[c] + 1] = 1.0 / prior[t, c, n]
            # Rows of `moves` follow each other in memory, so that inner loops are vector code.
            moves = np.zeros((joint_count, 3, size))
            for j in range(joint_count):
                if math.isfinite(joints[t, n, j, 0]):
                    w[:] = 0.0
                    for c in range(count):
                        if slot[c] >= 0 and tiles[c]["used"][j] > 0.0:
                            at, point = slot[c], joints[t, n, j]
                            _add_view(tiles[c], depths[c], noise, j, point, at, equations)
                    _eliminate_joint(state, j, equations, moves[j])
            covariance = np.linalg.inv(h)
            for c in range(count):
                at = slot[c]
                if at >= 0:
                    for axis in range(2):
                        total = 0.0
                        for k in range(size):
                            total += covariance[at + axis, k] * right[k]
                        offsets[t, c, n, axis] = total
                    variance[t, c, n] = 0.5 * (covariance[at, at] + covariance[at + 1, at + 1])
            if len(further):
                _spread_offsets(moves, covariance, further[t, n])


@compile_kernel
def _assign_unknowns(
    inliers: NDArray[np.bool_], prior: Floats, tiles: Tiles, slot: NDArray[np.int64]
) -> int:
    """Mark a person's inliers (cameras, joints) as `used` in tiles; return the number of unknowns.

    The prior is (cameras,) [px^2]; `slot` (cameras,) is written, the place of a camera's two
    unknowns, -1 = none.
    """
    size = 0
    for c in range(len(tiles)):
        used = tiles[c]["used"]
        used[:] = 0.0
        some = False
        for j in range(inliers.shape[1]):
            if inliers[c, j]:
                used[j] = 1.0
                some = True
        slot[c] = -1
        if some and prior[c] > 0.0:
            slot[c] = size
            size += 2
    return size


@compile_kernel
def _add_view(
    tile: Tile,
    p: Floats,
    noise: tuple[float, float],
    j: int,
    point: Floats,
    at: int,
    equations: _Equations,
) -> None:
    """Add one view of joint j to the equations of its camera's offset.

    The camera has depth p (4,), the noise is [px], [m], and the joint's point is (3,) [m]. The
    camera's unknowns are from place `at` on; `mixed` is written, the other equations are added to.
    """
    h, right, w = equations.matrix, equations.right, equations.mixed
    x, y, z = point
    inverse = 1.0 / (p[0] * x + p[1] * y + p[2] * z + p[3])
    g = tile["precision"][j]
    weight = g / (
        noise[0] ** 2 + tile["scale"][j] * inverse * inverse * noise[1] ** 2 + g * tile["extra"][j]
    )
    for axis in range(2):
        a, b, d, s = tile["a"][0, j], tile["a"][1, j], tile["a"][2, j], tile["a"][3, j]
        if axis == 1:
            a, b, d, s = tile["b"][0, j], tile["b"][1, j], tile["b"][2, j], tile["b"][3, j]
        e = (a * x + b * y + d * z + s) * inverse
        w[0, at + axis] = weight * (a - e * p[0]) * inverse
        w[1, at + axis] = weight * (b - e * p[1]) * inverse
        w[2, at + axis] = weight * (d - e * p[2]) * inverse
        h[at + axis, at + axis] += weight
        # The errors are projection less observation: the offset's sign flips.
        right[at + axis] -= weight * e


@compile_kernel
def _eliminate_joint(state: State, j: int, equations: _Equations, moves: Floats) -> None:
    """Subtract what the joint, free to move, explains; write its motion `moves` (3, unknowns)."""
    h, right, w = equations.matrix, equations.right, equations.mixed
    matrix = state["matrix"]
    xx, xy, xz = matrix[0, j], matrix[1, j], matrix[2, j]
    yy, yz, zz = matrix[3, j], matrix[4, j], matrix[5, j]
    for i in range(len(right)):
        u, v, q = w[0, i], w[1, i], w[2, i]
        moves[0, i] = u * xx + v * xy + q * xz
        moves[1, i] = u * xy + v * yy + q * yz
        moves[2, i] = u * xz + v * yz + q * zz
        for k in range(3):
            right[i] -= moves[k, i] * state["right"][k, j]
    for i in range(len(right)):
        u, v, q = moves[0, i], moves[1, i], moves[2, i]
        for k in range(len(right)):
            h[i, k] -= u * w[0, k] + v * w[1, k] + q * w[2, k]


@compile_kernel
def _spread_offsets(moves: Floats, covariance: AnyFloats, further: Floats) -> None:
    """Write the covariance (joints, 3, 3) [m^2] that offsets give to joints that follow them."""
    rows = moves.reshape(3 * len(moves), len(covariance))
    spread = rows @ covariance
    for j in range(len(moves)):
        for i in range(3):
            for k in range(i + 1):
                total = (rows[3 * j + i] * spread[3 * j + k]).sum()
                further[j, i, k] = further[j, k, i] = total
