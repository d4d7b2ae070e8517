"""Synthetic: match folders with known truth, from a scenario and a seed.

Inputs: a `Scenario` (people, cameras, detector errors) and a seed.
Outputs: a `Scene` in memory, or a match folder with `reference/`.
"""

from worldpose.synthetic.matches import simulate_match
from worldpose.synthetic.noise import ObservationNoise
from worldpose.synthetic.scenarios import SCENARIOS, CrowdSettings, RigSettings, Scenario
from worldpose.synthetic.scene import Scene, simulate_scene

__all__ = [
    "SCENARIOS",
    "CrowdSettings",
    "ObservationNoise",
    "RigSettings",
    "Scenario",
    "Scene",
    "simulate_match",
    "simulate_scene",
]
