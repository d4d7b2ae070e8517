"""Whether the clicks of a run are as far off as the settings state."""

from __future__ import annotations

from collections.abc import Mapping
from math import sqrt
from typing import Final

FREEDOM: Final = 10.0
"""Degrees of freedom of all cameras from which on people are told [1]."""
WORTH: Final = 1.25
"""Factor on the stated noise from which on people are told [1]."""
SURE: Final = 4.0
"""How many standard errors it must be above the stated one."""


def click_advice(figures: Mapping[str, Mapping[str, float]], stated: float) -> list[str]:
    """What people are told where clicks are clearly farther off than stated.

    The clicks of all cameras are pooled: a camera with few of them hardly tells its own noise.

    Args:
        figures: of a run, by unit and name.
        stated: `static_calibration.click_noise` of that run [px].
    """
    told = [
        (each["click_noise_px"], each["click_freedom"])
        for name, each in figures.items()
        if name.startswith("static_calibration/") and "click_noise_px" in each
    ]
    freedom = sum(worth for _, worth in told)
    if freedom < FREEDOM:
        return []
    noise = sqrt(sum(worth * own**2 for own, worth in told) / freedom)
    error = noise / sqrt(2.0 * freedom)
    if noise < max(WORTH * stated, stated + SURE * error):
        return []
    return [
        f"the clicks of {len(told)} cameras are {noise:.1f} px off (standard error {error:.1f} "
        f"px), stated are {stated:g} px: cameras with few clicks state too little uncertainty; run "
        f"with --set static_calibration.click_noise={noise:.2g}"
    ]
