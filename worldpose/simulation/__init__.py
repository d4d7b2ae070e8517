"""Synthetic: match folders with known truth, from a scenario and a seed.

Inputs: a `Scenario` (people, cameras, detector errors) and a seed.
Outputs: a `Scene` in memory, a match folder with `reference/`, or images of it.
"""

from worldpose.simulation.matches import MatchOptions, simulate_match
from worldpose.simulation.recordings import read_trajectories
from worldpose.simulation.scenarios import SCENARIOS
from worldpose.simulation.scene import Identities, Scene, StaticViews, simulate_scene
from worldpose.simulation.settings import (
    BroadcastSettings,
    CalibrationErrors,
    CrowdSettings,
    ObservationNoise,
    RenderingSettings,
    RigSettings,
    Scenario,
    Seat,
)

__all__ = [
    "SCENARIOS",
    "BroadcastSettings",
    "CalibrationErrors",
    "CrowdSettings",
    "Identities",
    "MatchOptions",
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
