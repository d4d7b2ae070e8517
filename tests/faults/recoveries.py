"""Faults that occurred, and the time until work resumed."""

import statistics
from collections import defaultdict
from dataclasses import dataclass


@dataclass
class Fault:
    """One fault: its kind, its duration, and the time at which work resumed."""

    kind: str
    seconds: float
    lifted: float | None = None
    done: int = 0
    recovered: float | None = None


def by_kind(faults):
    kinds = defaultdict(list)
    for fault in faults:
        kinds[fault.kind].append(fault)
    return {
        kind: {
            "struck": len(each),
            "lasted_seconds": summary_of([fault.seconds for fault in each]),
            "work_went_on_after_seconds": summary_of(
                [fault.recovered for fault in each if fault.recovered is not None]
            ),
        }
        for kind, each in sorted(kinds.items())
    }


def summary_of(values):
    if not values:
        return None
    return {
        "count": len(values),
        "median": round(statistics.median(values), 1),
        "most": round(max(values), 1),
    }


def reason_in(said):
    """The last line that says why, without names and numbers that differ."""
    lines = [line for line in said.splitlines() if line.strip()]
    told = [line for line in lines if "error" in line.lower() or "failed" in line]
    return (told or lines or ["nothing said"])[-1].strip()[:110]
