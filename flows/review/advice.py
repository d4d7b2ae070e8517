"""Advice from a run's metrics, on the click noise setting and on clock offsets in match.yaml."""

from __future__ import annotations

from collections.abc import Mapping
from math import sqrt
from statistics import median_low
from typing import Final

from pydantic import JsonValue

from data_contracts.match import MatchSpec
from data_contracts.triangulation import CLOCK_CHANGE
from worldpose.ingest.clock import offset_change
from worldpose.ingest.footage import unit_frames

MIN_FREEDOM: Final = 10.0
"""Minimum degrees of freedom of all cameras for advice [1]."""
MIN_NOISE_RATIO: Final = 1.25
"""Minimum ratio of estimated to stated noise for advice [1]."""
MIN_STANDARD_ERRORS: Final = 4.0
"""Minimum difference from the stated noise in standard errors."""


def click_advice(
    metrics: Mapping[str, Mapping[str, float]], settings: Mapping[str, Mapping[str, JsonValue]]
) -> list[str]:
    """Return advice if the click noise is significantly larger than stated.

    The clicks of all cameras are pooled: a single camera with few clicks cannot determine its
    noise. The metrics are those of a run, by unit and name, and the settings its own, by stage.
    """
    given = settings.get("static_calibration", {}).get("click_noise_px")
    stated = float(given) if isinstance(given, int | float) else 1.0
    told = [
        (each["click_noise_px"], each["click_freedom"])
        for name, each in metrics.items()
        if name.startswith("static_calibration/") and "click_noise_px" in each
    ]
    freedom = sum(worth for _, worth in told)
    if freedom < MIN_FREEDOM:
        return []
    noise = sqrt(sum(worth * own**2 for own, worth in told) / freedom)
    error = noise / sqrt(2.0 * freedom)
    if noise < max(MIN_NOISE_RATIO * stated, stated + MIN_STANDARD_ERRORS * error):
        return []
    return [
        f"the clicks of {len(told)} cameras are {noise:.1f} px off (standard error {error:.1f} "
        f"px), stated are {stated:g} px: cameras with few clicks state too little uncertainty; run "
        f"with --set static_calibration.click_noise_px={noise:.2g}"
    ]


STAGES: Final = ("filtering", "retriangulation", "triangulation")
"""Stages that estimate clock offsets, most accurate first: adjusted cameras absorb much of a
clock offset, and only filtering separates the two."""
LATE: Final = "clock_late_frames."
ERROR: Final = "clock_error_frames."
MIN_OFFSET: Final = 0.5
"""Minimum difference for advice: from here another integer offset is nearer [frame]."""


def clock_advice(metrics: Mapping[str, Mapping[str, float]], spec: MatchSpec) -> list[str]:
    """Return one line of advice per camera with a significant clock offset.

    Metrics, by unit and name, and match.yaml are those of one run.
    """
    said = []
    for camera in spec.static_cameras:
        found = [_difference(metrics, clip.id, camera.id) for clip in spec.clips]
        known = [each for each in found if each is not None]
        if not known or any(CLOCK_CHANGE + camera.id in each for each in metrics.values()):
            continue  # one offset cannot correct a clock that changes
        late, error = min(known, key=lambda each: each[1])
        exact = float(offset_change(late, unit_frames(spec, camera.id).rate))
        change = round(exact)
        is_clear = abs(late) > MIN_STANDARD_ERRORS * error
        if is_clear and abs(exact) > MIN_OFFSET and change:
            offset = camera.offset_frames
            said.append(
                f"camera {camera.id} shows {abs(late):.1f} match frames "
                f"{'later' if late > 0 else 'earlier'} than the others: "
                + (
                    f"add {change} to every offset of its offset_frames in match.yaml"
                    if isinstance(offset, tuple)
                    else f"set its offset_frames to {int(offset) + change} in match.yaml"
                )
            )
    return said


def _difference(
    metrics: Mapping[str, Mapping[str, float]], clip: str, camera: str
) -> tuple[float, float] | None:
    """Return a camera's clock offset relative to the median camera, and its standard error [frame].

    Metrics are relative to the mean, which an outlier camera shifts; the median is robust. Of two
    cameras the earlier one counts as correct, so that only one is corrected.
    """
    stages = [metrics.get(f"{stage}/{clip}", {}) for stage in STAGES]
    for stage in stages:
        late = {name: value for name, value in stage.items() if name.startswith(LATE)}
        error = next((each[ERROR + camera] for each in stages if ERROR + camera in each), None)
        if LATE + camera in late and len(late) > 1 and error is not None:
            return stage[LATE + camera] - median_low(late.values()), error
    return None
