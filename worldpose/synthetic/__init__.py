"""Synthetic: match folders with known truth, from a scenario and a seed.

Inputs: a `Scenario` (people, cameras, detector errors) and a seed.
Outputs: a `Scene` in memory, a match folder with `reference/`, or images of it.
"""

from worldpose.synthetic.looks import RenderingSettings
from worldpose.synthetic.matches import simulate_match
from worldpose.synthetic.noise import ObservationNoise
from worldpose.synthetic.scenarios import SCENARIOS
from worldpose.synthetic.scene import Identities, Scene, StaticViews, simulate_scene
from worldpose.synthetic.settings import (
    BroadcastSettings,
    CalibrationErrors,
    CrowdSettings,
    RigSettings,
    Scenario,
    Seat,
)
from worldpose.synthetic.trajectories import read_trajectories

__all__ = [
    "SCENARIOS",
    "BroadcastSettings",
    "CalibrationErrors",
    "CrowdSettings",
    "Identities",
    "ObservationNoise",
    "RenderingSettings",
    "RigSettings",
    "Scenario",
    "Scene",
    "Seat",
    "StaticViews",
    "read_trajectories",
    "simulate_match",
    "simulate_scene",
]
