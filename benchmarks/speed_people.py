"""Speed of triangulation, tracking and body fitting next to peers, in the same run, one thread."""

from __future__ import annotations

import time
from argparse import Namespace
from collections.abc import Callable
from contextlib import suppress
from functools import partial
from typing import Any, NamedTuple

import cv2
import numpy as np
import torch
from common import compare_times, quantile, simulate
from registry import Table, Tables, benchmark, integer
from scipy.optimize import linear_sum_assignment

from data_contracts.arrays import Floats, Integers
from data_contracts.conventions import COCO17
from data_contracts.keypoints import KeypointDetections
from worldpose.body.body_file import load_open_body
from worldpose.body.differentiable import DifferentiableBody
from worldpose.body.keypoints import FoldedKeypoints, fold_keypoints
from worldpose.body.model import BodyParameters
from worldpose.body_fitting.estimate import fit_bodies
from worldpose.body_fitting.pose_space import SPREAD, load_pose_prior, start_poses
from worldpose.body_fitting.results import ClipEvidence
from worldpose.body_fitting.settings import BodyFittingSettings
from worldpose.geometry.cameras import Camera
from worldpose.tracking.ray_matching import match_greedily, match_optimally, ray_affinity
from worldpose.tracking.settings import TrackingSettings
from worldpose.tracking.tracker import track_people
from worldpose.triangulation.estimate import triangulate_joints
from worldpose.triangulation.settings import TriangulationSettings

FPS = 50.0
TRACKING = TrackingSettings()
GATE = TRACKING.gate_m


class Workload(NamedTuple):
    """People before the cameras of `match`.

    cameras (cameras,), joints (frames, people, 17, 3) [m], detections (frames, cameras,
    detections), their persons, -1 for none, and bodies (frames, people).
    """

    cameras: Camera
    joints: Floats
    seen: KeypointDetections
    owner: Integers
    bodies: BodyParameters


def draw_match(frames: int) -> Workload:
    """Return 25 people before 16 cameras, with the simulated detector's errors."""
    cv2.setNumThreads(1)
    torch.set_num_threads(1)
    _, scene = simulate("match", 4, frames / FPS)
    views, poses = scene.static_views(), scene.poses
    names = ("betas", "global_orient", "body_pose", "transl")
    bodies = BodyParameters(*(np.swapaxes(getattr(poses, name), 0, 1) for name in names))
    cameras = Camera.stack(list(scene.cameras.values()))
    owner = np.asarray(views.person, np.int64)
    return Workload(cameras, scene.truth.joints, views.detections, owner, bodies)


def lens_matrix(camera: Camera) -> Floats:
    """Return K (3, 3) of one camera."""
    matrix = np.diag([*camera.focal, 1.0])
    matrix[:2, 2] = camera.principal_point
    return matrix


@benchmark(
    "triangulation",
    "triangulation of joints, next to a linear solver and an aniposelib-style loop",
    integer("frames", 200),
    integer("rounds", 3),
)
def compare_triangulations(options: Namespace) -> Tables:
    """25 simulated people of 17 joints before 16 cameras, with the simulated detector's errors.

    All sides start from pixels; the peers' are undistorted by OpenCV. "aniposelib-style" is that
    library's published algorithm (one SVD per point, a loop over points); it runs on a part of the
    points, and its time is scaled. The robust kernel alone has no noise model, clocks or swaps.
    """
    work = draw_match(options.frames)
    frame, camera, detection = np.nonzero(work.owner >= 0)
    place = (frame, camera, work.owner[frame, camera, detection])
    pixels = np.zeros((*work.owner.shape[:2], *work.joints.shape[1:3], 2))
    sure = np.zeros(pixels.shape[:-1])
    pixels[place] = np.nan_to_num(work.seen.keypoints[frame, camera, detection])
    sure[place] = np.nan_to_num(work.seen.confidence[frame, camera, detection])
    index = np.broadcast_to(np.arange(sure.shape[2], dtype=np.int16), sure.shape[:3]).copy()
    seen = KeypointDetections.from_keypoints(pixels, sure, index)
    points, views = work.joints.reshape(-1, 3), len(work.cameras.focal)
    flat = np.ascontiguousarray(pixels.swapaxes(0, 1).reshape(views, -1, 2))
    weight = sure.swapaxes(0, 1).reshape(views, -1)

    def ours(settings: TriangulationSettings) -> Floats:
        return triangulate_joints(work.cameras, seen, settings).joints.reshape(-1, 3)

    kernel = TriangulationSettings(learn_noise=False, offsets="none", undo_swaps=False)
    sides: dict[str, Callable[[], Floats]] = {
        "ours, default settings": partial(ours, TriangulationSettings()),
        "ours, robust kernel alone": partial(ours, kernel),
        "numpy normal equations": partial(by_normal_equations, work.cameras, flat, weight),
        "aniposelib-style loop": partial(by_single_points, work.cameras, flat, weight),
    }
    found, enough = {name: side() for name, side in sides.items()}, (weight > 0).sum(axis=0) >= 3

    def errors(name: str) -> tuple[float, float]:
        count = len(found[name])
        off = np.linalg.norm(found[name] - points[:count], axis=-1)[enough[:count]]
        return float(1e3 * np.nanmean(off)), 1e3 * quantile(off)

    title = f"{len(points)} joints, {views} cameras, one thread"
    columns = ("mean [mm]", "median [mm]")
    scale = {name: len(points) / len(joints) for name, joints in found.items()}
    table = compare_times(title, sides, options.rounds, *columns, more=errors, scale=scale)
    return {"times": table}


def linear_equations(cameras: Camera, pixels: Floats) -> Floats:
    """Return the rows (points, 2 cameras, 4) of the direct linear transformation."""
    rows: tuple[list[Floats], list[Floats]] = ([], [])
    for c, own in enumerate(pixels):
        lens = lens_matrix(cameras[c]), np.array(cameras[c].coefficients)
        plane, pose = cv2.undistortPoints(own, *lens)[:, 0], cameras[c].cam_from_world
        matrix = np.column_stack([pose.rotation, pose.translation])
        for axis in (0, 1):
            rows[axis].append(plane[:, axis, None] * matrix[2] - matrix[axis])
    return np.stack(rows[0] + rows[1], axis=1)


def by_normal_equations(cameras: Camera, pixels: Floats, weight: Floats) -> Floats:
    """Return all points from weighted equations, of pixels (cameras, points, 2)."""
    rows = linear_equations(cameras, pixels) * np.tile(weight, (2, 1)).T[..., None]
    matrix = rows.swapaxes(1, 2) @ rows
    found = np.linalg.solve(matrix[:, :3, :3] + 1e-12 * np.eye(3), matrix[:, :3, 3:])
    return np.asarray(-found[..., 0])


def by_single_points(cameras: Camera, pixels: Floats, weight: Floats) -> Floats:
    """Return some of the points, one decomposition each, of pixels (cameras, points, 2)."""
    out = np.full((17 * 60, 3), np.nan)
    for n, rows in enumerate(linear_equations(cameras, pixels[:, : len(out)])):
        good = np.tile(weight[:, n] > 0.3, 2)
        if good.sum() >= 4:
            vector = np.linalg.svd(rows[good], full_matrices=True)[2][-1]
            out[n] = vector[:3] / vector[3]
    return out


@benchmark(
    "tracking",
    "association of detections with people, next to numpy and SciPy",
    integer("frames", 100),
    integer("rounds", 5),
)
def compare_tracking(options: Namespace) -> Tables:
    """25 simulated people before 16 cameras, with the simulated detector's errors.

    Association takes the true poses of the previous frame, so that all sides solve the same
    problem.
    """
    work = draw_match(options.frames + 1)
    cameras, joints, seen, owner = work.cameras, work.joints, work.seen[1:], work.owner[1:]
    few, many = range(min(10, options.frames)), joints.shape[1]
    image = seen.keypoints.astype(np.float64)
    directions = cameras.unproject(image.reshape(*image.shape[:2], -1, 2)).directions
    rays = directions.reshape(*image.shape[:-1], 3)
    weights = np.where(np.isfinite(rays[..., 0]), 1.0, 0.0)
    centers = np.ascontiguousarray(cameras.center)
    gates = np.full((len(centers), many), GATE)

    def ours(t: int) -> Floats:
        return ray_affinity(joints[t], centers, rays[t], weights[t], gates, TRACKING.min_joints)

    methods: dict[str, Callable[[int], Integers]] = {
        "ours": lambda t: match_optimally(ours(t), -GATE),
        "ours, greedy": lambda t: match_greedily(ours(t)),
        "numpy and SciPy": lambda t: match_by_scipy(joints[t], centers, rays[t]),
    }
    sides = {name: partial(lambda run: [*map(run, few)], run) for name, run in methods.items()}

    def errors(name: str) -> tuple[float, float]:
        index = np.stack(sides[name]())
        true = np.take_along_axis(owner[: len(index)], np.maximum(index, 0), axis=2)
        right = ((true == np.arange(many)) & (index >= 0)).sum()
        return float(right / (owner[: len(index)] >= 0).sum()), float(right / (index >= 0).sum())

    title = f"{len(few)} frames of {many} people and {len(centers)} cameras, one thread"
    begin = time.perf_counter()
    result = track_people(cameras, seen, FPS, TRACKING, pitch_size=(105.0, 68.0))
    rate = options.frames / (time.perf_counter() - begin)
    stage = [["ours", rate, len(result.person), result.report.undecided]]
    table = compare_times(title, sides, options.rounds, "recall", "precision", more=errors)
    names = ["side", "frames/s", "people", "undecided joins"]
    return {"association": table, "stage": Table("whole stage", names, stage)}


def match_by_scipy(joints: Floats, centers: Floats, rays: Floats) -> Integers:
    """Return each person's detection (cameras, people) by mean distances of joints to rays."""
    offset = joints[None] - centers[:, None, None]
    along = np.einsum("cijx,cdjx->cidj", offset, rays, optimize=True)
    away = np.sqrt(np.maximum((offset**2).sum(-1)[:, :, None] - along**2, 0.0))
    known = np.isfinite(away)
    mean = np.where(known, away, 0.0).sum(-1) / np.maximum(known.sum(-1), 1)
    costs = np.where(known.any(-1) & (mean <= GATE), mean, 1e3)
    index = np.full(costs.shape[:2], -1)
    for own, cost in zip(index, costs, strict=True):
        row, column = linear_sum_assignment(cost)
        good = cost[row, column] <= GATE
        own[row[good]] = column[good]
    return index


@benchmark(
    "body_fitting",
    "fitting of bodies to joints, next to torch's LBFGS",
    integer("frames", 100),
    integer("compare", 500, "poses of LBFGS"),
)
def compare_fits(options: Namespace) -> Tables:
    """25 simulated people; joints are their keypoints with 20 mm of noise.

    Ours has its whole objective: shape, shared offsets, motion, priors. LBFGS, in single precision
    on the same keypoints in torch, has a simpler one: squared distances and 1e-4 of squared angles,
    betas known, from limbs along their joints. It ends at the cost of the true bodies, or after 300
    iterations. Times are scaled to all poses; OMP_NUM_THREADS=1 gives all sides one thread.
    """
    model, truth = load_open_body(), draw_match(options.frames).bodies
    keypoints, settings = fold_keypoints(model, COCO17), BodyFittingSettings()
    exact, noise = keypoints(truth), 0.02
    joints = exact + noise * np.random.default_rng(4).standard_normal(exact.shape)
    covariance = np.broadcast_to(noise**2 * np.eye(3), (*joints.shape, 3))
    true, wanted = exact.reshape(-1, 17, 3), joints.reshape(-1, 17, 3)
    rows: list[list[Any]] = []

    def clock(label: str, work: Callable[[], Floats]) -> None:
        begin, busy = time.perf_counter(), time.process_time()
        found = work()
        share = len(true) / len(found)
        wall, busy = time.perf_counter() - begin, time.process_time() - busy
        off = 1e3 * np.linalg.norm(found - true[: len(found)], axis=-1).mean()
        ratio = share * busy / rows[0][2] if rows else 1.0
        rows.append([label, share * wall, share * busy, ratio, off])

    def fit(part: Any = ...) -> Floats:
        evidence = ClipEvidence(joints[part], covariance[part], FPS)
        return fit_bodies(model, evidence, settings).joints.reshape(-1, 17, 3)

    def search(count: int, iterations: int) -> Floats:
        return by_lbfgs(keypoints, truth.flat()[:count], wanted[:count], iterations)

    fit((slice(8), slice(1)))  # not timed: what compiles and loads
    search(2, 2)
    clock("fit_bodies", fit)
    clock("LBFGS", partial(search, min(options.compare, len(true)), 300))
    columns = ["side", "time [s]", "CPU [s]", "times ours", "error [mm]"]
    return {"times": Table(f"{len(true)} poses", columns, rows)}


def by_lbfgs(
    keypoints: FoldedKeypoints, truth: BodyParameters, wanted: Floats, iterations: int
) -> Floats:
    """Return the keypoints (poses, 17, 3) of LBFGS, which ends at the cost of the true bodies."""
    at, model = np.zeros((len(wanted), 75)), keypoints.model
    for person in np.unique(truth.betas, axis=0):
        own = (truth.betas == person).all(-1)
        place, orient, angles = start_poses(model, person, wanted[own], load_pose_prior())
        at[own] = np.concatenate([place, orient, angles @ SPREAD.T], axis=-1)
    start = torch.tensor(at).float().requires_grad_()
    goal, betas = torch.tensor(wanted).float(), torch.tensor(truth.betas).float()
    least = ((keypoints(truth) - wanted) ** 2).sum() + 1e-4 * (truth.body_pose**2).sum()
    solver = torch.optim.LBFGS([start], max_iter=iterations, line_search_fn="strong_wolfe")
    body, found = DifferentiableBody(keypoints, torch.float32).keypoints, goal

    def loss() -> torch.Tensor:
        nonlocal found
        solver.zero_grad()
        found = body(betas, start[:, 3:6], start[:, 6:], start[:, :3])
        value = ((found - goal) ** 2).sum() + 1e-4 * (start[:, 6:] ** 2).sum()
        if value <= least:
            raise StopIteration
        value.backward()
        return value

    with suppress(StopIteration):
        solver.step(loss)
    return found.detach().numpy()
