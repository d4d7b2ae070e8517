"""Names of metrics, and reasons of gates, as people read them; the journal keeps the originals."""

from __future__ import annotations

import re
from collections.abc import Iterable, Mapping
from typing import Final

UNITS: Final[Mapping[str, str]] = {
    "m": "m",
    "mm": "mm",
    "px": "px",
    "rad": "rad",
    "deg": "°",
    "s": "s",
    "frames": "frames",
    "hz": "Hz",
}
"""Last part of a metric's name to its unit."""
_WORDS: Final[Mapping[str, str]] = {
    "expected_ground_error_median_m": "expected error on the pitch",
    "expected_ground_error_p95_m": "expected error on the worst part of the pitch",
    "clicks_wrong": "clicks that contradict the others",
    "unreadable_share": "frames without a readable image",
    "empty_share": "images without people",
    "bridged_share": "boxes filled in between two frames",
    "flicker_share": "people seen for moments only",
    "contradictions": "cameras that contradict each other",
    "undecided": "places where two tracks may be one person",
    "unmatched_share": "people found in the images whom no track follows",
    "mean_ray_distance_m": "how far cameras disagree about where a person is",
    "corrections_refused": "corrections that do not fit any more",
    "standard_deviation_m": "uncertainty of the joints",
    "unhealthy_share": "time in which a camera is not healthy",
    "filled_share": "share filled in by motion, which no camera sees",
    "held_out_error_after_m": "error in people that were kept back",
    "held_out_growth": "error in people that were kept back, relative to before",
    "offset_rms_m": "distance of bodies from the seen joints",
    "held_out_certain_excess_m": "bodies are worse than joints by",
    "expected_error_median_px": "expected error of the drawn pitch",
}
"""Metrics of gates as operators say them."""
_FLAGS: Final[Mapping[str, str]] = {
    "weak": "the camera is uncertain: more clicks are needed where none are"
}
"""Metrics that are 0 or 1, and what 1 says."""
_BEYOND: Final = re.compile(
    r"(?P<name>\w+) is (?P<value>\S+?)(?P<parts> \(.*\))?, at most (?P<limit>\S+) passes"
)
_UNKNOWN: Final = re.compile(r"(?P<name>\w+) could not be computed")


def point_words(point: str) -> str:
    """Return a point's name as pages write it; `at_52.50_19.16` is (52.5, 19.2) m."""
    place = re.match(r"at_(-?[\d.]+)_(-?\d+\.\d+)(.*)", point)
    if place is not None:
        x, y = (round(float(each), 1) + 0.0 for each in place.groups()[:2])
        point = f"({x:g}, {y:g}) m{place[3]}"
    return re.sub(r"\.again\w*$", ", once more", point).replace("_", " ")


def metric_words(name: str) -> tuple[str, str]:
    """Return a metric's name in words, and its unit; `offset_rms_m` is `offset rms` in `m`."""
    rest, _, last = name.rpartition("_")
    unit = UNITS.get(last, "") if rest else ""
    return _WORDS.get(name, (rest if unit else name).replace("_", " ")), unit


def quantity(name: str, value: float) -> str:
    """Format the value of a metric with its unit: short lengths in cm, shares in percent."""
    unit = metric_words(name)[1]
    if unit == "m" and abs(value) < 1.0:
        return f"{100.0 * value:.3g} cm"
    if name.endswith("_share"):
        return f"{100.0 * value:.3g} %"
    return f"{value:.4g} {unit}".rstrip()


def reason_words(reason: str) -> str:
    """Return a gate's reason in words.

    `filled_share is 0.1, at most 0.05 passes` becomes `share filled in by motion, which no
    camera sees: 10 %, limit 5 %`; a reason that a person or a method wrote stays.
    """
    found = _BEYOND.fullmatch(reason)
    if found is None:
        unknown = _UNKNOWN.fullmatch(reason)
        if unknown is None:
            return reason
        return f"{metric_words(unknown['name'])[0]} could not be computed"
    name, parts = found["name"], found["parts"] or ""
    if name in _FLAGS:
        return _FLAGS[name]
    value, limit = (quantity(name, float(found[each])) for each in ("value", "limit"))
    return f"{metric_words(name)[0]}: {value}{parts}, limit {limit}"


def all_reasons(reasons: Iterable[str]) -> str:
    """Return reasons of gates in words, on one line."""
    return "; ".join(map(reason_words, reasons))


def in_short(figures: Mapping[str, float]) -> str:
    """Format a unit's metrics on one line, without those of single cameras."""
    words = []
    for key, value in figures.items():
        if "." not in key:
            name, unit = metric_words(key)
            words.append(f"{name} {value:.4g} {unit}".rstrip())
    return ", ".join(words)
