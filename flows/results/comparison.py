"""Comparison of two runs of a match by metrics: cameras, clips and players better or worse.

Only metrics where lower is better are compared, and none that needs ground truth. A metric is
better or worse if it changed by more than 1 % and by more than its minimum relevant change. A
camera, clip or player is better if some of its metrics are better and none is worse, worse in the
opposite case, mixed if both occur, else unchanged.
"""

from __future__ import annotations

import re
from collections import Counter
from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from typing import Final, Literal

from data_contracts.run import RunRecord
from flows.results.best_results import BODY_STAGES
from flows.results.pairing import paired_people
from worldpose.store import Store

Kind = Literal["match", "clip", "camera", "player"]
Mark = Literal["better", "worse", "mixed", "unchanged", "only in A", "only in B"]

KINDS: Final[tuple[Kind, ...]] = ("match", "clip", "camera", "player")
PART: Final = 0.01
"""Minimum relative change of a metric [1]."""
MATTERS: Final[Mapping[str, Mapping[str, float]]] = {
    "static_calibration": {"expected_ground_error_median_m": 1e-3, "clicks_wrong": 0.0},
    "tracking": {"mean_ray_distance_m": 1e-3, "unmatched_share": 1e-3, "undecided": 0.0},
    "bundle_adjustment": {"held_out_error_after_px": 0.01},
    "retriangulation": {"standard_deviation_m": 1e-4, "filled_share": 1e-3, "misplacement_m": 1e-3},
    "bodies": {
        "offset_rms_m": 1e-4,
        "residual_m": 1e-4,
        "reprojection_px": 0.01,
        "skating_m": 1e-4,
    },
    "broadcast_calibration": {"expected_error_median_px": 0.01},
    "filtering": {"held_out_error": 1e-4, "rejected_share": 1e-3},
}
"""Stage, metric, and its minimum relevant change, in its unit; `bodies` are those of the last
fit. A tenth of a millimetre and a hundredth of a pixel are below the resolution of a joint's
standard deviation of 30 mm; shares are of thousands of keypoints."""

Figures = dict[str, float]
Subject = tuple[Kind, str]


@dataclass(frozen=True)
class Change:
    """One metric, as `stage/unit figure`, in two runs."""

    figure: str
    before: float
    after: float
    mark: Mark


@dataclass(frozen=True)
class SubjectChange:
    """Metrics of a camera, clip, player or the match in two runs.

    Attributes:
        kind: kind of the subject.
        name: its id; for a player `clip: person 3`.
        mark: summary over its metrics.
        figures: metrics that both runs have.
    """

    kind: Kind
    name: str
    mark: Mark
    figures: tuple[Change, ...]


def compare_runs(store: Store, a: RunRecord, b: RunRecord) -> list[SubjectChange]:
    """Compare the match, its clips, cameras and players in B with A.

    Players are paired by position, whatever their ids; a player in only one run is marked so.
    """
    before = _subjects(a, {})
    after = _subjects(b, paired_people(store, a, b))
    return [
        _change(subject, before.get(subject), after.get(subject))
        for subject in sorted(before.keys() | after.keys(), key=_order)
    ]


def count_marks(changes: list[SubjectChange], kind: Kind) -> dict[Mark, int]:
    """Return the number of subjects of a kind by mark."""
    return dict(Counter(change.mark for change in changes if change.kind == kind))


def _change(subject: Subject, before: Figures | None, after: Figures | None) -> SubjectChange:
    if before is None or after is None:
        return SubjectChange(*subject, "only in B" if before is None else "only in A", ())
    figures = tuple(
        Change(name, before[name], after[name], _mark(name, before[name], after[name]))
        for name in sorted(before.keys() & after.keys())
    )
    marks = {change.mark for change in figures} - {"unchanged"}
    over_all: Mark = "mixed" if len(marks) > 1 else next(iter(marks), "unchanged")
    return SubjectChange(*subject, over_all, figures)


def _mark(figure: str, before: float, after: float) -> Mark:
    stage = figure.partition("/")[0]
    least = max(PART * abs(before), MATTERS[stage][figure.rpartition(" ")[2]])
    if abs(after - before) <= least:
        return "unchanged"
    return "better" if after < before else "worse"


def _subjects(record: RunRecord, names: Mapping[tuple[str, str], str]) -> dict[Subject, Figures]:
    """Return the metrics of every subject of a run; `names` are players' names in the other run."""
    found: dict[Subject, Figures] = {}
    for unit, figures in _last_of_all(record):
        stage, _, place = unit.partition("/")
        for name, value in figures.items():
            figure, _, part = name.partition(".")
            if figure in MATTERS.get(stage, {}):
                subject = _subject(stage, place, part, names)
                found.setdefault(subject, {})[f"{unit} {figure}"] = value
    return found


def _last_of_all(record: RunRecord) -> Iterator[tuple[str, Mapping[str, float]]]:
    """Yield units with metrics; bodies only from the last fit."""
    for unit, figures in record.figures.items():
        stage, _, clip = unit.partition("/")
        if stage not in BODY_STAGES:
            yield unit, figures
        elif stage == BODY_STAGES[-1] or f"{BODY_STAGES[-1]}/{clip}" not in record.figures:
            yield f"bodies/{clip}", figures


def _subject(stage: str, unit: str, part: str, names: Mapping[tuple[str, str], str]) -> Subject:
    if stage == "static_calibration":
        return "camera", unit
    if stage == "bundle_adjustment":
        return "match", unit
    if not part:
        return "clip", unit
    if stage == "bodies":
        return "player", f"{unit}: {names.get((unit, part), part)}".replace("person", "person ")
    return "camera", part


def _order(subject: Subject) -> tuple[int, list[str | int]]:
    """Return a sort key: kinds in order, names in natural order."""
    kind, name = subject
    parts = re.split(r"(\d+)", name)
    return KINDS.index(kind), [int(part) if part.isdigit() else part for part in parts]
