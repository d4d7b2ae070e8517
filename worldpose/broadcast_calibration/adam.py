"""Adam on the cost of the Levenberg-Marquardt solver, as in the paper (M5)."""

from __future__ import annotations

import numpy as np

from worldpose.broadcast_calibration.moving_camera import CLIP_SIZE, FRAME_SIZE, MovingCamera
from worldpose.broadcast_calibration.solving import Problem, Solution, equations_at

RATE = 1e-3
"""Learning rate of every parameter [its unit; thousands of pixels for the principal point] (M5)."""
_DECAY = (0.9, 0.999)
_SMALL = 1e-8


def descend(camera: MovingCamera, problem: Problem, iterations: int) -> Solution:
    """Return the camera after some iterations of Adam (Kingma and Ba) at a rate of 1e-3.

    Parameters are those of the solver: rotations in radians, logarithms of focal lengths,
    distortion, metres. The principal point is in units of 1,000 px.

    Args:
        camera: the start.
        problem: evidence, smoothness and priors.
        iterations: number of iterations.
    """
    frames = len(camera) * FRAME_SIZE
    beside = np.zeros((len(problem.painted), 3))
    size = frames + CLIP_SIZE + beside.size
    unit = np.ones(size)
    unit[frames + 3 : frames + CLIP_SIZE] = 1e3
    mean, square = np.zeros(size), np.zeros(size)
    here = equations_at(camera, beside, problem)
    costs = [here.cost]
    for iteration in range(1, iterations + 1):
        gradient = unit * np.concatenate([here.right.ravel(), here.right_corner])
        mean = _DECAY[0] * mean + (1.0 - _DECAY[0]) * gradient
        square = _DECAY[1] * square + (1.0 - _DECAY[1]) * gradient**2
        first = mean / (1.0 - _DECAY[0] ** iteration)
        second = square / (1.0 - _DECAY[1] ** iteration)
        step = -RATE * unit * first / (np.sqrt(second) + _SMALL)
        shared = step[frames:]
        camera = camera.stepped(step[:frames].reshape(-1, FRAME_SIZE), shared[:CLIP_SIZE])
        beside = beside + shared[CLIP_SIZE:].reshape(beside.shape)
        here = equations_at(camera, beside, problem)
        costs.append(here.cost)
    return Solution(camera, beside, here.cost, tuple(costs), here)
