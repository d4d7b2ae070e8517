"""Prints the time of body fitting, next to torch's LBFGS in the same run.

    python benchmarks/body_fitting.py [--persons 22] [--frames 500] [--compare 500] [--mesh 50]

Poses are smooth, with random betas; joints are the body's keypoints with 20 mm of noise. The first
line is this project's whole objective: shape, shared offsets, motion, priors. The others have a
simpler one, the same for all of them: squared distances and 1e-4 of squared angles, betas known,
frame by frame. Gauss-Newton is on this project's keypoints and Jacobian. LBFGS, with a strong-Wolfe
search in single precision, is on the same keypoints in torch and, where smplx is installed, on the
vertices of its mesh. All sides run from the same two starts: limbs along their joints, as this
project's fit starts, and the unposed upright body between the hips. Gauss-Newton ends when a step
gains less than a thousandth of the cost. LBFGS ends where its cost is at most 1 % above that of
Gauss-Newton, by its usual tolerances, or after 300 iterations. Times include the computation of the
start and are scaled to all poses from `--compare` and `--mesh` of them. Each line has the final
cost and the mean distance to the true joints. Torch has one thread; with OMP_NUM_THREADS=1 all
sides have one.
"""

from __future__ import annotations

import argparse
import time
from collections.abc import Callable
from contextlib import suppress

import numpy as np
import torch

from data_contracts.arrays import Floats
from data_contracts.conventions import COCO17
from worldpose.body.body_file import load_open_body
from worldpose.body.differentiable import DifferentiableBody
from worldpose.body.jacobian import ChainedKeypoints
from worldpose.body.keypoints import JOINT_OF_POINT, VERTEX_OF_POINT, fold_keypoints
from worldpose.body.model import BodyModel, BodyParameters
from worldpose.body_fitting.body_fit import ClipEvidence, fit_bodies
from worldpose.body_fitting.pose_space import SPREAD, load_pose_prior, start_poses
from worldpose.body_fitting.settings import BodyFittingSettings

NOISE = 0.02
WEIGHT = 1e-4
"""Weight of squared angles [m^2/rad^2]."""
MAX_STEPS = 300
"""Steps of Gauss-Newton and iterations of LBFGS."""
LEAST_GAIN = 1e-3
"""Share of the cost that a step of Gauss-Newton has to gain."""
NEAR = 1.01
"""Cost at which LBFGS ends, in costs of Gauss-Newton."""


class ReachedError(Exception):
    """LBFGS has the cost of Gauss-Newton."""


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
    parser.add_argument("--compare", type=int, default=500)
    parser.add_argument("--mesh", type=int, default=50)
    options = parser.parse_args()
    torch.set_num_threads(1)
    model = load_open_body()
    keypoints = fold_keypoints(model, COCO17)
    truth = workload(options.persons, options.frames)
    exact = keypoints(truth)
    joints = exact + NOISE * np.random.default_rng(4).standard_normal(exact.shape)
    covariance = np.broadcast_to(NOISE**2 * np.eye(3), (*joints.shape, 3))
    settings = BodyFittingSettings()
    fit_bodies(model, ClipEvidence(joints[:8, :1], covariance[:8, :1], 50.0), settings)

    poses = options.persons * options.frames
    start, busy = time.perf_counter(), time.process_time()
    fit = fit_bodies(model, ClipEvidence(joints, covariance, 50.0), settings)
    wall, busy = time.perf_counter() - start, time.process_time() - busy
    off = np.linalg.norm(fit.joints - exact, axis=-1).mean()
    print(f"fit_bodies     {poses} poses {wall:7.1f} s (cpu {busy:.1f} s), {1e3 * off:.1f} mm off")

    count = min(options.compare, poses)
    flat, wanted = truth.flat()[:count], joints.reshape(-1, 17, 3)[:count]
    true = exact.reshape(-1, 17, 3)[:count]
    chained, body = ChainedKeypoints.of(keypoints), DifferentiableBody(keypoints, torch.float32)
    mesh = _mesh(model)
    few = min(options.mesh, count)
    for side in (body.keypoints, *([] if mesh is None else [mesh])):  # not timed: what torch loads
        _search(side, model, flat.betas[:2], wanted[:2], unposed_start, 0.0, 2)
    for name, initial in (("limbs", limb_start), ("unposed", unposed_start)):
        start, busy = time.perf_counter(), time.process_time()
        found, cost = gauss_newton(chained, flat.betas, wanted, initial)
        wall, busy = time.perf_counter() - start, time.process_time() - busy
        _print(f"Gauss-Newton, {name}", poses, count, wall, busy, cost, found - true)
        sides = [(f"LBFGS, {name}", body.keypoints, count)]
        if mesh is not None and few:
            sides.append((f"LBFGS of the mesh, {name}", mesh, few))
        for label, side, some in sides:
            target = NEAR * cost * some / count
            start, busy = time.perf_counter(), time.process_time()
            found, least = _search(
                side, model, flat.betas[:some], wanted[:some], initial, target, MAX_STEPS
            )
            wall, busy = time.perf_counter() - start, time.process_time() - busy
            _print(label, poses, some, wall, busy, least, found - true[:some])


def limb_start(model: BodyModel, betas: Floats, wanted: Floats) -> Floats:
    """Return positions and angles (poses, 75) of bodies with limbs along the wanted joints."""
    at = np.zeros((len(wanted), 75))
    for person in np.unique(betas, axis=0):
        own = (betas == person).all(-1)
        transl, orient, angles = start_poses(model, person, wanted[own], load_pose_prior())
        at[own] = np.concatenate([transl, orient, angles @ SPREAD.T], axis=-1)
    return at


def unposed_start(model: BodyModel, betas: Floats, wanted: Floats) -> Floats:
    """Return positions and angles (poses, 75) of upright bodies between the wanted hips."""
    at = np.zeros((len(wanted), 75))
    at[:, :3], at[:, 3] = wanted[:, 11:13].mean(1), np.pi / 2
    return at


Start = Callable[[BodyModel, Floats, Floats], Floats]


def gauss_newton(
    chained: ChainedKeypoints, betas: Floats, wanted: Floats, initial: Start
) -> tuple[Floats, float]:
    """Return keypoints (poses, 17, 3) and cost of the simple objective's least squares.

    Each pose has its own Levenberg-Marquardt damping.
    """
    count = len(wanted)
    weight = np.r_[np.zeros(3 + 3), np.full(69, WEIGHT)]
    at = initial(chained.model, betas, wanted)
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
    initial: Start,
    target: float,
    iterations: int,
) -> tuple[Floats, float]:
    """Return the keypoints (poses, 17, 3) and cost of LBFGS, which ends at the target."""
    at = torch.as_tensor(initial(model, betas, joints), dtype=torch.float32)
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
        value.backward()  # type: ignore[no-untyped-call]
        return value

    with suppress(ReachedError):
        search.step(loss)  # type: ignore[no-untyped-call]
    with torch.no_grad():
        found = keypoints(shape, pose[:, :3], pose[:, 3:], transl)
        cost = ((found - wanted) ** 2).sum() + WEIGHT * (pose[:, 3:] ** 2).sum()
    return found.numpy(), float(cost)


def _mesh(model: BodyModel) -> Callable[..., torch.Tensor] | None:
    """Return keypoints picked from smplx's mesh of this body; None if smplx is not installed."""
    try:
        import smplx
        from smplx.utils import Struct
    except ImportError:
        return None
    arrays = {
        "v_template": model.template,
        "shapedirs": model.shape_directions,
        "posedirs": model.pose_directions,
        "J_regressor": model.joint_regressor,
        "weights": model.weights,
        "kintree_table": np.stack([model.parents, np.arange(24)]),
        "f": model.faces.astype(np.uint32),
    }
    points = [VERTEX_OF_POINT[name] for name in COCO17[:5]]
    limbs = [JOINT_OF_POINT[name] for name in COCO17[5:]]
    layers: dict[int, smplx.SMPL] = {}

    def keypoints(
        betas: torch.Tensor, orient: torch.Tensor, pose: torch.Tensor, transl: torch.Tensor
    ) -> torch.Tensor:
        count = len(betas)
        if count not in layers:
            layers[count] = smplx.SMPL(
                model_path="", data_struct=Struct(**arrays), batch_size=count, vertex_ids=None
            )
        out = layers[count](betas=betas, global_orient=orient, body_pose=pose, transl=transl)
        return torch.cat([out.vertices[:, points], out.joints[:, limbs]], dim=1)

    return keypoints


def _print(
    name: str, poses: int, count: int, wall: float, busy: float, cost: float, away: Floats
) -> None:
    scale = poses / count
    off = 1e3 * np.linalg.norm(away, axis=-1).mean()
    print(
        f"{name:28} {poses} poses {scale * wall:7.1f} s (cpu {scale * busy:.1f} s), "
        f"cost {1e3 * cost / count:.3f}e-3 a pose, {off:.1f} mm off"
    )


if __name__ == "__main__":
    main()
