"""Names of metrics, and reasons of gates, as people read them; the journal keeps them as they are.

The pages have the same rules in `infra/review_pages/src/words.js`.
"""

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
_WORDS: Final[Mapping[str, str]] = {"clicks_wrong": "outlier clicks"}
"""Metrics whose names alone mislead."""
_BEYOND: Final = re.compile(
    r"(?P<name>\w+) is (?P<value>\S+?)(?P<parts> \(.*\))?, at most (?P<limit>\S+) passes"
)
_UNKNOWN: Final = re.compile(r"(?P<name>\w+) could not be computed")


def metric_words(name: str) -> tuple[str, str]:
    """Return a metric's name in words, and its unit; `offset_rms_m` is `offset rms` in `m`."""
    if name in _WORDS:
        return _WORDS[name], ""
    rest, _, last = name.rpartition("_")
    unit = UNITS.get(last, "") if rest else ""
    return (rest if unit else name).replace("_", " "), unit


def reason_words(reason: str) -> str:
    """Return a gate's reason in words.

    `offset_rms_m is 0.05, at most 0.03 passes` becomes `offset rms: 0.05 m, limit 0.03 m`; a reason
    that a person or a method wrote stays.
    """
    found = _BEYOND.fullmatch(reason)
    if found is None:
        unknown = _UNKNOWN.fullmatch(reason)
        if unknown is None:
            return reason
        return f"{metric_words(unknown['name'])[0]} could not be computed"
    name, unit = metric_words(found["name"])
    behind = f" {unit}" if unit else ""
    parts = found["parts"] or ""
    return f"{name}: {found['value']}{behind}{parts}, limit {found['limit']}{behind}"


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
