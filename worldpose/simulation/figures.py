"""Figures of the simulation: open bodies of random height and build."""

from __future__ import annotations

import functools
from dataclasses import dataclass
from typing import Final

import numpy as np

from data_contracts.arrays import Floats
from data_contracts.conventions import COCO17
from worldpose.body import BodyModel, load_open_body
from worldpose.body.skeletons import VERTEX_OF_POINT

BUILD: Final = (-1.0, 0.5)
"""Mean and standard deviation of the second beta [1]: wide shoulders, narrow hips, little fat."""


@dataclass(frozen=True, eq=False)
class Figure:
    """One person's body before it is posed, in the open body's own frame: y up, facing z."""

    model: BodyModel
    betas: Floats
    """(10,)"""
    height: float
    """Sole to crown [m]."""
    joints: Floats
    """(24, 3) [m], those of the model."""
    head: Floats
    """(5, 3) [m]: nose, eyes and ears."""
    sole: float
    """y of the lowest point [m]."""
    toe: float
    """Length of the toes in front of their joint [m]."""
    heel: float
    """Distance of the heel behind the ankle [m]."""


def draw_figure(height: tuple[float, float], rng: np.random.Generator) -> Figure:
    """Return a person of random height [m] within bounds and of random build.

    Proportions are the open body's: all betas but the first are random, the first sets the height.
    Apart from their build, players vary as the people behind the open body do.
    """
    model, points, directions = _measured()
    betas = np.zeros(model.shapes)
    tall = rng.uniform(*height)
    betas[1:] = rng.standard_normal(model.shapes - 1)
    betas[1] = BUILD[0] + BUILD[1] * betas[1]
    rising = directions[-2, 1] - directions[-1, 1]
    middle = points[-2, 1] - points[-1, 1]
    betas[0] = (tall - middle - rising[1:] @ betas[1:]) / rising[0]
    shaped = points + directions @ betas
    joints = model.joint_template + model.joint_directions @ betas
    *head, toe, heel, _, lowest = shaped
    return Figure(
        model=model,
        betas=betas,
        height=tall,
        joints=joints,
        head=np.array(head),
        sole=float(lowest[1]),
        toe=float(toe[2] - joints[10, 2]),
        heel=float(joints[7, 2] - heel[2]),
    )


@functools.cache
def _measured() -> tuple[BodyModel, Floats, Floats]:
    """Return the open body; head, big toe, heel, crown and sole (9, 3) [m], and these by betas."""
    model = load_open_body()
    named = [VERTEX_OF_POINT[name] for name in (*COCO17[:5], "left_big_toe", "left_heel")]
    upright = model.template[:, 1]
    vertices = [*named, int(upright.argmax()), int(upright.argmin())]
    return model, model.template[vertices], model.shape_directions[vertices]
