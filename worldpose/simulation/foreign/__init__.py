"""The second simulator: match folders that share no model with the first.

Inputs: a `ForeignScenario`, a seed, and recordings if there are any.
Outputs: a match folder with its ground truth. Nothing here is shared with the first simulator: no
motion, no noise, no camera placement; estimators are measured on it and never tuned on it.
"""

from worldpose.simulation.foreign.matches import (
    FOREIGN_SCENARIOS,
    ForeignScenario,
    ForeignScene,
    simulate_foreign_match,
    simulate_foreign_scene,
)
from worldpose.simulation.foreign.recordings import Recordings, read_recordings

__all__ = [
    "FOREIGN_SCENARIOS",
    "ForeignScenario",
    "ForeignScene",
    "Recordings",
    "read_recordings",
    "simulate_foreign_match",
    "simulate_foreign_scene",
]
