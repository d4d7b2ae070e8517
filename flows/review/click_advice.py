"""Advice on the click noise setting, from the residuals of a run's clicks."""

from __future__ import annotations

from collections.abc import Mapping
from math import sqrt
from typing import Final

FREEDOM: Final = 10.0
"""Minimum degrees of freedom of all cameras for advice [1]."""
WORTH: Final = 1.25
"""Minimum ratio of estimated to stated noise for advice [1]."""
SURE: Final = 4.0
"""Minimum difference from the stated noise in standard errors."""


def click_advice(figures: Mapping[str, Mapping[str, float]], stated: float) -> list[str]:
    """Return advice if the click noise is significantly larger than stated.

    The clicks of all cameras are pooled: a single camera with few clicks cannot determine its
    noise.

    Args:
        figures: metrics of a run, by unit and name.
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
