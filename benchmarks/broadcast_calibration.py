"""Prints time and accuracy of the moving camera's solver next to Adam and SciPy, in one run.

    python benchmarks/broadcast_calibration.py [--frames 1500] [--adam 2000]

A pan and zoom of the simulated broadcast camera with 20 places on the pitch and 17 joints of 16
people per frame, 2 px of noise and 8 % of outliers, from a start with errors of about 20 px; the
cost is the same for all: Geman-McClure losses, smoothness and priors. Adam, at the paper's rate of
1e-3, uses our compiled gradient, so that only the method differs. SciPy's sparse trust region gets
the pattern of the Jacobian and as much time as Adam takes. One thread.
"""

from __future__ import annotations

import argparse
import time
from contextlib import suppress
from dataclasses import replace

import numpy as np
from scipy.optimize import least_squares
from scipy.sparse import csr_matrix, lil_matrix, vstack

from data_contracts.arrays import Floats
from worldpose.broadcast_calibration.evidence import (
    PLAYER,
    FlowEvidence,
    ObservedPoints,
    PointEvidence,
)
from worldpose.broadcast_calibration.moving_camera import CLIP_SIZE, FRAME_SIZE, MovingCamera
from worldpose.broadcast_calibration.priors import build_prior, second_differences
from worldpose.broadcast_calibration.settings import BroadcastPrior
from worldpose.broadcast_calibration.solver import Problem, descend, equations_at, solve
from worldpose.pitch.template import PitchTemplate
from worldpose.simulation.scene import move_broadcast_camera
from worldpose.simulation.settings import BroadcastSettings

SMOOTH = np.array([np.inf, np.inf, np.inf, 1e-4, 1e-3, 1e-2, 1e-2])
NOISE, OUTLIERS, LOSS = 2.0, 0.08, 4.0


def true_camera(frames: int, rng: np.random.Generator) -> tuple[MovingCamera, Floats]:
    """Return the camera, and the place of the action (frames, 2) [m]."""
    times = np.arange(frames) / 50.0
    at = np.arange(-2.0, times[-1] + 1.0, 0.1)
    action = np.stack([25.0 * np.sin(0.25 * at), 8.0 * np.sin(0.4 * at)], axis=1)
    camera = move_broadcast_camera(
        BroadcastSettings(sweep_m=10.0), times, action, at, (1920, 1080), rng
    )
    where = np.stack([np.interp(times, at, axis) for axis in action.T], axis=-1)
    return MovingCamera.of(camera, camera.center[0], camera.principal_point[0]), where


def evidence(camera: MovingCamera, where: Floats, rng: np.random.Generator) -> PointEvidence:
    """Return noisy pixels of the pitch and of people in every frame."""
    frames, pitch = len(camera), PitchTemplate.standard()
    ground = np.stack([rng.uniform(-20.0, 20.0, (frames, 20)) for _ in range(2)], axis=-1)
    ground += where[:, None]
    heights = pitch.height(ground[..., 0], ground[..., 1])
    joints = rng.uniform([-15.0, -12.0, 0.0], [15.0, 12.0, 1.8], (frames, 16 * 17, 3))
    joints[..., :2] += where[:, None]
    world = np.concatenate([np.concatenate([ground, heights[..., None]], axis=-1), joints], axis=1)
    image = camera.camera.project(world)
    image = image + NOISE * rng.standard_normal(image.shape)
    wrong = rng.random(image.shape[:2]) < OUTLIERS
    image[wrong] += 60.0 * rng.standard_normal((int(wrong.sum()), 2))
    with np.errstate(invalid="ignore"):
        inside = ((image > 0.0) & (image < camera.image_size - 1.0)).all(axis=-1)
    inside &= rng.random(inside.shape) > 0.1
    frame, _ = np.nonzero(inside)
    return PointEvidence.at_points(
        ObservedPoints(
            frame=frame,
            world=world[inside],
            image=image[inside],
            kind=PLAYER,
            source=np.zeros(len(frame), dtype=np.int64),
        ),
        np.full(len(frame), NOISE),
        1.0,
        LOSS,
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


def figures(camera: MovingCamera, true: MovingCamera, points: PointEvidence) -> str:
    """Return errors against the truth in words."""
    pixels = []
    for frame in range(0, len(camera), max(1, len(camera) // 50)):
        mine = points.world[points.frame == frame]
        one, two = camera.frames(slice(frame, frame + 1)), true.frames(slice(frame, frame + 1))
        pixels.append(one.camera[0].project(mine) - two.camera[0].project(mine))
    rms = np.sqrt((np.concatenate(pixels) ** 2).sum(axis=-1).mean())
    focal = 100.0 * np.median(np.abs(camera.focal / true.focal - 1.0))
    center = 100.0 * np.linalg.norm(camera.center - true.center)
    return f"{rms:7.3f} px {focal:7.4f} % focal {center:7.1f} cm"


def by_scipy(start: MovingCamera, problem: Problem, seconds: float) -> tuple[MovingCamera, int]:
    """Return SciPy's trust region result after about `seconds`, and its number of evaluations."""
    points, prior = problem.points, problem.prior
    frames, count = len(start), len(problem.points)
    frame = points.frame
    begin, calls = time.perf_counter(), [0]
    best: list[tuple[float, Floats]] = []

    def camera_at(x: Floats) -> MovingCamera:
        return start.take_step(x[:-CLIP_SIZE].reshape(frames, FRAME_SIZE), x[-CLIP_SIZE:])

    def residuals(x: Floats) -> Floats:
        camera = camera_at(x)
        gone = np.einsum("nij,nj->ni", camera.rotation[frame], points.world - camera.center)
        plane = gone[:, :2] / gone[:, 2:]
        s = (plane**2).sum(axis=-1)
        k = camera.distortion[frame]
        radial = 1.0 + s * (k[:, 0] + s * (k[:, 1] + s * k[:, 2]))
        pixels = (camera.focal[frame] * radial)[:, None] * plane + camera.principal_point
        off = (pixels - points.image) / NOISE
        off *= LOSS / np.sqrt(LOSS**2 + (off**2).sum(axis=-1, keepdims=True))
        rough = (second_differences(camera)[:, 3:] / problem.smoothness[3:]).ravel()
        lens = ((camera.distortion - prior.distortion) / prior.distortion_std).ravel()
        zoom = (np.log(camera.focal) - prior.log_focal) / prior.log_focal_std
        place = np.sqrt(np.diag(prior.center_information)) * (camera.center - prior.center)
        middle = (camera.principal_point - prior.principal_point) / prior.principal_std
        value = np.concatenate([off.ravel(), rough, lens, zoom, place, middle])
        cost = 0.5 * float(value @ value)
        calls[0] += 1
        if not best or cost < best[0][0]:
            best[:] = [(cost, x.copy())]
        if time.perf_counter() - begin > seconds:
            raise TimeoutError
        return value

    size = frames * FRAME_SIZE + CLIP_SIZE
    rows = np.repeat(np.arange(2 * count), FRAME_SIZE + CLIP_SIZE)
    own = FRAME_SIZE * np.repeat(frame, 2)[:, None] + np.arange(FRAME_SIZE)
    shared = np.broadcast_to(np.arange(size - CLIP_SIZE, size), (2 * count, CLIP_SIZE))
    columns = np.concatenate([own, shared], axis=1).ravel()
    points_part = csr_matrix((np.ones(len(rows), np.int8), (rows, columns)), (2 * count, size))
    rest = lil_matrix((4 * (frames - 2) + 4 * frames + CLIP_SIZE, size), dtype=np.int8)
    for t in range(frames - 2):
        for j in range(4):
            for ahead in range(3):
                rest[4 * t + j, FRAME_SIZE * (t + ahead) + 3 + j] = 1
    first = 4 * (frames - 2)
    for t in range(frames):
        for j in range(3):
            rest[first + 3 * t + j, FRAME_SIZE * t + 4 + j] = 1
        rest[first + 3 * frames + t, FRAME_SIZE * t + 3] = 1
    for j in range(CLIP_SIZE):
        rest[first + 4 * frames + j, size - CLIP_SIZE + j] = 1
    pattern = vstack([points_part, rest.tocsr()])
    with suppress(TimeoutError):
        least_squares(residuals, np.zeros(size), jac_sparsity=pattern, x_scale="jac")
    return camera_at(best[0][1]), calls[0]


def main() -> None:
    """Print one line per method."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--frames", type=int, default=1500)
    parser.add_argument("--adam", type=int, default=2000)
    parser.add_argument("--no-scipy", action="store_true")
    options = parser.parse_args()
    rng = np.random.default_rng(7)
    true, where = true_camera(options.frames, rng)
    points = evidence(true, where, rng)
    start = start_of(true, rng)
    prior = build_prior(BroadcastPrior(), start.focal, start.image_size)
    problem = Problem(points, FlowEvidence.none(), prior, SMOOTH)
    # Exclude compilation from the measurement.
    some = replace(problem, points=points[points.frame < 5])
    few = replace(some, prior=build_prior(BroadcastPrior(), start.focal[:5], start.image_size))
    solve(start.frames(slice(0, 5)), few, 2)
    none = np.zeros((0, 4))
    print(f"{options.frames} frames, {len(points)} observations, one thread")
    print(f"{'start':28s} {'':9s} {equations_at(start, none, problem).cost:14.1f}"
          f"  {figures(start, true, points)}")  # fmt: skip
    begin = time.perf_counter()
    ours = solve(start, problem, 60)
    own = time.perf_counter() - begin
    label = f"ours, {len(ours.costs) - 1} iterations"
    print(f"{label:28s} {own:7.2f} s {ours.cost:14.1f}  {figures(ours.camera, true, points)}",
          flush=True)  # fmt: skip
    begin = time.perf_counter()
    adam = descend(start, problem, options.adam)
    slow = time.perf_counter() - begin
    label = f"Adam 1e-3, {options.adam} iterations"
    print(f"{label:28s} {slow:7.2f} s {adam.cost:14.1f}  {figures(adam.camera, true, points)}"
          f"  {slow / own:.0f} times as long", flush=True)  # fmt: skip
    if not options.no_scipy:
        begin = time.perf_counter()
        camera, calls = by_scipy(start, problem, slow)
        spent = time.perf_counter() - begin
        cost = equations_at(camera, none, problem).cost
        label = f"SciPy trf, {calls} evaluations"
        print(f"{label:28s} {spent:7.2f} s {cost:14.1f}  {figures(camera, true, points)}")


if __name__ == "__main__":
    main()
