"""Robust weighted triangulation of every joint of every person (T3)."""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from data_contracts.records import Record
from worldpose.cameras import Camera
from worldpose.cameras.distortion import distort
from worldpose.compiled import compiled
from worldpose.errors import InputError
from worldpose.triangulation.consensus import consensus, spread
from worldpose.triangulation.reprojection import inverse, normal_equations
from worldpose.triangulation.settings import TriangulationSettings

BLOCK = 256
"""Frames undistorted at a time: bounds the memory, not the result."""


class TriangulationReport(Record):
    """How well the views of a clip agree."""

    joints: int
    """Joints found [1]."""
    undetermined: int
    """Joints that some camera saw and that are missing all the same [1]."""
    observations: int
    """Keypoints of tracked people [1]."""
    rejected_share: tuple[float | None, ...]
    """Share of each camera's keypoints, among joints found, that disagree; None without any."""
    mean_views: float | None
    """Mean number of agreeing views of the joints found."""
    reprojection_error_px: float | None
    """Median over joints [px]."""
    standard_deviation_m: float | None
    """Median over joints of the root of the covariance's trace [m]."""


@dataclass(frozen=True)
class Triangulation:
    """Joints in the world, and how sure they are.

    Attributes:
        joints: (frames, persons, 17, 3) [m], world; NaN where not determined.
        covariance: (frames, persons, 17, 3, 3) [m^2], of `joints` from the stated noise.
        views: (frames, persons, 17) uint8, agreeing cameras; 0 where not determined.
        reprojection_error: (frames, persons, 17) float32 [px], root mean square length over the
            agreeing cameras.
        inliers: (frames, cameras, persons, 17) bool, does this camera agree.
        report: figures for the whole clip.
    """

    joints: NDArray[np.float64]
    covariance: NDArray[np.float64]
    views: NDArray[np.uint8]
    reprojection_error: NDArray[np.float32]
    inliers: NDArray[np.bool_]
    report: TriangulationReport


def triangulate_joints(
    cameras: Camera,
    keypoints: NDArray[np.floating],
    confidence: NDArray[np.floating],
    detection_index: NDArray[np.int16],
    settings: TriangulationSettings,
) -> Triangulation:
    """Return every joint of every tracked person where the views that agree put it.

    Each joint is the weighted least-squares point on reprojection over the cameras that agree.
    When not all do, a Geman-McClure loss of shrinking scale finds a majority; without one, the
    two views that the others contradict least. Nothing is filled in.

    Args:
        cameras: batch (cameras,).
        keypoints: (frames, cameras, detections, 17, 2) [px]; NaN where not found.
        confidence: (frames, cameras, detections, 17) in (0, 1]; NaN or 0 leaves a keypoint out.
        detection_index: (frames, cameras, persons), place among the detections; -1 = not seen.
        settings: noise, agreement and least views.

    Raises:
        InputError: the shapes do not fit together.

    Note:
        T3. Residuals are pixels to first order in their length: the lens is linearised at the
        observation, exact enough for any residual that can agree.
    """
    _check(cameras, keypoints, confidence, detection_index)
    frames, count, persons = detection_index.shape
    joint_count = confidence.shape[-1]
    shape = (frames, persons, joint_count)
    joints = np.full((*shape, 3), np.nan)
    covariance = np.full((*shape, 3, 3), np.nan)
    views = np.zeros(shape, np.uint8)
    error = np.full(shape, np.nan, np.float32)
    inliers = np.zeros((frames, count, persons, joint_count), np.bool_)
    seen = np.zeros_like(inliers)
    pose = cameras.cam_from_world
    poses = np.concatenate([pose.rotation, pose.translation[..., None]], axis=-1).reshape(count, 12)
    for start in range(0, frames, BLOCK):
        block = slice(start, start + BLOCK)
        image = np.ascontiguousarray(keypoints[block], dtype=np.float64)
        plane = cameras.normalize(image.reshape(*image.shape[:2], -1, 2)).reshape(image.shape)
        _triangulate(
            plane,
            np.ascontiguousarray(confidence[block], dtype=np.float64),
            np.ascontiguousarray(detection_index[block], dtype=np.int64),
            np.ascontiguousarray(cameras.focal),
            np.ascontiguousarray(cameras.distortion),
            poses,
            (settings.pixel_noise, settings.joint_noise),
            settings.max_deviation**2,
            settings.min_views,
            math.sin(settings.min_angle),
            joints[block],
            covariance[block],
            views[block],
            error[block],
            inliers[block],
            seen[block],
        )
    report = _report(covariance, views, error, inliers, seen)
    return Triangulation(joints, covariance, views, error, inliers, report)


def _check(
    cameras: Camera,
    keypoints: NDArray[np.floating],
    confidence: NDArray[np.floating],
    detection_index: NDArray[np.int16],
) -> None:
    """Raise InputError unless the arrays belong together."""
    if (
        confidence.ndim != 4
        or keypoints.shape != (*confidence.shape, 2)
        or detection_index.ndim != 3
        or detection_index.shape[:2] != confidence.shape[:2]
        or cameras.batch_shape != confidence.shape[1:2]
    ):
        raise InputError(
            "triangulation",
            expected="keypoints (frames, cameras, detections, joints, 2), confidence without the "
            "last, detection_index (frames, cameras, persons), cameras (cameras,)",
            found=f"{keypoints.shape}, {confidence.shape}, {detection_index.shape}, "
            f"{cameras.batch_shape}",
            todo="Give arrays of the same clip and cameras.",
        )
    detections = confidence.shape[2]
    if (
        detection_index.size
        and not -1 <= detection_index.min() <= detection_index.max() < detections
    ):
        raise InputError(
            "triangulation: detection_index",
            expected=f"-1 or the place of one of {detections} detections",
            found=f"{detection_index.min()} to {detection_index.max()}",
            todo="Give the index that was made from these detections.",
        )


def _report(
    covariance: NDArray[np.float64],
    views: NDArray[np.uint8],
    error: NDArray[np.float32],
    inliers: NDArray[np.bool_],
    seen: NDArray[np.bool_],
) -> TriangulationReport:
    """Return the clip's figures from its arrays."""
    found = views > 0
    used = seen & found[:, None]
    observations = used.sum(axis=(0, 2, 3)).tolist()
    agreed = inliers.sum(axis=(0, 2, 3)).tolist()
    trace = np.trace(covariance[found], axis1=-2, axis2=-1)
    some = bool(found.any())
    return TriangulationReport(
        joints=int(found.sum()),
        undetermined=int((seen.any(axis=1) & ~found).sum()),
        observations=int(seen.sum()),
        rejected_share=tuple(
            1.0 - a / n if n else None for a, n in zip(agreed, observations, strict=True)
        ),
        mean_views=float(views[found].mean()) if some else None,
        reprojection_error_px=float(np.median(error[found])) if some else None,
        standard_deviation_m=float(np.median(np.sqrt(trace))) if some else None,
    )


@compiled
def _triangulate(
    plane: NDArray[np.float64],
    confidence: NDArray[np.float64],
    detection_index: NDArray[np.int64],
    focal: NDArray[np.float64],
    distortion: NDArray[np.float64],
    poses: NDArray[np.float64],
    noise: tuple[float, float],
    limit: float,
    min_views: int,
    min_sine: float,
    joints: NDArray[np.float64],
    covariance: NDArray[np.float64],
    views: NDArray[np.uint8],
    error: NDArray[np.float32],
    inliers: NDArray[np.bool_],
    seen: NDArray[np.bool_],
) -> None:
    """Solve joint after joint and writes the last six arguments."""
    frames, cameras, persons = detection_index.shape
    rows, solved_poses = np.empty((cameras, 7)), np.empty((cameras, 12))
    camera = np.empty(cameras, np.int64)
    weights, squared = np.empty(cameras), np.empty(cameras)
    for t in range(frames):
        for person in range(persons):
            for joint in range(joints.shape[2]):
                count = 0
                for c in range(cameras):
                    detection = detection_index[t, c, person]
                    if detection < 0:
                        continue
                    u, v = plane[t, c, detection, joint]
                    weight = confidence[t, c, detection, joint]
                    if not (weight > 0.0 and math.isfinite(u) and math.isfinite(v)):
                        continue
                    k = distortion[c]
                    _, _, dxx, dxy, dyy = distort(u, v, k[0], k[1], k[2], k[3], k[4])
                    fx, fy = focal[c]
                    rows[count, 0], rows[count, 1] = u, v
                    rows[count, 2], rows[count, 3] = fx * dxx, fx * dxy
                    rows[count, 4], rows[count, 5] = fy * dxy, fy * dyy
                    rows[count, 6] = weight
                    solved_poses[count] = poses[c]
                    camera[count] = c
                    seen[t, c, person, joint] = True
                    count += 1
                point, agreed = consensus(
                    rows, solved_poses, noise, count, limit, min_views, weights, squared
                )
                if agreed == 0 or spread(point, solved_poses, weights, count) < min_sine:
                    continue
                matrix, _, squares = normal_equations(
                    point, rows, solved_poses, weights, noise, count
                )
                joints[t, person, joint] = point
                xx, xy, xz, yy, yz, zz = inverse(matrix)
                covariance[t, person, joint, 0] = xx, xy, xz
                covariance[t, person, joint, 1] = xy, yy, yz
                covariance[t, person, joint, 2] = xz, yz, zz
                views[t, person, joint] = agreed
                error[t, person, joint] = math.sqrt(squares / agreed)
                for k in range(count):
                    inliers[t, camera[k], person, joint] = weights[k] > 0.0
