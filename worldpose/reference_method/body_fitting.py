"""Shape, root and E_refine (section "SMPL Registration and Refinement")."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
import torch
from scipy.optimize import linprog
from torch import Tensor
from torch.func import jacrev

from data_contracts.arrays import Floats
from data_contracts.conventions import COCO17_HIPS, COCO17_RIGID_BONES, COCO17_TORSO
from worldpose.body.differentiable import DifferentiableBody
from worldpose.geometry.rigid import Rigid, align
from worldpose.reference_method.cameras import TensorCameras


class Omega(NamedTuple):
    """Omega = (theta_r, theta_b, t, beta) of one person over time."""

    betas: Tensor
    """(shapes,) beta."""
    orient: Tensor
    """(frames, 3) theta_r [rad], world."""
    pose: Tensor
    """(frames, 69) theta_b [rad]."""
    transl: Tensor
    """(frames, 3) t [m], world."""


class Weights(NamedTuple):
    """lambda_1 to lambda_3 of E_refine; the paper gives no values.

    Inverse variances of 3 px, of a second difference of 1 cm, and of SMPL's normal betas.
    """

    data: float = 3.0**-2
    smooth: float = 0.01**-2
    shape: float = 1.0


def fit_shape(body: DifferentiableBody, joints: Floats) -> Floats:
    """Return beta* = arg min |l(P) - l(J(T)) - sum beta_i l(J(B_i))| (shapes,).

    l(J(B_i)) is here the change of the template's bone lengths with beta_i, since the lengths of
    the shape directions themselves have no sign. l(P) is the median over the frames. Betas stay
    within 5 standard deviations.

    Args:
        body: with the keypoints of COCO-17.
        joints: (frames, 17, 3) P [m]; NaN where missing.
    """
    first, second = np.array(COCO17_RIGID_BONES).T

    def lengths(betas: Tensor) -> Tensor:
        still = (betas.new_zeros(size) for size in (3, 69, 3))
        rest = body.keypoints(betas, *still)
        found: Tensor = torch.linalg.vector_norm(rest[second] - rest[first], dim=-1)
        return found

    mean = torch.zeros(body.model.shapes, dtype=torch.float64)
    measured = np.linalg.norm(joints[:, second] - joints[:, first], axis=-1)
    seen = np.isfinite(measured).any(axis=0)
    right = np.nanmedian(measured[:, seen], axis=0) - lengths(mean).numpy()[seen]
    rows, slack = np.asarray(jacrev(lengths)(mean))[seen], np.eye(int(seen.sum()))
    found = linprog(
        np.repeat([0.0, 1.0], [len(mean), len(right)]),
        A_ub=np.block([[rows, -slack], [-rows, -slack]]),
        b_ub=np.concatenate([right, -right]),
        bounds=[(-5.0, 5.0)] * len(mean) + [(0.0, None)] * len(right),
    )
    return np.asarray(found.x[: len(mean)], dtype=np.float64)


def align_root(body: DifferentiableBody, start: Omega, joints: Floats) -> Omega:
    """Return Omega whose hips and torso are nearest to P's, where only theta_r and t move.

    The body has the keypoints of COCO-17; `start` has theta_b and beta, and theta_r and t of 0. P
    are (frames, 17, 3) [m], world. A frame with fewer than three of these keypoints takes the root
    of the nearest frame with them; one frame has them at least.
    """
    torso = joints[:, COCO17_TORSO]
    usable = np.flatnonzero(np.isfinite(torso[..., 0]).sum(-1) >= 3)
    nearest = usable[np.abs(np.arange(len(joints))[:, None] - usable).argmin(axis=1)]
    own = body.keypoints(*start)[:, COCO17_TORSO].numpy()
    motion = align(own[nearest], torso[nearest], with_scale=False)
    # theta_r turns the body about its pelvis.
    pelvis = body.joints(*start)[:, 0].numpy()
    transl = motion.apply(pelvis[:, None])[:, 0] - pelvis
    orient = Rigid(motion.rotation, np.zeros(3)).rotvec
    return start._replace(orient=torch.tensor(orient), transl=torch.tensor(transl))


def align_keypoints(cameras: TensorCameras, image: Tensor, joints: Tensor) -> Tensor:
    """Return p - p_midhip + Pi(P_midhip) (frames, cameras, 17, 2) [px].

    "We align the projected 2D keypoint with the hip to minimize errors introduced by a misaligned
    root", as the supplement writes it for triangulation. p are (frames, cameras, 17, 2) [px], NaN
    where not seen, P (frames, 17, 3), triangulated [m], world, NaN where missing.
    """
    middle = cameras.project(joints[:, COCO17_HIPS].mean(1)[:, None])
    return image - image[:, :, COCO17_HIPS].mean(2, keepdim=True) + middle[:, :, None]


def data_energy(joints: Tensor, cameras: TensorCameras, aligned: Tensor) -> Tensor:
    """Return E_data = sum ||Pi(P) - p||^2 [px^2] of keypoints from `align_keypoints`.

    Args:
        joints: (frames, 17, 3) P of the body [m], world.
        cameras: (cameras,).
        aligned: (frames, cameras, 17, 2) p [px]; NaN where not seen.
    """
    off = cameras.project(joints[:, :, None]).transpose(1, 2) - aligned
    return torch.where(torch.isfinite(off), off, 0.0).square().sum()


def smoothness_energy(joints: Tensor) -> Tensor:
    """Return E_smooth = sum ||(P_t+1 - P_t) - (P_t - P_t-1)||^2 [m^2] of (frames, 17, 3) [m]."""
    return torch.diff(joints, n=2, dim=0).square().sum()


def shape_energy(betas: Tensor) -> Tensor:
    """Return E_shape = ||beta||^2 [1]."""
    return betas.square().sum()


def refine_energy(
    body: DifferentiableBody, omega: Omega, cameras: TensorCameras, aligned: Tensor
) -> Tensor:
    """Return E_refine = lambda_1 E_data + lambda_2 E_smooth + lambda_3 E_shape."""
    weights = Weights()
    joints = body.keypoints(*omega)
    return (
        weights.data * data_energy(joints, cameras, aligned)
        + weights.smooth * smoothness_energy(joints)
        + weights.shape * shape_energy(omega.betas)
    )


def fit_person(
    body: DifferentiableBody,
    joints: Floats,
    cameras: TensorCameras,
    image: Tensor,
    betas: Floats | None = None,
    iterations: int = 300,
) -> Omega:
    """Return Omega after shape, root alignment and E_refine, by L-BFGS as in SMPLify-X.

    The body has the keypoints of COCO-17. P are (frames, 17, 3) [m], world, three of hips and
    shoulders in one frame at least; images (frames, cameras, 17, 2) [px] are NaN where not seen.
    Betas (shapes,) stay if the shape is known; L-BFGS has so many iterations at most.
    """
    shape = torch.tensor(fit_shape(body, joints) if betas is None else betas)
    still = (torch.zeros(len(joints), n, dtype=torch.float64) for n in (3, 69, 3))
    start = align_root(body, Omega(shape, *still), joints)
    aligned = align_keypoints(cameras, image, torch.tensor(joints))
    omega = Omega(*(each.clone().requires_grad_() for each in start))
    moving = list(omega if betas is None else omega[1:])
    solver = torch.optim.LBFGS(moving, max_iter=iterations, line_search_fn="strong_wolfe")

    def energy() -> Tensor:
        solver.zero_grad()
        total = refine_energy(body, omega, cameras, aligned)
        total.backward()
        return total

    solver.step(energy)
    return Omega(*(each.detach() for each in omega))
