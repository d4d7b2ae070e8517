"""`worldpose evaluate --ablation`: the paper's table, ours beside it."""

from __future__ import annotations

from dataclasses import fields
from typing import TYPE_CHECKING

import numpy as np

from flows.cli.console import errors, line, print_json, print_table

if TYPE_CHECKING:
    from flows.ablation import Score


def print_ablation(seeds: int, *, as_json: bool) -> None:
    """Simulates trials and prints every row's mean and spread over them.

    Args:
        seeds: how many, from 0.
        as_json: every trial's figures instead of a table.
    """
    from flows.ablation import PAPER, Score, ablation

    trials = ablation(
        range(seeds), lambda clicks, seed: line(f"{clicks}: trial {seed} done", to=errors)
    )
    names = [field.name for field in fields(Score)]
    if as_json:
        print_json(
            {
                clicks: {
                    row: {name: [getattr(trial[row], name) for trial in found] for name in names}
                    for row in found[0]
                }
                for clicks, found in trials.items()
            }
        )
        return
    columns = ("", ">G-MPJPE mm", ">PA-MPJPE mm", ">ground m", ">clicks px", ">changed", ">paper")
    for clicks, found in trials.items():
        rows = [_row(row, [trial[row] for trial in found], PAPER.get(row)) for row in found[0]]
        rows += [_row(row, [], paper) for row, paper in PAPER.items() if row not in found[0]]
        print_table(f"{clicks}, {seeds} trials, mean and spread", columns, rows)


def _row(
    name: str, scores: list[Score], paper: tuple[float, float] | None
) -> tuple[str, str, str, str, str, str, str]:
    def told(figure: str, digits: int) -> str:
        values = np.array([getattr(score, figure) for score in scores])
        if not len(values):
            return "-"
        return f"{values.mean():.{digits}f} ± {values.std():.{digits}f}"

    return (
        name,
        told("g_mpjpe_mm", 1),
        told("pa_mpjpe_mm", 1),
        told("ground_error_m", 3),
        told("marking_error_px", 2),
        f"{np.mean([score.changed for score in scores]):.0%}" if scores else "-",
        "-" if paper is None else f"{paper[0]:.1f} / {paper[1]:.1f}",
    )
