"""Speed of projection and undistortion of a camera, next to OpenCV."""

from __future__ import annotations

from argparse import Namespace
from functools import partial
from typing import Any

import cv2
import numpy as np
from common import compare_times
from registry import Table, Tables, benchmark, integer

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


@benchmark(
    "camera_projection",
    "projection and undistortion of a camera, next to OpenCV",
    integer("points", 1_000_000),
    integer("rounds", 5),
)
def compare_projection(options: Namespace) -> Tables:
    """Both sides take the same points with one thread.

    From Python OpenCV's projectPoints always computes its Jacobians. Its undistortPoints stops
    after five iterations by default; "to 1e-12" asks it for more.
    """
    cv2.setNumThreads(1)
    rng = np.random.default_rng(0)
    pixels = np.ascontiguousarray(rng.uniform(0.0, [1919.0, 1079.0], (options.points, 2)))
    rays = CAMERA.unproject(pixels)
    points = rays.origins + rays.directions * rng.uniform(40.0, 120.0, (options.points, 1))
    lens, pose = np.array(CAMERA.coefficients), CAMERA.cam_from_world
    # OpenCV 4 has the form with a stopping rule under its own name.
    iterate: Any = getattr(cv2, "undistortPointsIter", cv2.undistortPoints)
    cv_project = partial(cv2.projectPoints, points, pose.rotvec, pose.translation, MATRIX, lens)
    cv_normalize: Any = partial(cv2.undistortPoints, pixels, MATRIX, lens)
    exactly = partial(iterate, pixels, MATRIX, lens, None, None, None, TO_THE_LAST_BIT)
    tables = {}
    for name, ours, peers in (
        ("project", partial(CAMERA.project, points), {"projectPoints": cv_project}),
        (
            "project_with_jacobians",
            partial(CAMERA.project_with_jacobians, points),
            {"projectPoints": cv_project},
        ),
        (
            "normalize",
            partial(CAMERA.normalize, pixels),
            {"undistortPoints, 5 iterations": cv_normalize, "undistortPoints to 1e-12": exactly},
        ),
        (
            "unproject",
            partial(CAMERA.unproject, pixels),
            {"undistortPoints, 5 iterations": cv_normalize, "undistortPoints to 1e-12": exactly},
        ),
    ):
        title = f"{name}, {options.points} points"
        tables[name] = compare_times(title, {"ours": ours, **peers}, options.rounds)
    sides = {"ours": CAMERA.normalize(pixels), "5 iterations": cv_normalize(), "1e-12": exactly()}
    errors = [[name, round_trip_error(plane, pixels)] for name, plane in sides.items()]
    tables["error"] = Table("largest round trip error", ["undistortion", "error"], errors, "px")
    return tables


def round_trip_error(plane: np.ndarray, pixels: np.ndarray) -> float:
    """Return the largest distance in pixels after distorting `plane` again with OpenCV."""
    rays = np.concatenate([plane.reshape(-1, 2), np.ones((len(pixels), 1))], axis=1)
    distortion = np.array(CAMERA.coefficients)
    back = cv2.projectPoints(rays, np.zeros(3), np.zeros(3), MATRIX, distortion)[0].reshape(-1, 2)
    return float(np.linalg.norm(back - pixels, axis=1).max())
