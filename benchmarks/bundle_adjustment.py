"""Prints the time of bundle adjustment, as ratios to peers in the same run.

    python benchmarks/bundle_adjustment.py [--large] [--rounds 3] [--peers pycolmap scipy]

10 cameras, 40 frames of 6 players and 60 surveyed points; with --large 18 cameras and 300 frames of
22 players. Free are pose, focal length, principal point, k1 and k2 of every camera and all joints;
the surveyed points fix the world. All sides start from the same cameras, with errors of 1 % of
focal length, 3 mrad and 0.2 m, and stop where a step gains less than 1e-8 of the cost (scipy: 1e-6,
which favours it; not with --large, where it does not end). All sides take turns, one thread each;
the best round counts. Preparation, such as COLMAP's reconstruction, is not timed; no side computes
a covariance.

pycolmap adjusts with Ceres and weighs all observations alike, so weights are one and no loss is
robust here. The scipy side is typical user code: residuals in numpy, the sparsity of the
Jacobian, finite differences. Costs are computed for all sides by one function at the end.
"""

from __future__ import annotations

import argparse
import importlib.util
import resource
import sys
import time
from collections.abc import Callable
from dataclasses import replace
from typing import Any

import numpy as np
from scipy.optimize import least_squares
from scipy.sparse import csr_matrix

from worldpose.bundle_adjustment.settings import SolverSettings
from worldpose.bundle_adjustment.solver import Problem, solve
from worldpose.geometry.cameras import Camera
from worldpose.geometry.rigid import Rigid
from worldpose.simulation.scene import look_at
from worldpose.static_calibration.parameters import PARAMETERS, step_camera

Solution = tuple[Camera, np.ndarray]
Run = Callable[[], Solution]

SIZE = (1920, 1080)
FREE = len(PARAMETERS) - 1
"""All but k3, which the peers' lens does not have."""


def make_problem(cameras: int, frames: int, players: int) -> Problem:
    """Return the common problem of all sides."""
    rng = np.random.default_rng(5)
    angles = 2.0 * np.pi * (np.arange(cameras) + 0.5) / cameras
    centers = np.stack([80.0 * np.cos(angles), 62.0 * np.sin(angles), np.full(cameras, 18.0)], 1)
    poses = [look_at(center, np.array([0.0, 0.0, 1.0]), 0.0) for center in centers]
    true = Camera(
        focal=np.repeat(rng.uniform(1300.0, 1700.0, (cameras, 1)), 2, axis=1),
        principal_point=np.array([959.5, 539.5]) + rng.normal(0.0, 8.0, (cameras, 2)),
        distortion=np.array([[-0.08, 0.02, 0.0, 0.0, 0.0]] * cameras),
        cam_from_world=Rigid(
            np.stack([pose.rotation for pose in poses]),
            np.stack([pose.translation for pose in poses]),
        ),
        image_size=np.tile(SIZE, (cameras, 1)),
    )
    surveyed = rng.uniform([-52.0, -34.0, -0.1], [52.0, 34.0, 0.1], (60, 3))
    start = rng.uniform([-35.0, -25.0, 0.0], [35.0, 25.0, 0.0], (players, 3))
    way = rng.uniform([-4.0, -4.0, 0.0], [4.0, 4.0, 0.0], (players, 3))
    body = rng.uniform([-0.4, -0.4, 0.1], [0.4, 0.4, 1.8], (players, 17, 3))
    times = np.linspace(0.0, 4.0, frames)[:, None, None]
    joints = ((start + times * way)[:, :, None] + body).reshape(-1, 3)
    points = np.concatenate([surveyed, joints])
    pixels = true.project(points)
    seen = ((pixels > 0.0) & (pixels < np.array(SIZE))).all(axis=-1).T
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
        principal_point=np.tile([959.5, 539.5], (cameras, 1)),
        distortion=np.zeros((cameras, 5)),
    )
    free = np.ones((cameras, len(PARAMETERS)), dtype=bool)
    free[:, FREE:] = False
    fixed = np.arange(len(points)) < len(surveyed)
    crossings = nearest_points(base, point_of, camera_of, image, len(points))
    return Problem(
        cameras=base,
        free=free,
        camera_information=np.zeros((cameras, len(PARAMETERS), len(PARAMETERS))),
        points=np.where(fixed[:, None], points, crossings),
        point_information=np.where(fixed, np.inf, 0.0),
        point_of=point_of,
        camera_of=camera_of,
        image=image,
        weight=np.ones(len(image)),
        scale=np.full(len(image), np.inf),
    )


def nearest_points(
    cameras: Camera, point_of: np.ndarray, camera_of: np.ndarray, image: np.ndarray, count: int
) -> np.ndarray:
    """Return the points (count, 3) nearest to all rays of their observations."""
    matrix, right = 1e-9 * np.tile(np.eye(3), (count, 1, 1)), np.zeros((count, 3))
    for c in range(len(cameras.focal)):
        rows = camera_of == c
        rays = cameras[c].unproject(image[rows])
        direction = rays.directions / np.linalg.norm(rays.directions, axis=1, keepdims=True)
        across = np.eye(3) - direction[:, :, None] * direction[:, None]
        matrix[point_of[rows]] += across
        right[point_of[rows]] += across @ cameras[c].center
    return np.linalg.solve(matrix, right[..., None])[..., 0]


def cost(problem: Problem, solution: Solution) -> float:
    """Return the sum of squared residuals of a solution [px^2]."""
    cameras, points = solution
    total = 0.0
    for c in range(len(cameras.focal)):
        rows = problem.camera_of == c
        total += (
            (cameras[c].project(points[problem.point_of[rows]]) - problem.image[rows]) ** 2
        ).sum()
    return float(total)


def ours(problem: Problem) -> Run:
    """Return the solver of this package."""

    def run() -> Solution:
        solved = solve(problem, SolverSettings(min_cost_change=1e-8), covariance=False)
        return solved.cameras, solved.points

    return run


def pycolmap_side(problem: Problem) -> Run:
    """Return COLMAP's bundle adjuster on a reconstruction of the same cameras and points."""
    import pycolmap

    pycolmap.logging.minloglevel = 2
    scene = pycolmap.Reconstruction()
    cameras, count = problem.cameras, len(problem.cameras.focal)
    place = np.empty(len(problem.image), dtype=np.int64)
    for c in range(count):
        lens = [cameras.focal[c, 0], *cameras.principal_point[c], *cameras.distortion[c, :2]]
        width, height = SIZE
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
            image,
            pycolmap.Rigid3d(pycolmap.Rotation3d(pose.rotation[c]), pose.translation[c]),
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


def _solution_of(problem: Problem, scene: Any, ids: dict[int, int]) -> Solution:
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


def scipy_side(problem: Problem) -> Run:
    """Return scipy's trust region with a sparsity pattern and finite differences."""
    free = np.flatnonzero(problem.point_information == 0.0)
    column = np.full(len(problem.points), -1)
    column[free] = np.arange(len(free))
    count, observations = len(problem.free), len(problem.image)
    order = np.argsort(problem.camera_of, kind="stable")
    bounds = np.searchsorted(problem.camera_of[order], np.arange(count + 1))

    def solution_of(numbers: np.ndarray) -> Solution:
        step = np.zeros((count, len(PARAMETERS)))
        step[:, :FREE] = numbers[: count * FREE].reshape(count, FREE)
        points = problem.points.copy()
        points[free] = numbers[count * FREE :].reshape(-1, 3)
        return step_camera(problem.cameras, step), points

    def residuals(numbers: np.ndarray) -> np.ndarray:
        cameras, points = solution_of(numbers)
        off = np.empty((observations, 2))
        for c in range(count):
            rows = order[bounds[c] : bounds[c + 1]]
            off[rows] = cameras[c].project(points[problem.point_of[rows]]) - problem.image[rows]
        return off.ravel()

    row = np.arange(2 * observations)
    camera_columns = FREE * np.repeat(problem.camera_of, 2)[:, None] + np.arange(FREE)
    own = np.repeat(column[problem.point_of], 2)
    point_columns = count * FREE + 3 * own[own >= 0][:, None] + np.arange(3)
    rows = np.concatenate([np.repeat(row, FREE), np.repeat(row[own >= 0], 3)])
    columns = np.concatenate([camera_columns.ravel(), point_columns.ravel()])
    shape = (2 * observations, count * FREE + 3 * len(free))
    pattern = csr_matrix((np.ones(len(rows), np.int8), (rows, columns)), shape=shape)
    start = np.concatenate([np.zeros(count * FREE), problem.points[free].ravel()])

    def run() -> Solution:
        limits = {"ftol": 1e-6, "max_nfev": 60}
        found = least_squares(
            residuals, start, jac_sparsity=pattern, method="trf", x_scale="jac", **limits
        )
        return solution_of(found.x)

    return run


def main() -> None:
    """Print one line per side."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--large", action="store_true", help="18 cameras, 22 players, 300 frames")
    parser.add_argument("--rounds", type=int, default=3)
    parser.add_argument("--peers", nargs="*", default=["pycolmap", "scipy"])
    options = parser.parse_args()
    problem = make_problem(*((18, 300, 22) if options.large else (10, 40, 6)))
    sides: dict[str, Callable[[Problem], Run]] = {"ours": ours}
    if "pycolmap" in options.peers:
        if importlib.util.find_spec("pycolmap"):
            sides["pycolmap"] = pycolmap_side
        else:
            print("pycolmap is not installed: pip install pycolmap", file=sys.stderr)
    if "scipy" in options.peers and not options.large:
        sides["scipy, 2-point"] = scipy_side
    print(
        f"{len(problem.free)} cameras, {len(problem.points)} points, {len(problem.image)} "
        f"observations, best of {options.rounds} rounds"
    )
    solve(make_problem(3, 4, 2))  # compiles
    best, found = dict.fromkeys(sides, np.inf), {}
    for done in range(options.rounds):
        for name, prepare in sides.items():
            if done and name.startswith("scipy"):
                continue
            run = prepare(problem)
            started = time.perf_counter()
            found[name] = run()
            best[name] = min(best[name], time.perf_counter() - started)
            if name == "ours" and not done:
                memory = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1024
        print(f"\r  round {done + 1} of {options.rounds}", end="", file=sys.stderr, flush=True)
    print("\r" + " " * 30, end="\r", file=sys.stderr, flush=True)
    least = min(cost(problem, solution) for solution in found.values())
    for name, seconds in best.items():
        ratio = best["ours"] / seconds
        beyond = cost(problem, found[name]) / least - 1.0
        print(
            f"{name:16s} {seconds:8.2f} s   ours takes {ratio:5.2f} of it   "
            f"cost {beyond:.1e} above the least"
        )
    print(f"peak memory of this process after ours alone: {memory:.0f} MB")


if __name__ == "__main__":
    main()
