"""The share of the machine's limits that the compiled kernels reach."""

from __future__ import annotations

import time
from argparse import Namespace
from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import numpy as np
from numba import njit
from registry import Table, Tables, benchmark, integer
from speed_cameras import make_problem
from speed_people import JOINT_NOISE, draw_joints, draw_match

from data_contracts.arrays import Floats
from data_contracts.conventions import COCO17
from worldpose.body.body_file import load_open_body
from worldpose.body.jacobian import ChainedKeypoints
from worldpose.body.keypoints import fold_keypoints
from worldpose.body_fitting.objective import Evidence, Pose, Track
from worldpose.body_fitting.point_equations import VECTOR
from worldpose.body_fitting.pose_space import load_pose_prior, start_poses
from worldpose.body_fitting.settings import BodyFittingSettings
from worldpose.bundle_adjustment.solver import _System
from worldpose.triangulation.batched_gauss_newton import LANES, ROWS, STATE, start, step
from worldpose.triangulation.observations import Rig
from worldpose.triangulation.track_solver import prepare_tiles

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


@benchmark(
    "kernel_limits",
    "share of this machine's limits that the compiled kernels reach",
    integer("rounds", 9),
)
def compare_with_limits(options: Namespace) -> Tables:
    """Two limits are measured in turns with the kernels, in one thread; set OMP_NUM_THREADS=1.

    Arithmetic is a product of two matrices of 768 x 768 by BLAS, memory a sum of two arrays of 64
    MB into a third. Operations are those that a kernel's source executes, counted by hand below: an
    addition, multiplication, division, square root or comparison of doubles is one, and index
    arithmetic is none. Bytes are the arguments and results, each moved once. The share is the
    larger of operations over the first limit and bytes over the second, over the kernel's own
    processor time, the least of all rounds.
    """
    kernels = {
        "triangulation": triangulation(),
        "adjustment, assembly": adjustment(),
        "bodies, equations": body_equations(),
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
    rows = []
    for name, kernel in kernels.items():
        seconds = best[name]
        by_work, by_bytes = kernel.operations / rate, kernel.moved / speed
        which = "arithmetic" if by_work >= by_bytes else "memory"
        share = 100.0 * max(by_work, by_bytes) / seconds
        speeds = [kernel.operations / seconds / 1e9, kernel.moved / seconds / 1e9]
        rows.append([name, 1e6 * seconds / kernel.count, kernel.unit, *speeds, share, which])
    columns = ["kernel", "time [us]", "per", "GFlop/s", "GB/s", "share [%]", "of"]
    found = [["arithmetic [GFlop/s]", rate / 1e9], ["memory [GB/s]", speed / 1e9]]
    return {
        "limits": Table("limits of one thread", ["limit", "value"], found),
        "kernels": Table("kernels", columns, rows),
    }


def triangulation() -> Kernel:
    """Return a Gauss-Newton step of joints in tiles, as the robust solver takes them."""
    cameras, points, pixels, sure = draw_joints(4)
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
    operations = STEPS * count * (len(cameras.focal) * 92 + 56)
    # A tile of 16 cameras stays in the second cache between the steps of the solver.
    assert tiles[0].nbytes == 8 * len(cameras.focal) * ROWS * LANES
    return Kernel(run, "joint and step", STEPS * count, operations, 0.0)


def _take_steps(tiles: Floats, depths: Floats, noise: tuple[float, float], states: Floats) -> None:
    """Take the steps of each tile, one after the other, as the robust solver does."""
    for part in range(len(tiles)):
        for _ in range(STEPS):
            step(tiles[part], depths, noise, states[part])


def adjustment() -> Kernel:
    """Return the assembly of the cameras' system, with the points eliminated."""
    problem = make_problem(60, 22)
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


def body_equations() -> Kernel:
    """Return the normal equations of a person's track."""
    frames = 200
    model, prior, settings = load_open_body(), load_pose_prior(), BodyFittingSettings()
    chained = ChainedKeypoints.of(fold_keypoints(model, COCO17))
    truth = draw_match(frames).bodies[:, :1]
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
    blocks, places, size = made.blocks, np.arange(made.blocks.shape[-1]), made.blocks.shape[-1]

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
    return Kernel(
        lambda: track.equations(pose, offsets, bordered=False),
        "frame",
        frames,
        float(frames * summed),
        own.joints.nbytes + own.information.nbytes + blocks.nbytes,
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
