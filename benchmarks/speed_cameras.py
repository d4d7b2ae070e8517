"""Speed of calibration, adjustment and the moving camera's solver, next to peers."""

from __future__ import annotations

import importlib.util
import resource
import time
from argparse import Namespace
from collections.abc import Callable, Sequence
from dataclasses import replace
from functools import partial
from typing import Any

import cv2
import numpy as np
from common import best_seconds, quantile, tell
from cv2.typing import MatLike
from numpy.typing import NDArray
from registry import Table, Tables, benchmark, integer, option
from speed_people import draw_match

from data_contracts.arrays import Floats, Image
from worldpose.broadcast_calibration.clip_problem import ClipProblem
from worldpose.broadcast_calibration.evidence import (
    PLAYER,
    FlowEvidence,
    PointEvidence,
    whiten_points,
)
from worldpose.broadcast_calibration.moving_camera import FRAME_SIZE, MovingCamera
from worldpose.broadcast_calibration.priors import build_prior, lens_walk
from worldpose.broadcast_calibration.residuals import linearize
from worldpose.broadcast_calibration.settings import BroadcastPrior
from worldpose.broadcast_calibration.solver import solve as solve_clip
from worldpose.bundle_adjustment.residuals import AdjustmentProblem
from worldpose.bundle_adjustment.settings import SolverSettings
from worldpose.bundle_adjustment.solver import solve
from worldpose.geometry.cameras import Camera
from worldpose.geometry.rigid import Rigid
from worldpose.pitch.template import PitchTemplate
from worldpose.reference_method.broadcast_calibration import refine as refine_by_adam
from worldpose.reference_method.static_calibration import distance_map
from worldpose.simulation.renderer import render_pitch
from worldpose.simulation.scenarios import SCENARIOS
from worldpose.simulation.scene import place_camera, simulate_scene
from worldpose.static_calibration.line_refinement import refine_on_lines
from worldpose.static_calibration.parameters import (
    PARAMETERS,
    CameraEstimate,
    CameraOnPitch,
    project_with_jacobian,
    step_camera,
)

PITCH = PitchTemplate.standard()

SPREAD = np.array([1e-3, 1e-3, 1e-3, 0.1, 0.1, 0.1, 2e-3, 4.0, 4.0, 0.01, 0.01, 0.0])
"""Proportions of a start's errors, in the order of `PARAMETERS`."""

MOVES = SPREAD > 0.0

START_ERROR = 5.0

FARTHEST = 30.0
"""Upper limit of the distance map [px]."""

ROBUST = 3.0
"""Cauchy scale of the peers' residuals on the map [px]: boards and shadows have edges, too."""

Solution = tuple[Camera, np.ndarray]
Run = Callable[[], Solution]


FREE = len(PARAMETERS) - 1
"""All but k3, which the peers' lens does not have."""

SMOOTH = np.array([np.inf, np.inf, np.inf, 1e-4])

NOISE, OUTLIERS, LOSS = 2.0, 0.08, 4.0


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


def _make_map(picture: Image, start: Camera) -> NDArray[np.float32]:
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


def by_gauss_newton(
    away: NDArray[np.float32], start: Camera, points: Floats, spread: Floats
) -> Camera:
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
    such as COLMAP's reconstruction, is not timed. Costs are computed for all sides by one function.
    """
    problem = make_problem(*((300, 22) if options.large else (40, 6)))
    solve(make_problem(4, 2, 3))  # compiles
    sides: dict[str, Callable[[AdjustmentProblem], Run]] = {"ours": ours}
    if importlib.util.find_spec("pycolmap"):
        sides["pycolmap"] = pycolmap_side
    else:
        tell("pycolmap is not installed: pip install pycolmap")
    best, found = dict.fromkeys(sides, np.inf), {}
    for done in range(options.rounds):
        for name, prepare in sides.items():
            run = prepare(problem)
            started = time.perf_counter()
            found[name] = run()
            best[name] = min(best[name], time.perf_counter() - started)
            if name == "ours" and not done:
                memory = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1024
    least = min(cost(problem, solution) for solution in found.values())
    rows = [
        [name, seconds, seconds / best["ours"], cost(problem, found[name]) / least - 1.0]
        for name, seconds in best.items()
    ]
    title = f"{len(problem.free)} cameras, {len(problem.points)} points, {len(problem.image)} "
    columns = ["side", "time [s]", "times ours", "cost above the least"]
    return {
        "times": Table(title + "observations", columns, rows),
        "memory": Table("peak after ours alone", ["process", "memory"], [["ours", memory]], "MB"),
    }


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
    free = np.ones((cameras, len(PARAMETERS)), dtype=bool)
    free[:, FREE:] = False
    fixed = np.arange(len(points)) < len(surveyed)
    off = points + 0.2 * rng.standard_normal(points.shape)
    return AdjustmentProblem(
        cameras=base,
        free=free,
        camera_information=np.zeros((cameras, len(PARAMETERS), len(PARAMETERS))),
        points=np.where(fixed[:, None], points, off),
        point_information=np.where(fixed, np.inf, 0.0),
        point_of=point_of,
        camera_of=camera_of,
        image=image,
        weight=np.ones(len(image)),
        scale=np.full(len(image), np.inf),
    )


def cost(problem: AdjustmentProblem, solution: Solution) -> float:
    """Return the sum of squared residuals of a solution [px^2]."""
    cameras, points = solution
    total = 0.0
    for c in range(len(cameras.focal)):
        rows = problem.camera_of == c
        total += (
            (cameras[c].project(points[problem.point_of[rows]]) - problem.image[rows]) ** 2
        ).sum()
    return float(total)


def ours(problem: AdjustmentProblem) -> Run:
    """Return the solver of this package."""

    def run() -> Solution:
        solved = solve(problem, SolverSettings(min_cost_change=1e-8), covariance=False)
        return solved.cameras, solved.points

    return run


def pycolmap_side(problem: AdjustmentProblem) -> Run:
    """Return COLMAP's bundle adjuster on a reconstruction of the same cameras and points."""
    import pycolmap

    pycolmap.logging.minloglevel = 2
    scene = pycolmap.Reconstruction()
    cameras, count = problem.cameras, len(problem.cameras.focal)
    place = np.empty(len(problem.image), dtype=np.int64)
    for c in range(count):
        lens = [cameras.focal[c, 0], *cameras.principal_point[c], *cameras.distortion[c, :2]]
        width, height = cameras.image_size[c].tolist()
        scene.add_camera_with_trivial_rig(
            pycolmap.Camera(
                camera_id=c + 1, model="RADIAL", width=width, height=height, params=lens
            )
        )
        rows = np.flatnonzero(problem.camera_of == c)
        place[rows] = np.arange(len(rows))
        image = pycolmap.Image(
            name=str(c), keypoints=problem.image[rows], camera_id=c + 1, image_id=c + 1
        )
        pose = cameras.cam_from_world
        scene.add_image_with_trivial_frame(
            image, pycolmap.Rigid3d(pycolmap.Rotation3d(pose.rotation[c]), pose.translation[c])
        )
    ids = {}
    first_of = np.searchsorted(problem.point_of, np.arange(len(problem.points) + 1))
    for p in range(len(problem.points)):
        track = pycolmap.Track()
        for o in range(first_of[p], first_of[p + 1]):
            track.add_element(int(problem.camera_of[o]) + 1, int(place[o]))
        if first_of[p + 1] > first_of[p]:
            ids[p] = scene.add_point3D(problem.points[p], track)
    options = pycolmap.BundleAdjustmentOptions()
    options.refine_principal_point = True
    options.print_summary = False
    options.ceres.solver_options.function_tolerance = 1e-8
    options.ceres.solver_options.num_threads = 1
    config = pycolmap.BundleAdjustmentConfig()
    for c in range(count):
        config.add_image(c + 1)
    for p in np.flatnonzero(np.isinf(problem.point_information)).tolist():
        if p in ids:
            config.add_constant_point(int(ids[p]))
    adjuster = pycolmap.create_default_bundle_adjuster(options, config, scene)

    def run() -> Solution:
        adjuster.solve()
        return _solution_of(problem, scene, ids)

    return run


def _solution_of(problem: AdjustmentProblem, scene: Any, ids: dict[int, int]) -> Solution:
    """Return cameras and points of a COLMAP reconstruction."""
    cameras, count = problem.cameras, len(problem.cameras.focal)
    points = problem.points.copy()
    for p, point_id in ids.items():
        points[p] = scene.points3D[point_id].xyz
    lenses = np.array([scene.cameras[c + 1].params for c in range(count)])
    found = [scene.images[c + 1].cam_from_world() for c in range(count)]
    solved = replace(
        cameras,
        focal=np.repeat(lenses[:, :1], 2, axis=1),
        principal_point=lenses[:, 1:3],
        distortion=np.concatenate([lenses[:, 3:], np.zeros((count, 3))], axis=1),
        cam_from_world=Rigid(
            np.stack([pose.rotation.matrix() for pose in found]),
            np.stack([pose.translation for pose in found]),
        ),
    )
    return solved, points


@benchmark(
    "broadcast_calibration",
    "the moving camera's solver, next to the paper's Adam on E_player",
    integer("frames", 1500),
    integer("adam", 2000, "iterations of Adam"),
)
def compare_solvers(options: Namespace) -> Tables:
    """Joints of people before the camera of `broadcast-pan`, 2 px of noise and 8 % of outliers.

    The start has errors of about 20 px. Ours minimizes Geman-McClure losses, smoothness and priors;
    Adam, at the paper's rate of 1e-3, minimizes E_player alone with derivatives by torch. The cost
    is ours for both.
    """
    rng = np.random.default_rng(7)
    true, points = draw_clip(options.frames, rng)
    start = start_of(true, rng)
    prior = build_prior(BroadcastPrior(), start.focal, start.image_size)
    walk = lens_walk(start.focal)
    problem = ClipProblem(points, FlowEvidence.none(), prior, smoothness=SMOOTH, lens_walk=walk)
    few = replace(problem, points=points[points.frame < 5], lens_walk=walk[:4])
    few = replace(few, prior=build_prior(BroadcastPrior(), start.focal[:5], start.image_size))
    solve_clip(start.frames(slice(0, 5)), few, 2)  # compiles
    first = linearize(start, np.zeros((0, 4)), problem).cost
    rows: list[list[Any]] = [["start", None, None, None, first, *figures(start, true, points)]]
    begin = time.perf_counter()
    mine = solve_clip(start, problem, 60)
    own = time.perf_counter() - begin
    shown = figures(mine.camera, true, points)
    rows.append(["ours", len(mine.costs) - 1, own, 1.0, mine.cost, *shown])
    begin = time.perf_counter()
    none = np.empty((0, 3)), np.empty((0, 2)), np.empty(0, dtype=np.int64)
    seen = points.world, points.image, points.frame
    adam = MovingCamera.from_batch(refine_by_adam(start.camera, none, seen, options.adam))
    slow = time.perf_counter() - begin
    cost = linearize(adam, np.zeros((0, 4)), problem).cost
    shown = figures(adam, true, points)
    rows.append(["Adam, 1e-3", options.adam, slow, slow / own, cost, *shown])
    columns = ["side", "iterations", "time [s]", "times ours", "cost"]
    columns += ["rms [px]", "focal length [%]", "centre [cm]"]
    title = f"{options.frames} frames, {len(points)} observations, one thread"
    return {"times": Table(title, columns, rows)}


def draw_clip(frames: int, rng: np.random.Generator) -> tuple[MovingCamera, PointEvidence]:
    """Return the camera of a simulated clip, and noisy pixels of people in every frame."""
    scenario = SCENARIOS["broadcast-pan"].model_copy(update={"duration": frames / 50.0})
    scene = simulate_scene(scenario, 7)
    (camera,) = (view.camera for view in scene.broadcast.values())
    image = camera.project(world := scene.truth.joints.reshape(frames, -1, 3))
    image = image + NOISE * rng.standard_normal(image.shape)
    wrong = rng.random(image.shape[:2]) < OUTLIERS
    image[wrong] += 60.0 * rng.standard_normal((int(wrong.sum()), 2))
    moving = MovingCamera.of(camera, camera.center[0], camera.principal_point[0])
    inside = ((image > 0.0) & (image < moving.image_size - 1.0)).all(axis=-1)
    frame, _ = np.nonzero(inside)
    source = np.zeros(len(frame), dtype=np.int64)
    return moving, PointEvidence.observe(
        PLAYER,
        frame,
        world[inside],
        image[inside],
        whiten_points(np.full(len(frame), NOISE)),
        source=source,
        loss=LOSS,
    )


def start_of(true: MovingCamera, rng: np.random.Generator) -> MovingCamera:
    """Return a camera with errors of some 20 px, independent per frame."""
    frames = len(true)
    step = np.zeros((frames, FRAME_SIZE))
    step[:, :3] = 0.0015 * rng.standard_normal((frames, 3))
    wave = 0.01 * np.sin(0.04 * np.arange(frames))
    step[:, 3] = wave + 0.002 * rng.standard_normal(frames)
    step[:, 4] = -0.1
    return true.take_step(step, [0.4, -0.5, 0.3, 4.0, 4.0])


def figures(
    camera: MovingCamera, true: MovingCamera, points: PointEvidence
) -> tuple[float, float, float]:
    """Return the rms error [px], and errors of focal length [%] and centre [cm]."""
    pixels = []
    for frame in range(0, len(camera), max(1, len(camera) // 50)):
        mine = points.world[points.frame == frame]
        one, two = camera.frames(slice(frame, frame + 1)), true.frames(slice(frame, frame + 1))
        pixels.append(one.camera[0].project(mine) - two.camera[0].project(mine))
    rms = np.sqrt((np.concatenate(pixels) ** 2).sum(axis=-1).mean())
    focal = 100.0 * np.median(np.abs(camera.focal / true.focal - 1.0))
    center = 100.0 * np.linalg.norm(camera.center - true.center)
    return float(rms), float(focal), float(center)
