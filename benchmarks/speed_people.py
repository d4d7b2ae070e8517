"""Speed of triangulation, tracking and body fitting, next to peers."""

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
from worldpose.body.jacobian import ChainedKeypoints
from worldpose.body.keypoints import fold_keypoints
from worldpose.body.model import BodyModel, BodyParameters
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

KERNEL = TriangulationSettings(learn_noise=False, offsets="none", undo_swaps=False)
"""Robust triangulation alone, as the peers compute it: no noise model, clocks or swaps."""

PART = 17 * 60
"""Points of slow peers."""
SETTINGS = TrackingSettings()
FPS, GATE = 50.0, SETTINGS.gate_m
JOINT_NOISE = 0.02

WEIGHT = 1e-4
"""Weight of squared angles [m^2/rad^2]."""

MAX_STEPS = 300
"""Steps of Gauss-Newton and iterations of LBFGS."""

LEAST_GAIN = 1e-3
"""Share of the cost that a step of Gauss-Newton has to gain."""

NEAR = 1.01
"""Cost at which LBFGS ends, in costs of Gauss-Newton."""


class Workload(NamedTuple):
    """People before the cameras of `match`, as speed is measured on.

    cameras (cameras,), joints (frames, people, 17, 3) [m], detections (frames, cameras,
    detections), their persons, -1 for none, and bodies (frames, people).
    """

    cameras: Camera
    joints: Floats
    seen: KeypointDetections
    owner: Integers
    bodies: BodyParameters


def draw_match(frames: int) -> Workload:
    """Return the workload of all benchmarks of speed: 25 people before 16 cameras."""
    _, scene = simulate("match", 4, frames / FPS)
    views, poses = scene.static_views(), scene.poses
    names = ("betas", "global_orient", "body_pose", "transl")
    bodies = BodyParameters(*(np.swapaxes(getattr(poses, name), 0, 1) for name in names))
    cameras = Camera.stack(list(scene.cameras.values()))
    owner = np.asarray(views.person, np.int64)
    return Workload(cameras, scene.truth.joints, views.detections, owner, bodies)


def draw_joints(frames: int) -> tuple[Camera, Floats, Floats, Floats]:
    """Return cameras, joints (n, 3), pixels (cameras, n, 2) and confidence (cameras, n)."""
    work = draw_match(frames)
    frame, camera, detection = np.nonzero(work.owner >= 0)
    chosen = (camera, frame, work.owner[frame, camera, detection])
    pixels = np.zeros((work.owner.shape[1], *work.joints.shape[:2], 17, 2))
    sure = np.zeros(pixels.shape[:-1])
    pixels[chosen] = np.nan_to_num(work.seen.keypoints[frame, camera, detection])
    sure[chosen] = np.nan_to_num(work.seen.confidence[frame, camera, detection])
    number = len(pixels)
    points = work.joints.reshape(-1, 3)
    return work.cameras, points, pixels.reshape(number, -1, 2), sure.reshape(number, -1)


@benchmark(
    "triangulation",
    "triangulation of joints, next to linear solvers and an aniposelib-style loop",
    integer("frames", 200),
    integer("rounds", 3),
)
def compare_triangulations(options: Namespace) -> Tables:
    """25 simulated people of 17 joints before 16 cameras, with the simulated detector's errors.

    All sides start from pixels, with one thread. "aniposelib-style" is that library's published
    algorithm (undistort with OpenCV, one SVD per point, a loop over points); it runs on a part of
    the points, and its time is scaled.
    """
    cv2.setNumThreads(1)
    cameras, points, pixels, sure = draw_joints(options.frames)
    pose, many = cameras.cam_from_world, len(points)
    poses = np.concatenate([pose.rotation, pose.translation[..., None]], axis=-1)
    shape = (len(cameras.focal), len(points) // (25 * 17), 25, 17)

    def by_frame(array: np.ndarray) -> np.ndarray:
        return np.ascontiguousarray(array.reshape(*shape, *array.shape[2:]).swapaxes(0, 1))

    index = np.broadcast_to(np.arange(25, dtype=np.int16), (shape[1], shape[0], 25)).copy()
    seen = KeypointDetections.from_keypoints(by_frame(pixels), by_frame(sure), index)

    def ours(settings: TriangulationSettings) -> np.ndarray:
        return triangulate_joints(cameras, seen, settings).joints.reshape(-1, 3)

    def undistort() -> np.ndarray:
        k, focal = cameras.distortion, cameras.focal[:, None]
        start = (pixels - cameras.principal_point[:, None]) / focal
        plane = start
        for _ in range(6):
            square = (plane**2).sum(-1, keepdims=True)
            plane = start / (1 + square * (k[:, None, :1] + square * k[:, None, 1:2]))
        return plane

    def stack() -> np.ndarray:
        plane, weight = undistort(), sure[..., None]
        a = weight * (plane[..., :1] * poses[:, None, 2] - poses[:, None, 0])
        b = weight * (plane[..., 1:] * poses[:, None, 2] - poses[:, None, 1])
        return np.concatenate([a, b]).transpose(1, 0, 2)

    def normal_equations() -> np.ndarray:
        a = stack()
        matrix = a.transpose(0, 2, 1) @ a
        ridge = 1e-12 * np.eye(3)
        return -np.linalg.solve(matrix[:, :3, :3] + ridge, matrix[:, :3, 3:])[..., 0]

    def opencv_pairs() -> np.ndarray:
        plane, out = undistort(), np.empty((many, 3))
        pair = np.sort(np.argsort(-sure, axis=0)[:2], axis=0)
        for one, two in {tuple(column) for column in np.unique(pair, axis=1).T}:
            at = (pair[0] == one) & (pair[1] == two)
            views = [np.ascontiguousarray(plane[c, at].T) for c in (one, two)]
            found = cv2.triangulatePoints(poses[one], poses[two], *views)
            out[at] = (found[:3] / found[3]).T
        return out

    def aniposelib_style() -> np.ndarray:
        flat, out = np.empty((shape[0], PART, 2)), np.full((PART, 3), np.nan)
        for c in range(shape[0]):
            matrix = np.diag([*cameras.focal[c], 1.0])
            matrix[:2, 2] = cameras.principal_point[c]
            given, lens = np.ascontiguousarray(pixels[c, :PART]), np.array(cameras.distortion[c])
            flat[c] = cv2.undistortPoints(given, matrix, lens)[:, 0]
        for n in range(PART):
            good = np.flatnonzero(sure[:, n] > 0.3)
            if len(good) < 2:
                continue
            x, y = flat[good, n].T[..., None]
            rows = [x * poses[good, 2] - poses[good, 0], y * poses[good, 2] - poses[good, 1]]
            vector = np.linalg.svd(np.concatenate(rows), full_matrices=True)[2][-1]
            out[n] = vector[:3] / vector[3]
        return out

    sides: dict[str, Callable[[], np.ndarray]] = {
        "ours, default settings": partial(ours, TriangulationSettings()),
        "ours, robust kernel alone": partial(ours, KERNEL),
        "numpy normal equations": normal_equations,
        "cv2.triangulatePoints, best pair": opencv_pairs,
        "aniposelib-style loop": aniposelib_style,
    }
    found, enough = {name: side() for name, side in sides.items()}, (sure > 0).sum(axis=0) >= 3

    def errors(name: str) -> tuple[float, float]:
        joints = found[name]
        off = np.linalg.norm(joints - points[: len(joints)], axis=-1)[enough[: len(joints)]]
        return float(1e3 * np.nanmean(off)), 1e3 * quantile(off)

    title, columns = f"{many} joints, {shape[0]} cameras, one thread", ("mean [mm]", "median [mm]")
    scale = {name: many / len(joints) for name, joints in found.items()}
    table = compare_times(title, sides, options.rounds, *columns, more=errors, scale=scale)
    return {"times": table}


@benchmark(
    "tracking",
    "association of detections with people, next to numpy and SciPy",
    integer("frames", 100),
    integer("rounds", 5),
)
def compare_tracking(options: Namespace) -> Tables:
    """25 simulated people before 16 cameras, with the simulated detector's errors.

    Association takes the true poses of the previous frame, so that all sides solve the same
    problem, with one thread.
    """
    work = draw_match(options.frames + 1)
    cameras, joints, seen, owner = work.cameras, work.joints, work.seen[1:], work.owner[1:]
    few, many = range(min(10, options.frames)), joints.shape[1]
    rays = rays_of(cameras, seen)
    weights = np.where(np.isfinite(rays[..., 0]), 1.0, 0.0)
    centers = np.ascontiguousarray(cameras.center)
    gates = np.full((len(centers), many), GATE)

    def ours(t: int) -> np.ndarray:
        return ray_affinity(joints[t], centers, rays[t], weights[t], gates, SETTINGS.min_joints)

    methods: dict[str, Callable[[int], np.ndarray]] = {
        "ours": lambda t: match_optimally(ours(t), -GATE),
        "ours, greedy": lambda t: match_greedily(ours(t)),
        "numpy and SciPy": lambda t: hungarian(numpy_affinity(joints[t], centers, rays[t])),
    }

    def errors(name: str) -> tuple[float, float]:
        return figures(run_frames(methods[name], len(few)), owner)

    sides = {name: partial(run_frames, run, len(few)) for name, run in methods.items()}
    title = f"{len(few)} frames of {many} people and {len(centers)} cameras, one thread"
    begin = time.perf_counter()
    result = track_people(cameras, seen, FPS, SETTINGS, pitch_size=(105.0, 68.0))
    rate = options.frames / (time.perf_counter() - begin)
    stage = [["ours", rate, len(result.person), result.report.undecided]]
    columns = ("recall", "precision")
    table = compare_times(title, sides, options.rounds, *columns, more=errors)
    names = ["side", "frames/s", "people", "undecided joins"]
    return {"association": table, "stage": Table("whole stage", names, stage)}


def rays_of(cameras: Camera, seen: KeypointDetections) -> Floats:
    """Return the directions (frames, cameras, detections, 17, 3) of all keypoints."""
    frames, number = seen.keypoints.shape[:2]
    image = seen.keypoints.astype(np.float64).reshape(frames, number, -1, 2)
    return cameras.unproject(image).directions.reshape(*seen.keypoints.shape[:-1], 3)


def numpy_affinity(joints: np.ndarray, centers: np.ndarray, rays: np.ndarray) -> np.ndarray:
    """Return minus mean point-to-ray distances (cameras, people, detections) in a few lines."""
    offset = joints[None] - centers[:, None, None]
    along = np.einsum("cijx,cdjx->cidj", offset, rays, optimize=True)
    squared = (offset**2).sum(-1)[:, :, None] - along**2
    known = np.isfinite(squared)
    total = np.sqrt(np.where(known, np.maximum(squared, 0.0), 0.0)).sum(-1)
    return np.where(known.any(-1), -total / np.maximum(known.sum(-1), 1), -np.inf)


def hungarian(affinity: np.ndarray) -> np.ndarray:
    """Return each person's detection by scipy's assignment."""
    index = np.full(affinity.shape[:2], -1)
    for c, gains in enumerate(affinity):
        row, column = linear_sum_assignment(np.where(gains < -GATE, 1e3, -gains))
        good = gains[row, column] >= -GATE
        index[c, row[good]] = column[good]
    return index


def run_frames(run: Callable[[int], Any], count: int) -> list[Any]:
    """Return the results of a method in the first frames."""
    return [run(t) for t in range(count)]


def figures(matches: list[np.ndarray], owner: np.ndarray) -> tuple[float, float]:
    """Return recall and precision of matches [(cameras, people)] of the first frames."""
    index = np.stack(matches)
    true = np.take_along_axis(owner[: len(index)], np.maximum(index, 0), axis=2)
    right = ((true == np.arange(index.shape[2])) & (index >= 0)).sum()
    return float(right / (owner[: len(index)] >= 0).sum()), float(right / (index >= 0).sum())


@benchmark(
    "body_fitting",
    "fitting of bodies to joints, next to torch's LBFGS",
    integer("frames", 100),
    integer("compare", 500, "poses of the simple objective"),
)
def compare_fits(options: Namespace) -> Tables:
    """25 simulated people; joints are their keypoints with 20 mm of noise.

    The first row is this project's whole objective: shape, shared offsets, motion, priors. The
    others have a simpler one, the same for both: squared distances and 1e-4 of squared angles,
    betas known, frame by frame, from limbs along their joints. Gauss-Newton is on this project's
    keypoints and Jacobian, LBFGS, in single precision, on the same keypoints in torch. Gauss-Newton
    ends when a step gains less than a thousandth of the cost, LBFGS at 1 % above its cost, or after
    300 iterations. Times are scaled to all poses; OMP_NUM_THREADS=1 gives all sides one thread.
    """
    torch.set_num_threads(1)
    model = load_open_body()
    keypoints = fold_keypoints(model, COCO17)
    truth = draw_match(options.frames).bodies
    exact = keypoints(truth)
    joints = exact + JOINT_NOISE * np.random.default_rng(4).standard_normal(exact.shape)
    covariance = np.broadcast_to(JOINT_NOISE**2 * np.eye(3), (*joints.shape, 3))
    settings, poses = BodyFittingSettings(), exact.shape[0] * exact.shape[1]
    fit_bodies(model, ClipEvidence(joints[:8, :1], covariance[:8, :1], 50.0), settings)
    rows: list[list[Any]] = []

    def clock(label: str, number: int, work: Callable[[], tuple[Floats, float]]) -> float:
        begin, busy = time.perf_counter(), time.process_time()
        found, cost = work()
        wall, busy = time.perf_counter() - begin, time.process_time() - busy
        off = 1e3 * np.linalg.norm(found - exact.reshape(-1, 17, 3)[:number], axis=-1).mean()
        times = [wall * poses / number, busy * poses / number]
        ratio = times[1] / rows[1][2] if label == "LBFGS" else 1.0
        rows.append([label, *times, ratio, 1e3 * cost / number, off])
        return cost

    def fit_all() -> tuple[Floats, float]:
        fitted = fit_bodies(model, ClipEvidence(joints, covariance, 50.0), settings)
        return fitted.joints.reshape(-1, 17, 3), np.nan

    clock("fit_bodies", poses, fit_all)
    number = min(options.compare, poses)
    betas, wanted = truth.flat().betas[:number], joints.reshape(-1, 17, 3)[:number]
    chained = ChainedKeypoints.of(keypoints)
    side = DifferentiableBody(keypoints, torch.float32).keypoints
    _search(side, model, betas[:2], wanted[:2], 0.0, 2)  # not timed: what torch loads
    least = clock("Gauss-Newton", number, partial(gauss_newton, chained, betas, wanted))
    peer = partial(_search, side, model, betas, wanted, NEAR * least, MAX_STEPS)
    clock("LBFGS", number, peer)
    columns = ["side", "time [s]", "CPU [s]", "times Gauss-Newton", "cost of a pose [1e-3]"]
    return {"times": Table(f"{poses} poses", [*columns, "error [mm]"], rows)}


class ReachedError(Exception):
    """LBFGS has the cost of Gauss-Newton."""


def limb_start(model: BodyModel, betas: Floats, wanted: Floats) -> Floats:
    """Return positions and angles (poses, 75) of bodies with limbs along the wanted joints."""
    at = np.zeros((len(wanted), 75))
    for person in np.unique(betas, axis=0):
        own = (betas == person).all(-1)
        transl, orient, angles = start_poses(model, person, wanted[own], load_pose_prior())
        at[own] = np.concatenate([transl, orient, angles @ SPREAD.T], axis=-1)
    return at


def gauss_newton(chained: ChainedKeypoints, betas: Floats, wanted: Floats) -> tuple[Floats, float]:
    """Return keypoints (poses, 17, 3) and cost of the simple objective's least squares.

    Each pose has its own Levenberg-Marquardt damping.
    """
    count = len(wanted)
    weight = np.r_[np.zeros(3 + 3), np.full(69, WEIGHT)]
    at = limb_start(chained.model, betas, wanted)
    damping, best = np.full(count, 1e-3), np.full(count, np.inf)
    kept, found = at.copy(), np.zeros_like(wanted)
    jacobian, slope = np.zeros((count, 51, 75)), np.zeros((count, 75))
    for _ in range(MAX_STEPS):
        body = chained.differentiate(
            BodyParameters(betas, at[:, 3:6], at[:, 6:], at[:, :3]), by_betas=False
        )
        residual = (body.keypoints - wanted).reshape(count, 51)
        cost = (residual**2).sum(-1) + (weight * at**2).sum(-1)
        better = cost < best
        before = best.sum()
        damping = np.where(better, 0.2 * damping, 10.0 * damping)
        best = np.minimum(cost, best)
        kept[better], found[better] = at[better], body.keypoints[better]
        if before - best.sum() < LEAST_GAIN * best.sum():
            break
        jacobian[better, :, :3] = np.tile(np.eye(3), (17, 1))
        jacobian[better, :, 3:] = body.pose[better].reshape(-1, 51, 72)
        slope[better] = (residual[better, None] @ jacobian[better])[:, 0] + weight * at[better]
        # Woodbury: 51 residuals are fewer than 75 unknowns, whose own weights are diagonal.
        soft = 1.0 / (weight + damping[:, None])
        spread = jacobian * soft[:, None]
        inner = spread @ jacobian.swapaxes(-1, -2) + np.eye(51)
        pulled = np.linalg.solve(inner, spread @ slope[..., None])
        at = kept - soft * (slope - (jacobian.swapaxes(-1, -2) @ pulled)[..., 0])
    return found, float(best.sum())


def _search(
    keypoints: Callable[..., torch.Tensor],
    model: BodyModel,
    betas: Floats,
    joints: Floats,
    target: float,
    iterations: int,
) -> tuple[Floats, float]:
    """Return the keypoints (poses, 17, 3) and cost of LBFGS, which ends at the target."""
    at = torch.as_tensor(limb_start(model, betas, joints), dtype=torch.float32)
    wanted = torch.as_tensor(joints, dtype=torch.float32)
    shape = torch.tensor(betas, dtype=torch.float32)
    transl, pose = at[:, :3].clone().requires_grad_(), at[:, 3:].clone().requires_grad_()
    search = torch.optim.LBFGS([pose, transl], max_iter=iterations, line_search_fn="strong_wolfe")

    def loss() -> torch.Tensor:
        search.zero_grad()
        found = keypoints(shape, pose[:, :3], pose[:, 3:], transl)
        value = ((found - wanted) ** 2).sum() + WEIGHT * (pose[:, 3:] ** 2).sum()
        if value <= target:
            raise ReachedError
        value.backward()
        return value

    with suppress(ReachedError):
        search.step(loss)
    with torch.no_grad():
        found = keypoints(shape, pose[:, :3], pose[:, 3:], transl)
        cost = ((found - wanted) ** 2).sum() + WEIGHT * (pose[:, 3:] ** 2).sum()
    return found.numpy(), float(cost)
