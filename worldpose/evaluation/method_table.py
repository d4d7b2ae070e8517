"""Table of baseline methods as in the paper: text, CSV and LaTeX (E1, E2, E5)."""

from __future__ import annotations

import csv
import io
from collections.abc import Sequence
from typing import Final

from data_contracts.evaluation import Evaluation, MethodScore

COLUMNS: Final = {
    "g_mpjpe_mm": "G-MPJPE [mm]",
    "pa_mpjpe_mm": "PA-MPJPE [mm]",
    "per_meter_drift_cm_per_m": "Per-Meter Drift [cm/m]",
    "track_coverage": "Coverage [%]",
}
"""Metrics of a row, and their titles. The first three are the paper's."""
PER_PERSON: Final = {
    "g_mpjpe_mm": "per_person_g_mpjpe_mm",
    "per_meter_drift_cm_per_m": "per_person_drift_cm_per_m",
}
"""Metrics of a row with one alignment per person (E2)."""

_LOCAL: Final = ("pa_mpjpe_mm", "pa_mpjpe_rigid_mm", "track_coverage", "persons", "frames")
_ALONE: Final = (
    *_LOCAL,
    "per_person_g_mpjpe_mm",
    "per_person_g_mpjpe_rigid_mm",
    "per_person_drift_cm_per_m",
    "per_person_drift_rigid_cm_per_m",
)
_KEPT: Final = {"camera": _LOCAL, "own": _ALONE}


def select_defined_scores(evaluation: Evaluation, world: str) -> Evaluation:
    """Return the scores that are defined in a method's world.

    Args:
        evaluation: all scores.
        world: `shared`, `own` or `camera`; people relative to a moving camera have no paths, people
            in separate worlds have no common alignment.
    """
    if world not in _KEPT:
        return evaluation
    return Evaluation(**{name: getattr(evaluation, name) for name in _KEPT[world]})


def table_rows(scores: Sequence[MethodScore]) -> list[tuple[str, ...]]:
    """Return the table: a title and the metrics, `N/A` where undefined.

    First local methods, then all others, then these with one alignment per person, as in the paper.
    """
    groups = _groups(scores)
    return [row for group in groups for row in group]


def table_csv(scores: Sequence[MethodScore]) -> str:
    """Return the table as CSV with a header, with empty cells for undefined metrics."""
    out = io.StringIO()
    writer = csv.writer(out, lineterminator="\n")
    writer.writerow(("method", *COLUMNS))
    for row in table_rows(scores):
        writer.writerow("" if cell == _ABSENT else cell for cell in row)
    return out.getvalue()


def table_latex(scores: Sequence[MethodScore]) -> str:
    """Return the table as LaTeX for the package booktabs."""
    arrows = ("$\\downarrow$", "$\\downarrow$", "$\\downarrow$", "$\\uparrow$")
    heads = [f"{title} {arrow}" for title, arrow in zip(COLUMNS.values(), arrows, strict=True)]
    lines = [f"\\begin{{tabular}}{{l{'c' * len(heads)}}}", "  \\toprule"]
    lines.append("  & " + " & ".join(heads).replace("%", "\\%") + " \\\\")
    for group in _groups(scores):
        lines.append("  \\midrule")
        lines += [
            f"  {_escape(row[0])} & {' & '.join(map(_space_thousands, row[1:]))} \\\\"
            for row in group
        ]
    return "\n".join([*lines, "  \\bottomrule", "\\end{tabular}"]) + "\n"


_ABSENT: Final = "N/A"


def _groups(scores: Sequence[MethodScore]) -> list[list[tuple[str, ...]]]:
    local = [_row(score.title, score, {}) for score in scores if score.world == "camera"]
    placed = [score for score in scores if score.world != "camera"]
    whole = [_row(score.title, score, {}) for score in placed]
    alone = [_row(f"{score.title} (per-person)", score, PER_PERSON) for score in placed]
    return [group for group in (local, whole, alone) if group]


def _row(title: str, score: MethodScore, instead: dict[str, str]) -> tuple[str, ...]:
    cells = []
    for name in COLUMNS:
        value = getattr(score.evaluation, instead.get(name, name))
        factor = 100.0 if name == "track_coverage" else 1.0
        cells.append(_ABSENT if value is None else f"{factor * value:.1f}")
    return (title, *cells)


def _space_thousands(cell: str) -> str:
    """Return a number with thin spaces between thousands."""
    return cell if cell == _ABSENT else f"{float(cell):,.1f}".replace(",", "\\,")


def _escape(text: str) -> str:
    return "".join(f"\\{sign}" if sign in "&%_#$" else sign for sign in text)
