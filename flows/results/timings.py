"""Timing of a run: by stage, and between its units."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass
from typing import Self

from data_contracts.run import ResultManifest
from flows.method import METHOD
from worldpose.store.store import Run, Store


@dataclass(frozen=True)
class StageTime:
    """Timing of one stage of a run, and the number of units that it computed [s]."""

    stage: str
    units: int
    work: float
    """Sum over its units, on all workers."""
    longest: float
    """Of one unit."""
    elapsed: float
    """With at least one running unit."""


@dataclass(frozen=True)
class Cost:
    """Processor time and storage of a run's results.

    Each unit computes on one core.
    """

    core_hours: float
    bytes: int

    @classmethod
    def of(cls, manifests: Iterable[ResultManifest]) -> Self:
        """Return the sum over results."""
        seconds, size = 0.0, 0
        for manifest in manifests:
            seconds += manifest.seconds
            size += sum(file.size for file in manifest.files)
        return cls(seconds / 3600.0, size)

    def __str__(self) -> str:
        """Return both for people."""
        return f"{self.core_hours:.3g} core hours, {in_bytes(self.bytes)}"


def in_bytes(size: float) -> str:
    """Format a size [byte] in at most 7 characters."""
    for unit in ("B", "kB", "MB", "GB"):
        if size < 999.5:
            return f"{size:.3g} {unit}"
        size /= 1000.0
    return f"{size:.3g} TB"


@dataclass(frozen=True)
class RunTime:
    """Timing of a run.

    Attributes:
        seconds: time from its start to its record [s].
        start: until its first unit ran: planning, and the start of workers [s].
        between: after that, time without a running unit: planning, submitting, recording [s].
        cost: cost of all results of the run, also of those that earlier runs computed.
    """

    run_id: str
    seconds: float
    stages: tuple[StageTime, ...]
    start: float
    between: float
    cost: Cost


def run_time(store: Store, match_id: str, run_id: str) -> RunTime:
    """Return the timing of a run from the manifests of its computed results.

    A unit's time starts when its task opens its inputs. The start of Prefect precedes a run's
    start. The run is a number, a name or `latest`.
    """
    record = store.run(match_id, run_id)
    run = Run(store, record)
    manifests = {name: run.manifest(name) for name in record.results}
    spans: dict[str, list[tuple[float, float]]] = {}
    for name in record.executed:
        end = manifests[name].created_at.timestamp()
        span = end - manifests[name].seconds, end
        spans.setdefault(name.partition("/")[0], []).append(span)
    stages = []
    for name in (stage.name for stage in METHOD if stage.name in spans):
        own = [end - begin for begin, end in spans[name]]
        elapsed = _covered_length(spans[name])
        stages.append(StageTime(name, len(own), sum(own), max(own), elapsed))
    all_spans = [span for each in spans.values() for span in each]
    begun = record.started_at.timestamp()
    start = max(0.0, min((begin for begin, _ in all_spans), default=begun) - begun)
    between = max(0.0, record.seconds - start - _covered_length(all_spans))
    cost = Cost.of(manifests.values())
    return RunTime(record.run_id, record.seconds, tuple(stages), start, between, cost)


def _covered_length(spans: Iterable[tuple[float, float]]) -> float:
    """Return the length of the union of intervals."""
    total, reached = 0.0, float("-inf")
    for begin, end in sorted(spans):
        total += max(0.0, end - max(begin, reached))
        reached = max(reached, end)
    return total
