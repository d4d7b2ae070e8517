"""Prints how long bodies take to fit, beside torch's LBFGS on the same keypoints in the same run.

    python benchmarks/body_fitting.py [--persons 22] [--frames 500] [--compare 100]

Poses are smooth, of drawn betas; joints are the body's keypoints with 20 mm of noise. The first
line is this project's whole objective: shape, shared offsets, motion, priors. The second is a
simpler one: squared distances and 1e-4 of squared angles with betas known, frame by frame, by LBFGS
with a strong-Wolfe search of 60 iterations in single precision on folded keypoints; its time is
scaled from `--compare` poses. Both print the mean distance to the true joints. One thread each.
"""

from __future__ import annotations

import argparse
import time

import numpy as np
import torch

from data_contracts.conventions import COCO17
from worldpose.body import BodyParameters, fold_keypoints, load_open_body
from worldpose.body.differentiable import DifferentiableBody
from worldpose.body_fitting import BodyFittingSettings, fit_bodies
from worldpose.body_fitting.pose_space import SPREAD, load_pose_prior

NOISE = 0.02


def workload(persons: int, frames: int) -> BodyParameters:
    """Return bodies (frames, persons) that swing about the mean pose."""
    rng = np.random.default_rng(3)
    time_s = np.arange(frames)[:, None, None] / 50.0
    prior = load_pose_prior()
    spread = np.sqrt(np.diag(np.linalg.inv(prior.precision)))
    rates = rng.uniform(0.3, 2.0, (persons, len(spread)))
    phases = rng.uniform(0.0, 2.0 * np.pi, (persons, len(spread)))
    angles = prior.mean + 0.7 * spread * np.sin(2.0 * np.pi * rates * time_s + phases)
    place = rng.uniform(-30.0, 30.0, (persons, 3)) * [1.0, 1.0, 0.0] + [0.0, 0.0, 1.0]
    way = rng.normal(0.0, 2.0, (persons, 3)) * [1.0, 1.0, 0.0]
    return BodyParameters(
        betas=rng.normal(0.0, 1.0, (persons, 10)),
        global_orient=np.broadcast_to([np.pi / 2, 0.0, 0.0], (frames, persons, 3)),
        body_pose=angles @ SPREAD.T,
        transl=place + way * time_s,
    )


def main() -> None:
    """Print one line for each side."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--persons", type=int, default=22)
    parser.add_argument("--frames", type=int, default=500)
    parser.add_argument("--compare", type=int, default=100)
    options = parser.parse_args()
    torch.set_num_threads(1)
    model = load_open_body()
    keypoints = fold_keypoints(model, COCO17)
    truth = workload(options.persons, options.frames)
    exact = keypoints(truth)
    joints = exact + NOISE * np.random.default_rng(4).standard_normal(exact.shape)
    covariance = np.broadcast_to(NOISE**2 * np.eye(3), (*joints.shape, 3))
    settings = BodyFittingSettings()
    fit_bodies(model, joints[:8, :1], covariance[:8, :1], 50.0, settings)

    poses = options.persons * options.frames
    start, busy = time.perf_counter(), time.process_time()
    fit = fit_bodies(model, joints, covariance, 50.0, settings)
    wall, busy = time.perf_counter() - start, time.process_time() - busy
    off = np.linalg.norm(fit.joints - exact, axis=-1).mean()
    print(f"fit_bodies     {poses} poses {wall:7.1f} s (cpu {busy:.1f} s), {1e3 * off:.1f} mm off")

    count = min(options.compare, poses)
    flat = truth.flat()[:count]
    wanted = torch.as_tensor(joints.reshape(-1, 17, 3)[:count], dtype=torch.float32)
    body = DifferentiableBody(keypoints, torch.float32)
    betas = torch.tensor(flat.betas, dtype=torch.float32)
    pose = torch.zeros(count, 72)
    pose[:, 0] = np.pi / 2
    transl = wanted[:, 11:13].mean(1)
    pose.requires_grad_()
    transl.requires_grad_()
    search = torch.optim.LBFGS([pose, transl], max_iter=60, line_search_fn="strong_wolfe")

    def loss() -> torch.Tensor:
        search.zero_grad()
        found = body.keypoints(betas, pose[:, :3], pose[:, 3:], transl)
        value = ((found - wanted) ** 2).sum() + 1e-4 * (pose[:, 3:] ** 2).sum()
        value.backward()
        return value

    start, busy = time.perf_counter(), time.process_time()
    search.step(loss)
    scale = poses / count
    wall, busy = scale * (time.perf_counter() - start), scale * (time.process_time() - busy)
    with torch.no_grad():
        found = body.keypoints(betas, pose[:, :3], pose[:, 3:], transl).numpy()
    off = np.linalg.norm(found - exact.reshape(-1, 17, 3)[:count], axis=-1).mean()
    print(f"torch LBFGS 60 {poses} poses {wall:7.1f} s (cpu {busy:.1f} s), {1e3 * off:.1f} mm off")


if __name__ == "__main__":
    main()
