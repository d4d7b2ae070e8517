"""Prints which share of this machine's limits the kernels of the method reach.

    OMP_NUM_THREADS=1 python benchmarks/kernel_limits.py [--rounds 9]

Two limits are measured in the same run, in turns with the kernels: arithmetic, as a product of two
matrices of 768 x 768 by BLAS, and memory, as a sum of two arrays of 64 MB into a third. Every
kernel runs in its production configuration, in one thread, on the workload of its own benchmark.
Its operations are those that its source executes, counted by hand below: an addition,
multiplication, division, square root or comparison of doubles is one, and index arithmetic is none.
Its bytes are the arguments and results, each moved once. A kernel cannot be faster than the larger
of operations over the first limit and bytes over the second; the share is that time over its own.
Times are processor times, the least of all rounds; other programs on the machine lower both sides.
"""

from __future__ import annotations

import argparse
import time
from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import numpy as np
from body_fitting import NOISE as JOINT_NOISE
from body_fitting import workload as bodies
from broadcast_calibration import evidence, start_of, true_camera
from bundle_adjustment import make_problem
from common import stadium_rig
from numba import njit
from tracking import CAMERAS, GATE, SETTINGS, crowd, detections
from triangulation import workload as joints_workload

from data_contracts.arrays import Floats
from data_contracts.conventions import COCO17
from worldpose.body.body_file import load_open_body
from worldpose.body.jacobian import ChainedKeypoints
from worldpose.body.keypoints import fold_keypoints
from worldpose.body_fitting.objective import Evidence, Pose, Track
from worldpose.body_fitting.point_equations import VECTOR
from worldpose.body_fitting.pose_space import load_pose_prior, start_poses
from worldpose.body_fitting.settings import BodyFittingSettings
from worldpose.broadcast_calibration.moving_camera import CLIP_SIZE
from worldpose.broadcast_calibration.normal_equations import add_points, empty_equations
from worldpose.bundle_adjustment.solver import _System
from worldpose.geometry.optimize.banded import BandedFactor
from worldpose.tracking.ray_matching import ray_affinity
from worldpose.triangulation.batched_gauss_newton import LANES, ROWS, STATE, start, step
from worldpose.triangulation.observations import Rig
from worldpose.triangulation.smoothing import prepare_tiles

STEPS = 8
"""Steps of a joint, about as many as the robust solver takes."""
SIZE = 768
"""Rows of the matrices whose product is the limit of arithmetic."""
LENGTH = 8_000_000
"""Numbers in each array whose sum is the limit of memory."""


@dataclass(frozen=True)
class Kernel:
    """A kernel, and what it cannot avoid.

    Attributes:
        run: calls it once.
        unit: what one call computes `count` of.
        count: number of units per call.
        operations: operations on doubles per call.
        moved: bytes of arguments and results per call that do not stay in a cache.
    """

    run: Callable[[], object]
    unit: str
    count: int
    operations: float
    moved: float


def triangulation() -> Kernel:
    """Return a Gauss-Newton step of joints in tiles, as the robust solver takes them."""
    cameras, points, pixels, sure, _ = joints_workload(2)
    rig = Rig.from_cameras(cameras)
    count = len(points) // LANES * LANES
    tiles = prepare_tiles(
        np.ascontiguousarray(pixels[:, :count]), np.ascontiguousarray(sure[:, :count]), rig
    )
    states = np.zeros((len(tiles), STATE * LANES))
    for tile, state in zip(tiles, states, strict=True):
        start(tile, state)

    take: Any = njit(_take_steps)

    def run() -> None:
        take(tiles, rig.depths, (1.5, 0.0), states)

    # Depth and two errors 18, their division 3, size 2, weight 5, squared error 4, loss 3, weight
    # by it 3, derivatives 12 and 6, matrix 24, right side 12. Per joint: inverse 33, solution 15,
    # point and length of the step 8.
    operations = STEPS * count * (CAMERAS * 92 + 56)
    # A tile of 16 cameras stays in the second cache between the steps of the solver.
    assert tiles[0].nbytes == 8 * CAMERAS * ROWS * LANES
    return Kernel(run, "joint and step", STEPS * count, operations, 0.0)


def _take_steps(tiles: Floats, depths: Floats, noise: tuple[float, float], states: Floats) -> None:
    """Take the steps of each tile, one after the other, as the robust solver does."""
    for part in range(len(tiles)):
        for _ in range(STEPS):
            step(tiles[part], depths, noise, states[part])


def association() -> Kernel:
    """Return the distances of predicted people to all rays, with the gate."""
    frames, people = 20, 22
    rng = np.random.default_rng(4)
    cameras = stadium_rig(CAMERAS, rng, varied_lenses=False)
    joints = crowd(frames + 1, people, rng)
    keypoints, _ = detections(cameras, joints[1:], rng)
    image = keypoints.reshape(frames, CAMERAS, -1, 2)
    rays = cameras.unproject(image).directions.reshape(frames, CAMERAS, -1, 17, 3)
    weights = np.where(np.isfinite(rays[..., 0]), 1.0, 0.0)
    centers, gates = np.ascontiguousarray(cameras.center), np.full((CAMERAS, people), GATE)

    def run() -> None:
        for t in range(frames):
            ray_affinity(joints[t], centers, rays[t], weights[t], gates, SETTINGS.min_joints)

    computed = 0
    for t in range(frames):
        away = joints[t][None, :, None] - centers[:, None, None, None]
        along = np.maximum(0.0, np.einsum("cpdjx,cdjx->cpdj", away, rays[t]))
        off = np.linalg.norm(away - along[..., None] * rays[t][:, None], axis=-1)
        seen = weights[t] > 0.0
        total = np.cumsum(np.where(seen[:, None], off, 0.0), axis=-1)
        limit = GATE * seen.sum(-1)[:, None, :, None]
        # A pair ends with the first joint that puts its mean beyond the gate.
        before = np.concatenate([np.zeros_like(total[..., :1]), total[..., :-1]], axis=-1)
        enough = (seen.sum(-1) >= SETTINGS.min_joints)[:, None, :, None]
        computed += int(((before <= limit) & seen[:, None] & enough).sum())
    # Offset 3, product 5, comparison 1, rest 6, length 6, sum 1, gate 1.
    moved = rays.nbytes + weights.nbytes + joints.nbytes + 8 * frames * CAMERAS * people**2
    return Kernel(run, "frame", frames, 23.0 * computed, moved)


def adjustment() -> Kernel:
    """Return the assembly of the cameras' system, with the points eliminated."""
    problem = make_problem(18, 60, 22)
    system, cameras = _System(problem), problem.cameras
    numbers = len(problem.image)
    # Projection and its derivatives 169, gradient 72, block of the camera 312, mixed block 114,
    # of the point 42, elimination 144. Then the product of three dense rows per point.
    width = system.free.size + 1
    operations = 853.0 * numbers + 3.0 * len(problem.points) * width * (width + 1)
    moved = problem.image.nbytes + problem.points.nbytes + 4 * 8 * numbers
    return Kernel(
        lambda: system._assemble(cameras, problem.points, 1e-3),
        "observation",
        numbers,
        operations,
        moved,
    )


def body_equations() -> tuple[Kernel, Kernel]:
    """Return the normal equations of a person's track, and their factor with its solution."""
    frames = 500
    model, prior, settings = load_open_body(), load_pose_prior(), BodyFittingSettings()
    chained = ChainedKeypoints.of(fold_keypoints(model, COCO17))
    truth = bodies(1, frames)
    exact = fold_keypoints(model, COCO17)(truth)[:, 0]
    joints = exact + JOINT_NOISE * np.random.default_rng(4).standard_normal(exact.shape)
    covariance = np.broadcast_to(JOINT_NOISE**2 * np.eye(3), (*joints.shape, 3))
    own = Evidence.of(joints, covariance, 50.0, settings)
    track = Track(
        chained, own, prior, settings, 50.0, settings.acceleration_m_s2, settings.pose_weight(50.0)
    )
    betas = truth.flat().betas[0]
    pose = Pose(*start_poses(model, betas, joints, prior), betas)
    offsets = np.zeros((len(COCO17), 3))
    made = track.equations(pose, offsets, bordered=False)
    blocks, right = made.blocks.copy(), made.gradient[..., None]
    places, size = np.arange(blocks.shape[-1]), blocks.shape[-1]
    blocks[0][:, places, places] += 0.01

    def solve() -> None:
        BandedFactor.of(blocks).solve(right)

    # Which unknowns move a point 2 per number; a point's rows times its information 15, gradient 6;
    # then, for each unknown that moves it, a row of the lower triangle and two of the next frames'
    # blocks, all of them in whole vectors.
    moves = (made.points.pose[0] != 0.0).any(axis=1)
    whole = np.minimum(-(-(places + 1) // VECTOR) * VECTOR, size)
    ends = np.array([whole[np.flatnonzero(each)[-1]] for each in moves])
    summed = 6 * moves.size + 21 * ends.sum() + 6 * moves.sum()
    summed += 6 * ((moves * np.minimum(whole, ends[:, None])).sum() + 2 * moves.sum(axis=1) @ ends)
    # Terms of the keypoints by shape 2 x 11 x 3, turned 18, levers and derivatives 30 each; angles
    # 45 per joint and 2 x 27 for both chains; sums of angles 2 per term.
    terms = len(chained._terms[0])
    moved_by = int(chained._terms[3].sum())
    summed += terms * (66 + 18) + 30 * moved_by + 24 * (45 + 54 + 54) + 17 * 3 * 2 * 48
    equations = Kernel(
        lambda: track.equations(pose, offsets, bordered=False),
        "frame",
        frames,
        float(frames * summed),
        own.joints.nbytes + own.information.nbytes + blocks.nbytes,
    )
    # Two products for the lower triangle, a whole one, the triangle's own factor, two divisions by
    # it; forward and backward substitution of a vector.
    factor = 2 * size**2 * (size + 1) + 2 * size**3 + size**3 / 3 + 2 * size**3
    operations = frames * (factor + 4 * size * size * 2 + 2 * size * size)
    return equations, Kernel(solve, "frame", frames, operations, 3.0 * blocks.nbytes)


def broadcast() -> Kernel:
    """Return the equations of points in the frames of a moving camera."""
    rng = np.random.default_rng(7)
    frames = 300
    true, where = true_camera(frames, rng)
    points = evidence(true, where, rng)
    camera = start_of(true, rng)
    edges = np.searchsorted(points.frame, np.arange(frames + 1))
    none = np.zeros((0, 4))
    arrays = points.arrays(np.full((len(points), 2), -1))
    system = empty_equations(frames, CLIP_SIZE)
    # The place and camera axes 18, pixel and lens 25, derivatives 96, weighing 16; then twice a
    # whitened row 36, its error 3, gradient and triangle of twelve unknowns 192.
    operations = (18 + 25 + 96 + 16 + 2 * (36 + 3 + 192)) * len(points)
    moved = points.world.nbytes + points.image.nbytes + 8 * 8 * len(points)
    return Kernel(
        lambda: add_points(camera.arrays, edges, arrays, none, system),
        "observation",
        len(points),
        float(operations),
        float(moved),
    )


def limits() -> tuple[Callable[[], object], Callable[[], object]]:
    """Return calls that reach the limits of arithmetic and of memory."""
    rng = np.random.default_rng(0)
    first, second, product = rng.random((3, SIZE, SIZE))
    one, two, total = np.ones((3, LENGTH))

    def multiply() -> None:
        np.matmul(first, second, out=product)

    def add() -> None:
        np.add(one, two, out=total)

    return multiply, add


def main() -> None:
    """Print the limits, and one line per kernel."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--rounds", type=int, default=9)
    options = parser.parse_args()
    equations, factor = body_equations()
    kernels = {
        "triangulation": triangulation(),
        "association": association(),
        "adjustment, assembly": adjustment(),
        "bodies, equations": equations,
        "bodies, factor and solution": factor,
        "broadcast camera, points": broadcast(),
    }
    multiply, add = limits()
    sides = {"arithmetic": multiply, "memory": add} | {n: k.run for n, k in kernels.items()}
    best = dict.fromkeys(sides, np.inf)
    for done in range(options.rounds + 1):
        for name, run in sides.items():
            begun = time.thread_time()
            run()
            if done:
                best[name] = min(best[name], time.thread_time() - begun)
    rate = 2.0 * SIZE**3 / best["arithmetic"]
    speed = 24.0 * LENGTH / best["memory"]
    print(f"arithmetic {rate / 1e9:.1f} GFlop/s, memory {speed / 1e9:.1f} GB/s, one thread")
    print(f"{'kernel':28s} {'time':>10s} {'per':15s} {'GFlop/s':>8s} {'GB/s':>6s}  share of limit")
    for name, kernel in kernels.items():
        seconds = best[name]
        by_work, by_bytes = kernel.operations / rate, kernel.moved / speed
        which = "arithmetic" if by_work >= by_bytes else "memory"
        print(
            f"{name:28s} {1e6 * seconds / kernel.count:7.3f} us {kernel.unit:15s} "
            f"{kernel.operations / seconds / 1e9:8.2f} {kernel.moved / seconds / 1e9:6.2f}  "
            f"{100.0 * max(by_work, by_bytes) / seconds:4.0f} % of {which}"
        )


if __name__ == "__main__":
    main()
