"""Speed of projection and of static calibration, next to peers."""

from __future__ import annotations

from argparse import Namespace
from collections.abc import Callable, Sequence
from functools import partial
from typing import Any

import cv2
import numpy as np
from common import best_seconds, compare_times, quantile
from cv2.typing import MatLike
from registry import Table, Tables, benchmark, integer

from data_contracts.arrays import Floats, Image, Singles
from worldpose.geometry.cameras import Camera
from worldpose.geometry.rigid import Rigid
from worldpose.pitch.template import PitchTemplate
from worldpose.reference_method.static_calibration import distance_map
from worldpose.simulation.renderer import render_pitch
from worldpose.simulation.scenarios import SCENARIOS
from worldpose.simulation.scene import place_camera
from worldpose.static_calibration.line_refinement import refine_on_lines
from worldpose.static_calibration.parameters import (
    CameraEstimate,
    CameraOnPitch,
    project_with_jacobian,
    step_camera,
)

CAMERA = Camera(
    focal=np.array([3200.0, 3200.0]),
    principal_point=np.array([960.0, 540.0]),
    distortion=np.array([0.25, -0.9, 0.0, 0.0, 0.0]),
    cam_from_world=Rigid.from_rotvec([2.0, 0.1, 0.05], [0.0, 0.0, 70.0]),
    image_size=np.array([1920, 1080]),
)
MATRIX = np.array([[3200.0, 0.0, 960.0], [0.0, 3200.0, 540.0], [0.0, 0.0, 1.0]])
TO_THE_LAST_BIT = (cv2.TERM_CRITERIA_COUNT | cv2.TERM_CRITERIA_EPS, 100, 1e-12)

PITCH = PitchTemplate.standard()

SPREAD = np.array([1e-3, 1e-3, 1e-3, 0.1, 0.1, 0.1, 2e-3, 4.0, 4.0, 0.01, 0.01, 0.0])
"""Proportions of a start's errors, in the order of `PARAMETERS`."""

MOVES = SPREAD > 0.0

START_ERROR = 5.0

FARTHEST = 30.0
"""Upper limit of the distance map [px]."""

ROBUST = 3.0
"""Cauchy scale of the peers' residuals on the map [px]: boards and shadows have edges, too."""


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


@benchmark(
    "static_calibration",
    "refinement of static cameras on painted lines, next to a distance map",
    integer("cameras", 4),
    integer("rounds", 5),
)
def compare_calibrations(options: Namespace) -> Tables:
    """Starts 5 px off in rendered images; the peer minimises the paper's distance map.

    The map (Canny edges near the start's lines) is interpolated between pixels, and minimised by a
    damped Gauss-Newton with a robust loss; making it is a row of its own. Errors are root mean
    squares over the visible markings against the true camera; values are medians over cameras.
    """
    cv2.setNumThreads(1)
    scenario, found = SCENARIOS["match"], dict[str, list[Sequence[float]]]()
    for index in range(options.cameras):
        rng = np.random.default_rng(index)
        true = place_camera(scenario.rig, index, np.zeros(3), scenario.pitch, rng)
        picture = render_pitch(true, PITCH, None, index)
        start, spread = some_pixels_off(true, rng)
        prior = CameraOnPitch.on_known_surface(
            CameraEstimate(start, np.diag(spread**2)), (PITCH.crown, PITCH.end_fall)
        )
        away, points = _make_map(picture, start), line_points(start, 2000)
        sides: dict[str, Callable[[], object]] = {
            "ours, from the picture": partial(_refine, prior, picture),
            "Gauss-Newton, from the map": partial(by_gauss_newton, away, start, points, spread),
            "making the map": partial(_make_map, picture, start),
        }
        cameras = {name: run() for name, run in sides.items()}
        for name, seconds in best_seconds(sides, options.rounds).items():
            camera = cameras[name]
            off = line_error(camera, true) if isinstance(camera, Camera) else np.nan
            found.setdefault(name, []).append((1e3 * seconds, off))
    rows = []
    for name, values in found.items():
        times, errors = np.transpose(values)
        ratio = np.median(times) / np.median(np.array(found["ours, from the picture"])[:, 0])
        rows.append([name, np.median(times), ratio, quantile(errors), quantile(errors, 1.0)])
    columns = ["side", "time [ms]", "times ours", "error [px]", "worst [px]"]
    return {"times": Table(f"{options.cameras} cameras, one thread", columns, rows)}


def _refine(prior: CameraOnPitch, picture: Image) -> Camera:
    return refine_on_lines(prior, PITCH, picture, survey_error=0.0).estimate.camera


def _make_map(picture: Image, start: Camera) -> Singles:
    away = distance_map(picture, start, line_points(start, 6000))
    return np.minimum(away, np.float32(FARTHEST))


def line_points(camera: Camera, count: int) -> Floats:
    """Return evenly chosen points of the markings in a camera's image (count, 3)."""
    points = PITCH.sample_lines(0.1).points_world
    pixels = camera.project(points)
    points = points[((pixels > 3.0) & (pixels < camera.image_size - 4.0)).all(axis=-1)]
    chosen: Floats = points[np.linspace(0, len(points) - 1, count).astype(int)]
    return chosen


def line_error(camera: Camera, true: Camera) -> float:
    """Return the root mean square error over the markings [px]."""
    points = line_points(true, 2000)
    off = camera.project(points) - true.project(points)
    return float(np.sqrt((off**2).sum(axis=-1).mean()))


def some_pixels_off(true: Camera, rng: np.random.Generator) -> tuple[Camera, Floats]:
    """Return a camera with marking errors of 5 px, and the spread that it was drawn with.

    All methods have that spread as their prior.
    """
    drawn, size = rng.standard_normal(12), 1.0
    for _ in range(4):
        size *= START_ERROR / line_error(step_camera(true, size * SPREAD * drawn), true)
    return step_camera(true, size * SPREAD * drawn), size * SPREAD


def looked_up(away: MatLike, pixels: Floats) -> Floats:
    """Return the map interpolated at pixels (n,)."""
    # Not as one map and an empty second one: OpenCV 5 then reads arbitrary values.
    x, y = np.ascontiguousarray(pixels.T, dtype=np.float32)[:, None]
    mapped = cv2.remap(away, x, y, cv2.INTER_LINEAR, borderMode=cv2.BORDER_REPLICATE)
    return np.asarray(mapped[0], float)


def by_gauss_newton(away: Singles, start: Camera, points: Floats, spread: Floats) -> Camera:
    """Return a damped Gauss-Newton result on the map, with its gradient and our Jacobian."""
    gx = cv2.Sobel(away / 8.0, cv2.CV_32F, 1, 0, ksize=3)
    gy = cv2.Sobel(away / 8.0, cv2.CV_32F, 0, 1, ksize=3)
    prior = 9.0 / spread[MOVES] ** 2
    best, cost, damping = np.zeros(int(MOVES.sum())), np.inf, 1e-2
    trial, camera = best, start
    normal, right = np.diag(prior), best
    for _ in range(15):
        step = np.zeros(12)
        step[MOVES] = trial
        moved = step_camera(start, step)
        pixels, jacobian = project_with_jacobian(moved, points)
        value = looked_up(away, pixels)
        new = float(ROBUST**2 * np.log1p((value / ROBUST) ** 2).sum() + (prior * trial**2).sum())
        if new < cost:
            best, cost, camera, damping = trial, new, moved, damping / 4.0
            slope = np.stack([looked_up(gx, pixels), looked_up(gy, pixels)], axis=-1)
            rows = np.einsum("ni,nij->nj", slope, jacobian)[:, MOVES]
            weighted = rows / (1.0 + (value / ROBUST) ** 2)[:, None]
            normal = weighted.T @ rows + np.diag(prior)
            right = weighted.T @ value + prior * best
        else:
            damping *= 8.0
        trial = best - np.linalg.solve(normal + damping * np.diag(np.diag(normal)), right)
    return camera
