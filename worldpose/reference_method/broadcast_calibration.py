"""E_calib of the moving camera (section "Broadcasting Camera Calibration")."""

from __future__ import annotations

import torch
from torch import Tensor

from data_contracts.arrays import Floats, Integers
from worldpose.geometry.cameras import Camera
from worldpose.reference_method.cameras import TensorCameras


def robust(off: Tensor) -> Tensor:
    """Return Geman and McClure's rho(x) = x^2 / (1 + x^2 / c^2) (n,) of errors (n, 2) [px]."""
    squared = off.square().sum(-1)
    # Scale of the Geman-McClure function, that of SMPLify-X [px]; the paper gives none.
    scale_px = 100.0
    return squared / (1.0 + squared / scale_px**2)


def energy(cameras: TensorCameras, points: Tensor, image: Tensor, frame: Tensor) -> Tensor:
    """Return sum rho(Pi(X; Lambda_b) - x): E_field of markings, E_player of matched keypoints.

    Lambda_b is (frames,). X (n, 3) [m], world, are X' of markings, or P of people with I_ij = 1; x
    (n, 2) [px] their detections in frames (n,), of markings their initial positions.
    """
    return robust(cameras.project(points, frame) - image).sum()


def refine(
    start: Camera,
    field: tuple[Floats, Floats, Integers],
    players: tuple[Floats, Floats, Integers],
    iterations: int = 2000,
) -> Camera:
    """Return arg min of E_calib = lambda_4 E_field + lambda_5 E_player, by Adam.

    R, f and k1 to k3 are free in each frame, and the centre C in the clip. The principal point is
    one for the clip, as our records hold it; the paper has one per frame.

    `start` is a batch (frames,) with one centre. `field` has points (n, 3) [m], world, pixels (n,
    2) and frames (n,) of the markings, `players` the same of people's keypoints.
    """
    cameras = TensorCameras.of(start)
    bounds = ((0, 3), (3, 6), (6, 7), (7, 9), (9, 12))
    turn, center, focal, middle, lens = (cameras.values[:, a:b].clone() for a, b in bounds)
    moving = [part.requires_grad_() for part in (turn, center[:1], focal, middle[:1], lens)]

    def values() -> Tensor:
        return torch.cat([part.expand(len(focal), -1) for part in moving], dim=1)

    # Adam's learning rate.
    rate = 1e-3
    solver = torch.optim.Adam(moving, lr=rate)
    markings, people = (tuple(torch.tensor(each) for each in term) for term in (field, players))
    # lambda_4.
    field_weight = 1.0
    # lambda_5.
    player_weight = 0.5
    for _ in range(iterations):
        solver.zero_grad()
        moved = cameras.with_values(values())
        total = field_weight * energy(moved, *markings) + player_weight * energy(moved, *people)
        total.backward()
        solver.step()
    return cameras.with_values(values().detach()).camera()
