"""Speed of projection, calibration and adjustment next to peers, in the same run, one thread."""

from __future__ import annotations

import importlib.util
import time
from argparse import Namespace
from collections.abc import Callable, Sequence
from dataclasses import replace
from functools import partial
from typing import Any

import cv2
import numpy as np
from common import best_seconds, compare_times, quantile, tell
from numpy.typing import NDArray
from registry import Table, Tables, benchmark, integer, option
from scipy.optimize import least_squares
from speed_people import draw_match, lens_matrix

from data_contracts.arrays import Floats, Image
from worldpose.bundle_adjustment.residuals import AdjustmentProblem
from worldpose.bundle_adjustment.settings import SolverSettings
from worldpose.bundle_adjustment.solver import solve
from worldpose.geometry.cameras import Camera
from worldpose.geometry.rigid import Rigid
from worldpose.pitch.template import PitchTemplate
from worldpose.reference_method.static_calibration import distance_map
from worldpose.simulation.renderer import render_pitch
from worldpose.simulation.scenarios import SCENARIOS
from worldpose.simulation.scene import place_camera
from worldpose.static_calibration.line_refinement import refine_on_lines
from worldpose.static_calibration.parameters import (
    PARAMETERS,
    CameraEstimate,
    CameraOnPitch,
    project_with_jacobian,
    step_camera,
)

PITCH = PitchTemplate.standard()


@benchmark(
    "camera_projection",
    "projection and undistortion of a camera, next to OpenCV",
    integer("points", 1_000_000),
    integer("rounds", 5),
)
def compare_projection(options: Namespace) -> Tables:
    """Both sides take the same points.

    From Python OpenCV's projectPoints always computes its Jacobians. Its undistortPoints stops
    after five iterations by default; "to 1e-12" asks it for more.
    """
    cv2.setNumThreads(1)
    camera = Camera(
        focal=np.array([3200.0, 3200.0]),
        principal_point=np.array([960.0, 540.0]),
        distortion=np.array([0.25, -0.9, 0.0, 0.0, 0.0]),
        cam_from_world=Rigid.from_rotvec([2.0, 0.1, 0.05], [0.0, 0.0, 70.0]),
        image_size=np.array([1920, 1080]),
    )
    rng = np.random.default_rng(0)
    pixels = np.ascontiguousarray(rng.uniform(0.0, [1919.0, 1079.0], (options.points, 2)))
    rays = camera.unproject(pixels)
    points = rays.origins + rays.directions * rng.uniform(40.0, 120.0, (options.points, 1))
    pose, lens = camera.cam_from_world, (lens_matrix(camera), np.array(camera.coefficients))
    # OpenCV 4 has the form with a stopping rule under its own name.
    iterate: Any = getattr(cv2, "undistortPointsIter", cv2.undistortPoints)
    rule = (cv2.TERM_CRITERIA_COUNT | cv2.TERM_CRITERIA_EPS, 100, 1e-12)
    project = partial(cv2.projectPoints, points, pose.rotvec, pose.translation, *lens)
    undistorting: dict[str, Any] = {
        "undistortPoints, 5 iterations": partial(cv2.undistortPoints, pixels, *lens),
        "undistortPoints to 1e-12": partial(iterate, pixels, *lens, None, None, None, rule),
    }
    tables = {}
    for name, given, peers in (
        ("project", points, {"projectPoints": project}),
        ("project_with_jacobians", points, {"projectPoints": project}),
        ("normalize", pixels, undistorting),
        ("unproject", pixels, undistorting),
    ):
        sides = {"ours": partial(getattr(camera, name), given), **peers}
        title = f"{name}, {options.points} points"
        tables[name] = compare_times(title, sides, options.rounds)
    errors = []
    for name, run in {"ours": partial(camera.normalize, pixels), **undistorting}.items():
        plane = np.concatenate([run().reshape(-1, 2), np.ones((len(pixels), 1))], axis=1)
        back = cv2.projectPoints(plane, np.zeros(3), np.zeros(3), *lens)[0].reshape(-1, 2)
        errors.append([name, float(np.linalg.norm(back - pixels, axis=1).max())])
    tables["error"] = Table("largest round trip error", ["undistortion", "error"], errors, "px")
    return tables


@benchmark(
    "static_calibration",
    "refinement of static cameras on painted lines, next to a distance map",
    integer("cameras", 4),
    integer("rounds", 5),
)
def compare_calibrations(options: Namespace) -> Tables:
    """Starts 5 px off in rendered images; the peer minimises the paper's distance map.

    The map (Canny edges near the start's lines) is interpolated between pixels, and minimised by
    SciPy's least squares with a robust loss and our Jacobian; making it is a row of its own. Errors
    are root mean squares over the visible markings against the true camera; values are medians over
    cameras.
    """
    cv2.setNumThreads(1)
    scenario, found = SCENARIOS["match"], dict[str, list[Sequence[float]]]()
    for index in range(options.cameras):
        rng = np.random.default_rng(index)
        true = place_camera(scenario.rig, index, np.zeros(3), scenario.pitch, rng)
        picture = render_pitch(true, PITCH, None, index)
        # Errors in the order of `PARAMETERS`, so that the markings are 5 px off.
        spread = np.array([1e-3] * 3 + [0.1] * 3 + [2e-3, 4.0, 4.0, 0.01, 0.01, 0.0])
        drawn = rng.standard_normal(len(spread))
        for _ in range(4):
            spread *= 5.0 / line_error(step_camera(true, spread * drawn), true)
        start = step_camera(true, spread * drawn)
        prior = CameraOnPitch.on_known_surface(
            CameraEstimate(start, np.diag(spread**2)), (PITCH.crown, PITCH.end_fall)
        )
        away = distance_map(picture, start, line_points(start, 6000))
        sides: dict[str, Callable[[], object]] = {
            "ours, from the picture": partial(refine_on_picture, prior, picture),
            "SciPy's least squares, from the map": partial(refine_on_map, away, start, spread),
            "making the map": partial(distance_map, picture, start, line_points(start, 6000)),
        }
        cameras = {name: run() for name, run in sides.items()}
        for name, seconds in best_seconds(sides, options.rounds).items():
            camera = cameras[name]
            off = line_error(camera, true) if isinstance(camera, Camera) else np.nan
            found.setdefault(name, []).append((1e3 * seconds, off))
    rows: list[list[Any]] = []
    for name, values in found.items():
        times, errors = np.transpose(values)
        ratio = np.median(times) / rows[0][1] if rows else 1.0
        rows.append([name, np.median(times), ratio, quantile(errors), quantile(errors, 1.0)])
    columns = ["side", "time [ms]", "times ours", "error [px]", "worst [px]"]
    return {"times": Table(f"{options.cameras} cameras, one thread", columns, rows)}


def line_points(camera: Camera, count: int) -> Floats:
    """Return evenly chosen points of the markings in a camera's image (count, 3)."""
    points = PITCH.sample_lines(0.1).points_world
    pixels = camera.project(points)
    points = points[((pixels > 3.0) & (pixels < camera.image_size - 4.0)).all(axis=-1)]
    return np.asarray(points[np.linspace(0, len(points) - 1, count).astype(int)])


def line_error(camera: Camera, true: Camera) -> float:
    """Return the root mean square error over the markings [px]."""
    points = line_points(true, 2000)
    off = camera.project(points) - true.project(points)
    return float(np.sqrt((off**2).sum(axis=-1).mean()))


def refine_on_picture(prior: CameraOnPitch, picture: Image) -> Camera:
    """Return our refinement on the markings."""
    return refine_on_lines(prior, PITCH, picture, survey_error=0.0).estimate.camera


def refine_on_map(away: NDArray[np.float32], start: Camera, spread: Floats) -> Camera:
    """Return the camera with the least robust distances of markings to edges, and to the prior."""
    away = np.minimum(away, np.float32(30.0))
    slopes = [cv2.Sobel(away / 8.0, cv2.CV_32F, *way, ksize=3) for way in ((1, 0), (0, 1))]
    points, moves = line_points(start, 2000), spread > 0.0

    def moved(values: Floats) -> Camera:
        step = np.zeros(len(spread))
        step[moves] = values
        return step_camera(start, step)

    def look_up(values: Floats) -> tuple[Floats, Floats]:
        pixels, jacobian = project_with_jacobian(moved(values), points)
        # Not as one map and an empty second one: OpenCV 5 then reads arbitrary values.
        x, y = np.ascontiguousarray(pixels.T, dtype=np.float32)[:, None]
        off, *slope = (
            cv2.remap(each, x, y, cv2.INTER_LINEAR, borderMode=cv2.BORDER_REPLICATE)[0]
            for each in (away, *slopes)
        )
        rows = np.einsum("nk,nkj->nj", np.stack(slope, -1), jacobian)[:, moves]
        prior = np.diag(3.0 / spread[moves])  # as if a distance to an edge had an error of 3 px
        return np.concatenate([off, prior @ values]), np.concatenate([rows, prior])

    solved = least_squares(
        lambda values: look_up(values)[0],
        np.zeros(moves.sum()),
        jac=lambda values: look_up(values)[1],
        x_scale=spread[moves],
        loss="cauchy",  # boards and shadows have edges, too
        f_scale=3.0,
    )
    return moved(solved.x)


@benchmark(
    "bundle_adjustment",
    "bundle adjustment, next to pycolmap",
    option("--large", action="store_true", help="300 frames of 22 players"),
    integer("rounds", 3),
)
def compare_adjusters(options: Namespace) -> Tables:
    """16 simulated cameras, 40 frames of 6 players, and the surveyed points of the pitch.

    Free are pose, focal length, principal point, k1 and k2 of every camera and all joints. All
    sides start from the same cameras, with errors of 1 % of focal length, 3 mrad and 0.2 m, weigh
    all observations alike, and stop where a step gains less than 1e-8 of the cost. Preparation,
    such as COLMAP's reconstruction, is not timed. Costs are sums of squared residuals [px^2].
    """
    problem = make_problem(*((300, 22) if options.large else (40, 6)))
    solve(make_problem(4, 2, 3))  # compiles
    sides: dict[str, Callable[[AdjustmentProblem], Callable[[], float]]] = {"ours": adjust}
    if importlib.util.find_spec("pycolmap"):
        sides["pycolmap"] = adjust_by_colmap
    else:
        tell("pycolmap is not installed: pip install pycolmap")
    best, found = dict.fromkeys(sides, np.inf), {}
    for _ in range(options.rounds):
        for name, prepare in sides.items():
            run = prepare(problem)
            started = time.perf_counter()
            found[name] = run()
            best[name] = min(best[name], time.perf_counter() - started)
    least = min(found.values())
    rows = [
        [name, each, each / best["ours"], found[name] / least - 1] for name, each in best.items()
    ]
    title = f"{len(problem.free)} cameras, {len(problem.points)} points, {len(problem.image)} "
    columns = ["side", "time [s]", "times ours", "cost above the least"]
    return {"times": Table(title + "observations", columns, rows)}


def make_problem(frames: int, players: int, cameras: int = 16) -> AdjustmentProblem:
    """Return the common problem of all sides."""
    rng, work = np.random.default_rng(5), draw_match(frames)
    true = work.cameras[:cameras]
    # The peers' lens has k1 and k2 alone.
    true = replace(true, distortion=true.distortion * [1.0, 1.0, *np.zeros(6)])
    surveyed = PITCH.positions(list(PITCH.points))
    points = np.concatenate([surveyed, work.joints[:, :players].reshape(-1, 3)])
    pixels = true.project(points)
    seen = ((pixels > 0.0) & (pixels < true.image_size[:, None])).all(axis=-1).T
    seen &= rng.random(seen.shape) < 0.8
    # A single view has no depth.
    kept = (seen.sum(axis=1) >= 2) | (np.arange(len(points)) < len(surveyed))
    points, seen, pixels = points[kept], seen[kept], pixels[:, kept]
    point_of, camera_of = np.nonzero(seen)
    image = pixels[camera_of, point_of] + 1.8 * rng.standard_normal((len(point_of), 2))
    step = np.array([3e-3] * 3 + [0.2] * 3 + [0.01] + [0.0] * 5)
    base = step_camera(true, step * rng.standard_normal((cameras, len(step))))
    base = replace(
        base,
        principal_point=np.asarray(0.5 * (true.image_size - 1.0), np.float64),
        distortion=np.zeros((cameras, 5)),
    )
    fixed = np.arange(len(points)) < len(surveyed)
    off = points + 0.2 * rng.standard_normal(points.shape)
    return AdjustmentProblem(
        cameras=base,
        free=np.tile(np.arange(len(PARAMETERS)) < len(PARAMETERS) - 1, (cameras, 1)),
        camera_information=np.zeros((cameras, len(PARAMETERS), len(PARAMETERS))),
        points=np.where(fixed[:, None], points, off),
        point_information=np.where(fixed, np.inf, 0.0),
        point_of=point_of,
        camera_of=camera_of,
        image=image,
        weight=np.ones(len(image)),
        scale=np.full(len(image), np.inf),
    )


def adjust(problem: AdjustmentProblem) -> Callable[[], float]:
    """Return the solver of this package; it returns the cost."""

    def run() -> float:
        solved = solve(problem, SolverSettings(min_cost_change=1e-8), covariance=False)
        cameras, points = solved.cameras[problem.camera_of], solved.points[problem.point_of]
        return float(((cameras.project(points[:, None])[:, 0] - problem.image) ** 2).sum())

    return run


def adjust_by_colmap(problem: AdjustmentProblem) -> Callable[[], float]:
    """Return COLMAP's adjuster on the same cameras and points; it returns the cost."""
    import pycolmap

    pycolmap.logging.minloglevel = 2
    scene, cameras = pycolmap.Reconstruction(), problem.cameras
    place = np.empty(len(problem.image), dtype=np.int64)
    options = pycolmap.BundleAdjustmentOptions()
    options.refine_principal_point, options.print_summary = True, False
    options.ceres.solver_options.function_tolerance = 1e-8
    options.ceres.solver_options.num_threads = 1
    config = pycolmap.BundleAdjustmentConfig()
    for c, camera in enumerate(cameras[n] for n in range(len(cameras.focal))):
        lens = [camera.focal[0], *camera.principal_point, *camera.distortion[:2]]
        size = dict(zip(("width", "height"), camera.image_size.tolist(), strict=True))
        given = pycolmap.Camera(camera_id=c + 1, model="RADIAL", **size, params=lens)
        scene.add_camera_with_trivial_rig(given)
        rows = np.flatnonzero(problem.camera_of == c)
        place[rows] = np.arange(len(rows))
        image = {"keypoints": problem.image[rows], "camera_id": c + 1, "image_id": c + 1}
        pose = camera.cam_from_world
        scene.add_image_with_trivial_frame(
            pycolmap.Image(name=str(c), **image),
            pycolmap.Rigid3d(pycolmap.Rotation3d(pose.rotation), pose.translation),
        )
        config.add_image(c + 1)
    first_of = np.searchsorted(problem.point_of, np.arange(len(problem.points) + 1))
    for p in np.unique(problem.point_of):
        track = pycolmap.Track()
        for o in range(first_of[p], first_of[p + 1]):
            track.add_element(int(problem.camera_of[o]) + 1, int(place[o]))
        number = scene.add_point3D(problem.points[p], track)
        if np.isinf(problem.point_information[p]):
            config.add_constant_point(number)
    adjuster = pycolmap.create_default_bundle_adjuster(options, config, scene)

    def run(scene: object = scene) -> float:  # which the adjuster refers to
        return 2.0 * float(adjuster.solve().ceres_summary.final_cost)

    return run
