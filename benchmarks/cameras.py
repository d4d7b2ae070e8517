"""Prints the speed of projection and unprojection, as ratios to OpenCV in the same run.

    python benchmarks/cameras.py [--points 1000000] [--rounds 5]

Both sides take turns on the same points in one process with one thread; the best round of each
counts, so that a busy machine slows both alike. From Python OpenCV's `projectPoints` always
computes its Jacobians. Its `undistortPoints` stops after five iterations by default; the lines "to
1e-12" ask it for more, and the last lines print each accuracy.
"""

from __future__ import annotations

import argparse
from functools import partial
from typing import Any

import cv2
import numpy as np
from common import best_seconds

from worldpose.geometry.cameras import Camera
from worldpose.geometry.rigid import Rigid

CAMERA = Camera(
    focal=np.array([3200.0, 3200.0]),
    principal_point=np.array([960.0, 540.0]),
    distortion=np.array([0.25, -0.9, 0.0, 0.0, 0.0]),
    cam_from_world=Rigid.from_rotvec([2.0, 0.1, 0.05], [0.0, 0.0, 70.0]),
    image_size=np.array([1920, 1080]),
)
MATRIX = np.array([[3200.0, 0.0, 960.0], [0.0, 3200.0, 540.0], [0.0, 0.0, 1.0]])
TO_THE_LAST_BIT = (cv2.TERM_CRITERIA_COUNT | cv2.TERM_CRITERIA_EPS, 100, 1e-12)


def main() -> None:
    """Print one line per operation."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--points", type=int, default=1_000_000)
    parser.add_argument("--rounds", type=int, default=5)
    options = parser.parse_args()
    cv2.setNumThreads(1)

    rng = np.random.default_rng(0)
    pixels = rng.uniform([0.0, 0.0], [1919.0, 1079.0], (options.points, 2))
    rays = CAMERA.unproject(pixels)
    points = rays.origins + rays.directions * rng.uniform(40.0, 120.0, (options.points, 1))
    rotvec = CAMERA.cam_from_world.rotvec
    translation = CAMERA.cam_from_world.translation
    distortion = np.array(CAMERA.distortion)
    # OpenCV takes contiguous arrays; the copies are made before the clock starts.
    points, pixels = np.ascontiguousarray(points), np.ascontiguousarray(pixels)

    # OpenCV 4 has the form with a stopping rule under its own name.
    iterate = getattr(cv2, "undistortPointsIter", cv2.undistortPoints)

    def cv_project() -> Any:
        return cv2.projectPoints(points, rotvec, translation, MATRIX, distortion)

    def cv_normalize() -> Any:
        return cv2.undistortPoints(pixels, MATRIX, distortion)

    def cv_normalize_exactly() -> Any:
        return iterate(pixels, MATRIX, distortion, None, None, None, TO_THE_LAST_BIT)

    print(f"{options.points} points, best of {options.rounds} rounds, one thread")
    for name, ours, peer_name, peer in (
        ("project", CAMERA.project, "projectPoints, with jacobians", cv_project),
        ("project_with_jacobians", CAMERA.project_with_jacobians, "projectPoints", cv_project),
        ("normalize", CAMERA.normalize, "undistortPoints, 5 iterations", cv_normalize),
        ("normalize", CAMERA.normalize, "undistortPoints to 1e-12", cv_normalize_exactly),
        ("unproject", CAMERA.unproject, "undistortPoints, 5 iterations", cv_normalize),
        ("unproject", CAMERA.unproject, "undistortPoints to 1e-12", cv_normalize_exactly),
    ):
        given = points if name.startswith("project") else pixels
        best = best_seconds({"ours": partial(ours, given), "peer": peer}, options.rounds)
        rates = {side: options.points / seconds / 1e6 for side, seconds in best.items()}
        print(
            f"{name:22s} {rates['ours']:6.1f} M/s   {peer_name:30s} {rates['peer']:6.1f} M/s   "
            f"{best['peer'] / best['ours']:6.2f} times as fast"
        )
    for name, plane in (
        ("normalize", CAMERA.normalize(pixels)),
        ("undistortPoints, 5 iterations", cv_normalize()),
        ("undistortPoints to 1e-12", cv_normalize_exactly()),
    ):
        print(f"{name:30s} largest round trip error {round_trip_error(plane, pixels):.1e} px")


def round_trip_error(plane: np.ndarray, pixels: np.ndarray) -> float:
    """Return the largest distance in pixels after distorting `plane` again with OpenCV."""
    rays = np.concatenate([plane.reshape(-1, 2), np.ones((len(pixels), 1))], axis=1)
    distortion = np.array(CAMERA.distortion)
    back = cv2.projectPoints(rays, np.zeros(3), np.zeros(3), MATRIX, distortion)[0].reshape(-1, 2)
    return float(np.linalg.norm(back - pixels, axis=1).max())


if __name__ == "__main__":
    main()
