"""Which static cameras a run shows to be out of step, and what match.yaml should say of them."""

from __future__ import annotations

from collections.abc import Mapping
from statistics import median_low
from typing import Final

from data_contracts.match import MatchSpec

STAGES: Final = ("filtering", "retriangulation", "triangulation")
"""Whose figures tell, the best first: adjusted cameras take in much of what their clocks are late,
and filtering alone tells one from the other."""
LATE: Final = "clock_late_frames."
ERROR: Final = "clock_error_frames."
WORTH: Final = 0.5
"""Difference from which on another whole offset is nearer [frame]."""
SURE: Final = 4.0
"""Difference in standard errors from which on people are told."""


def clock_advice(figures: Mapping[str, Mapping[str, float]], spec: MatchSpec) -> list[str]:
    """What people are told of cameras that are out of step, one line a camera.

    Args:
        figures: of a run, by unit and name.
        spec: match.yaml as that run had it.
    """
    said = []
    for camera in spec.static_cameras:
        found = [_difference(figures, clip.id, camera.id) for clip in spec.clips]
        known = [each for each in found if each is not None]
        if not known:
            continue
        late, error = min(known, key=lambda each: each[1])
        offset = round(camera.offset_frames - late)
        if abs(late) > max(WORTH, SURE * error) and offset != camera.offset_frames:
            said.append(
                f"camera {camera.id} shows {abs(late):.1f} frames "
                f"{'later' if late > 0 else 'earlier'} than the others: set its offset_frames to "
                f"{offset} in match.yaml"
            )
    return said


def _difference(
    figures: Mapping[str, Mapping[str, float]], clip: str, camera: str
) -> tuple[float, float] | None:
    """By how much a camera is later than most others, and its standard error [frame].

    Figures are against the mean, which a camera far off has moved: the median stays. Of two cameras
    the earlier one counts as right, so that not both are moved.
    """
    stages = [figures.get(f"{stage}/{clip}", {}) for stage in STAGES]
    for stage in stages:
        late = {name: value for name, value in stage.items() if name.startswith(LATE)}
        error = next((each[ERROR + camera] for each in stages if ERROR + camera in each), None)
        if LATE + camera in late and len(late) > 1 and error is not None:
            return stage[LATE + camera] - median_low(late.values()), error
    return None
