"""Body measures of people, from the open body."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from data_contracts.arrays import Floats
from worldpose.simulation.figures import Figure, draw_figure


@dataclass(frozen=True, eq=False)
class Body:
    """A person's constant measures [m]."""

    figure: Figure
    """Source of the measures."""
    height: float
    thigh: float
    shank: float
    ankle_height: float
    """Height of the ankle above the sole."""
    hip_half_width: float
    trunk: float
    """Mid-hip to mid-shoulder."""
    shoulder_half_width: float
    upper_arm: float
    forearm: float
    head: Floats
    """(5, 3): nose, eyes and ears forward, left and up from the mid-shoulder."""

    @property
    def leg(self) -> float:
        """Return the length from hip to ankle when stretched [m]."""
        return self.thigh + self.shank


def draw_body(height: tuple[float, float], rng: np.random.Generator) -> Body:
    """Return a person of random height [m] and build, with the open body's proportions."""
    figure = draw_figure(height, rng)
    joints = figure.joints
    hips, shoulders = joints[1:3].mean(axis=0), joints[16:18].mean(axis=0)

    def length(a: int, b: int) -> float:
        return float(np.linalg.norm(joints[a] - joints[b]))

    return Body(
        figure=figure,
        height=figure.height,
        thigh=length(1, 4),
        shank=length(4, 7),
        ankle_height=float(joints[7, 1]) - figure.sole,
        hip_half_width=0.5 * length(1, 2),
        trunk=float(np.linalg.norm(shoulders - hips)),
        shoulder_half_width=0.5 * length(16, 17),
        upper_arm=length(16, 18),
        forearm=length(18, 20),
        # The model faces z with y up and its left along x.
        head=(figure.head - shoulders)[:, (2, 0, 1)],
    )
