"""Add a cost term: the surveyed height of a camera's mast, beside the clicks.

    worldpose simulate --scenario tiny --seed 1 --duration 1 --out match
    python examples/add_cost_term.py match/annotations/static_calibration/cam00.json 1920 1080 12.5

With the clicks' posterior of a step d from the calibrated camera L, its covariance C, and the
height h [m] of the lens, known to s = 0.02 m:

    E(d) = d^T C^-1 d + (z(L + d) - h)^2 / s^2.

A term is a function of the camera that returns its residual and the derivative by a step.
"""

import sys
from pathlib import Path
from typing import NamedTuple

import numpy as np

import worldpose as wp
from data_contracts.arrays import Floats
from worldpose.geometry.optimize.covariance import invert_free
from worldpose.geometry.optimize.levenberg_marquardt import Damping, minimize
from worldpose.static_calibration.parameters import CameraEstimate, step_between, step_camera

HEIGHT_STD = 0.02
COURSE = Damping(start=1e-9, decrease=10.0, lowest=1e-12, highest=1e6)


class State(NamedTuple):
    """A camera and its cost."""

    camera: wp.Camera
    cost: float


def height_residual(camera: wp.Camera, height: float) -> tuple[float, Floats]:
    """Return the centre's height less the surveyed one [m], and the derivative (12,) by a step."""
    by_step = np.zeros(12)
    by_step[3:6] = -camera.cam_from_world.rotation[:, 2]  # a shift in camera axes moves the center
    return float(camera.center[2]) - height, by_step


def add_height(found: CameraEstimate, height: float) -> wp.Camera:
    """Return the camera of minimum cost."""
    free = np.diagonal(found.covariance) > 0.0
    clicks = invert_free(found.covariance, free)

    def cost(camera: wp.Camera) -> float:
        step, off = step_between(found.camera, camera), height_residual(camera, height)[0]
        return float(step @ clicks @ step) + (off / HEIGHT_STD) ** 2

    def step(at: State, damping: float) -> State:
        off, by_step = height_residual(at.camera, height)
        by_step = by_step * free
        matrix = clicks + np.outer(by_step, by_step) / HEIGHT_STD**2
        gradient = clicks @ step_between(found.camera, at.camera) + by_step * off / HEIGHT_STD**2
        damped = matrix + damping * np.diag(np.diagonal(matrix)) + np.diag(~free * 1.0)
        camera = step_camera(at.camera, -np.linalg.solve(damped, gradient))
        return State(camera, cost(camera))

    def converged(before: State, after: State) -> bool:
        return abs(before.cost - after.cost) < 1e-9 * (1.0 + before.cost)

    start = State(found.camera, cost(found.camera))
    return minimize(start, step, COURSE, 50, converged).state.camera


if __name__ == "__main__":
    clicks, width, height, mast = sys.argv[1:]
    clicked = wp.ClickedMarkings.model_validate_json(Path(clicks).read_bytes())
    pitch = wp.PitchTemplate.from_spec(wp.PitchSpec())
    found = wp.calibrate_camera(pitch, clicked, (int(width), int(height)), where=clicks).estimate
    camera = add_height(found, float(mast))
    for evidence, each in (("clicks", found.camera), ("clicks and mast", camera)):
        print(f"center {each.center.round(2)} m by {evidence}")
