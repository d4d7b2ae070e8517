"""Prints speed and accuracy of joint triangulation, next to peers in the same run.

    python benchmarks/triangulation.py [--frames 500] [--rounds 3]

22 people of 17 joints before 16 cameras; noise of 1.5 px with a heavy spread, 20 % of keypoints
missing, 5 % outliers of 15 to 150 px. All sides start from pixels and use one thread; they take
turns and the best round counts, in processor time, so that other work on the machine matters
little. "aniposelib-style" is that library's published algorithm written here (undistort with
OpenCV, one SVD per point, a loop over points): the library is not needed. It and "EasyMocap-style"
(one SVD call per person) run on a part of the points, and their times are scaled.
"""

from __future__ import annotations

import argparse
import time
from collections.abc import Callable

import cv2
import numpy as np
from common import stadium_rig

from data_contracts.keypoints import KeypointDetections
from worldpose.geometry.cameras import Camera
from worldpose.triangulation.passes import triangulate_joints
from worldpose.triangulation.settings import TriangulationSettings

CAMERAS, PEOPLE, JOINTS = 16, 22, 17
PART = 17 * 60
DEFAULTS = TriangulationSettings()
KERNEL = TriangulationSettings(learn_noise=False, offsets="none", undo_swaps=False)
"""Robust triangulation alone, as the peers compute it: no noise model, clocks or swaps."""


def workload(frames: int) -> tuple[Camera, np.ndarray, np.ndarray, np.ndarray, np.ndarray]:
    """Return cameras, joints (n, 3), pixels (cameras, n, 2), confidence (cameras, n), outliers."""
    rng = np.random.default_rng(0)
    cameras = stadium_rig(CAMERAS, rng, varied_lenses=True)
    seconds = np.arange(frames)[:, None] / 50.0
    start = rng.uniform([-40, -26], [40, 26], (PEOPLE, 2))
    way = start + 2.0 * np.sin(rng.uniform(0.1, 0.5, (PEOPLE, 2)) * seconds[..., None])
    body = rng.uniform([-0.3, -0.3, 0.0], [0.3, 0.3, 1.8], (PEOPLE, JOINTS, 3))
    joints = np.broadcast_to(body, (frames, *body.shape)).copy()
    joints[..., :2] += way[:, :, None]
    points = joints.reshape(-1, 3)
    pixels = cameras.project(points)
    shape = pixels.shape[:2]
    spread = 1.5 * rng.lognormal(0, 0.5, shape)
    sure = np.clip(1.1 - 0.22 * spread / 1.5 + rng.normal(0, 0.08, shape), 0.05, 1.0)
    inside = ((pixels > 0) & (pixels < [1920, 1080])).all(axis=-1) & (rng.random(shape) > 0.2)
    displaced = rng.random(shape) < 0.05
    angle, far = rng.uniform(0, 2 * np.pi, shape), rng.uniform(15, 150, shape)
    pixels += spread[..., None] * rng.normal(size=pixels.shape)
    away = far[..., None] * np.stack([np.cos(angle), np.sin(angle)], axis=-1)
    pixels += np.where(displaced[..., None], away, 0.0)
    return cameras, points, np.nan_to_num(pixels), np.where(inside, sure, 0.0), displaced


def main() -> None:
    """Print one line per method."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--frames", type=int, default=500)
    parser.add_argument("--rounds", type=int, default=3)
    options = parser.parse_args()
    cv2.setNumThreads(1)
    cameras, points, pixels, sure, displaced = workload(options.frames)
    pose = cameras.cam_from_world
    poses = np.concatenate([pose.rotation, pose.translation[..., None]], axis=-1)
    many = len(points)
    shape = (CAMERAS, options.frames, PEOPLE, JOINTS)

    def by_frame(array: np.ndarray) -> np.ndarray:
        return np.ascontiguousarray(array.reshape(*shape, *array.shape[2:]).swapaxes(0, 1))

    keypoints, index = by_frame(pixels), np.arange(PEOPLE, dtype=np.int16)
    index = np.broadcast_to(index, (options.frames, CAMERAS, PEOPLE)).copy()

    def ours(confidence: np.ndarray, settings: TriangulationSettings) -> np.ndarray:
        result = triangulate_joints(
            cameras, KeypointDetections.from_keypoints(keypoints, confidence, index), settings
        )
        return result.joints.reshape(-1, 3)

    def undistort_with(count: int) -> np.ndarray:
        k, focal = cameras.distortion, cameras.focal[:, None]
        start = (pixels[:, :count] - cameras.principal_point[:, None]) / focal
        plane = start
        for _ in range(6):
            square = (plane**2).sum(-1, keepdims=True)
            plane = start / (1 + square * (k[:, None, :1] + square * k[:, None, 1:2]))
        return plane

    def rows(count: int) -> tuple[np.ndarray, np.ndarray]:
        plane, weight = undistort_with(count), sure[:, :count, None]
        a = weight * (plane[..., :1] * poses[:, None, 2] - poses[:, None, 0])
        return a, weight * (plane[..., 1:] * poses[:, None, 2] - poses[:, None, 1])

    def stack(count: int) -> np.ndarray:
        return np.concatenate(rows(count)).transpose(1, 0, 2)

    def from_null(vectors: np.ndarray) -> np.ndarray:
        return np.asarray(vectors[..., :3] / vectors[..., 3:])

    def normal_equations() -> np.ndarray:
        a, b = rows(many)
        matrix = np.empty((many, 4, 4))
        for i in range(4):
            for j in range(i, 4):
                value = (a[..., i] * a[..., j] + b[..., i] * b[..., j]).sum(0)
                matrix[:, i, j] = matrix[:, j, i] = value
        ridge = 1e-12 * np.eye(3)
        return -np.linalg.solve(matrix[:, :3, :3] + ridge, matrix[:, :3, 3:])[..., 0]

    def matmul_normal_equations() -> np.ndarray:
        a = stack(many)
        matrix = a.transpose(0, 2, 1) @ a
        ridge = 1e-12 * np.eye(3)
        return -np.linalg.solve(matrix[:, :3, :3] + ridge, matrix[:, :3, 3:])[..., 0]

    def batch_svd() -> np.ndarray:
        return from_null(np.linalg.svd(stack(many), full_matrices=False)[2][:, -1])

    def easymocap_style() -> np.ndarray:
        a = stack(PART)
        parts = [np.linalg.svd(a[n : n + 17])[2][:, -1] for n in range(0, PART, 17)]
        return from_null(np.concatenate(parts))

    def opencv_pairs() -> np.ndarray:
        plane = undistort_with(many)
        pair = np.sort(np.argsort(-sure, axis=0)[:2], axis=0)
        out = np.empty((many, 3))
        for one, two in {tuple(column) for column in np.unique(pair, axis=1).T}:
            at = (pair[0] == one) & (pair[1] == two)
            views = [np.ascontiguousarray(plane[c, at].T) for c in (one, two)]
            found = cv2.triangulatePoints(poses[one], poses[two], *views)
            out[at] = (found[:3] / found[3]).T
        return out

    def aniposelib_style() -> np.ndarray:
        plane = []
        for c in range(CAMERAS):
            matrix = np.diag([*cameras.focal[c], 1.0])
            matrix[:2, 2] = cameras.principal_point[c]
            given = np.ascontiguousarray(pixels[c, :PART])
            plane.append(cv2.undistortPoints(given, matrix, np.array(cameras.distortion[c])))
        flat = np.stack(plane).reshape(CAMERAS, PART, 2)
        out = np.full((PART, 3), np.nan)
        for n in range(PART):
            good = np.flatnonzero(sure[:, n] > 0.3)
            if len(good) < 2:
                continue
            equations = np.zeros((2 * len(good), 4))
            for k, c in enumerate(good.tolist()):
                x, y = flat[c, n]
                equations[2 * k] = x * poses[c, 2] - poses[c, 0]
                equations[2 * k + 1] = y * poses[c, 2] - poses[c, 1]
            vector = np.linalg.svd(equations, full_matrices=True)[2][-1]
            out[n] = vector[:3] / vector[3]
        return out

    # All sides have pixels and confidence in their own memory order.
    given, inliers = by_frame(sure), by_frame(np.where(displaced, 0.0, sure))
    sides: dict[str, Callable[[], np.ndarray]] = {
        "ours, default settings": lambda: ours(given, DEFAULTS),
        "ours, robust kernel alone": lambda: ours(given, KERNEL),
        "ours, kernel, true inliers given": lambda: ours(inliers, KERNEL),
        "numpy normal equations": normal_equations,
        "numpy normal equations, matmul": matmul_normal_equations,
        "numpy batch SVD": batch_svd,
        "cv2.triangulatePoints, best pair": opencv_pairs,
        "EasyMocap-style batch DLT": easymocap_style,
        "aniposelib-style loop": aniposelib_style,
    }
    best, found = dict.fromkeys(sides, np.inf), {name: side() for name, side in sides.items()}
    for _ in range(options.rounds):
        for name, side in sides.items():
            start = time.process_time()
            side()
            seconds = (time.process_time() - start) * many / len(found[name])
            best[name] = min(best[name], seconds)
    enough = (sure > 0).sum(axis=0) >= 3
    ours_alone = best["ours, default settings"]
    print(f"{many} joints, {CAMERAS} cameras, best of {options.rounds} rounds, one thread")
    for name, joints in found.items():
        counted = enough[: len(joints)]
        error = np.linalg.norm(joints - points[: len(joints)], axis=-1)[counted]
        print(
            f"{name:34s} {best[name]:8.3f} s  {best[name] / ours_alone:7.2f} times ours  "
            f"mean {np.nanmean(error) * 1e3:8.1f} mm  median {np.nanmedian(error) * 1e3:6.1f} mm"
        )


if __name__ == "__main__":
    main()
