"""Where the time of a run went: stage by stage, and between its units."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass

from flows.method import METHOD
from worldpose.store import Store


@dataclass(frozen=True)
class StageTime:
    """What a stage of a run took.

    Attributes:
        stage: its name.
        units: how many the run computed.
        work: of all its units together, on whatever worker [s].
        longest: of one unit [s].
        elapsed: while any of its units was at work [s].
    """

    stage: str
    units: int
    work: float
    longest: float
    elapsed: float


@dataclass(frozen=True)
class RunTime:
    """What a run took.

    Attributes:
        run_id: its number.
        seconds: from its begin to its record [s].
        stages: in the method's order, those of which it computed something.
        start: until its first unit was at work: planning, and the start of workers [s].
        between: from then on, while none was: planning, handing out, recording [s].
    """

    run_id: str
    seconds: float
    stages: tuple[StageTime, ...]
    start: float
    between: float


def run_time(store: Store, match_id: str, run_id: str) -> RunTime:
    """Where a run's time went, as the manifests of what it computed tell.

    A unit's time begins when its task opens its inputs. The start of Prefect comes before a run's
    begin.

    Args:
        store: the project.
        match_id: the match.
        run_id: a number or name, or `latest`.
    """
    record = store.run(match_id, run_id)
    spans: dict[str, list[tuple[float, float]]] = {}
    for name in record.executed:
        stage, _, unit = name.partition("/")
        manifest = store.manifest(match_id, stage, unit, record.results[name])
        end = manifest.created_at.timestamp()
        spans.setdefault(stage, []).append((end - manifest.seconds, end))
    stages = tuple(
        StageTime(
            stage.name,
            len(spans[stage.name]),
            sum(end - begin for begin, end in spans[stage.name]),
            max(end - begin for begin, end in spans[stage.name]),
            _covered(spans[stage.name]),
        )
        for stage in METHOD
        if stage.name in spans
    )
    all_spans = [span for each in spans.values() for span in each]
    begun = record.started_at.timestamp()
    start = max(0.0, min((begin for begin, _ in all_spans), default=begun) - begun)
    between = max(0.0, record.seconds - start - _covered(all_spans))
    return RunTime(record.run_id, record.seconds, stages, start, between)


def _covered(spans: Iterable[tuple[float, float]]) -> float:
    """Length of the union of spans."""
    total, reached = 0.0, float("-inf")
    for begin, end in sorted(spans):
        total += max(0.0, end - max(begin, reached))
        reached = max(reached, end)
    return total
