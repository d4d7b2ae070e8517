"""`worldpose evaluate --ablation`: our results next to the paper's table."""

from __future__ import annotations

from dataclasses import fields
from typing import TYPE_CHECKING

import numpy as np

from flows.cli.console import errors, line, print_json, print_table

if TYPE_CHECKING:
    from flows.results.ablation import Score


def print_ablation(seeds: int, *, as_json: bool) -> None:
    """Simulate trials and print every row's mean and standard deviation over them.

    Args:
        seeds: number of trials, with seeds from 0.
        as_json: print every trial's metrics instead of a table.
    """
    from flows.results.ablation import PAPER, TRIANGULATIONS, Score, ablation

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
    columns = ("", ">G-MPJPE", ">PA-MPJPE", ">ground m", ">clicks px", ">paper G / PA")
    for clicks, found in trials.items():
        for how in TRIANGULATIONS:
            names = [row.removesuffix(how) for row in found[0] if _is_of(row, how)]
            names += [row for row in PAPER if row not in names]
            rows = [
                _row(name, [t[name + how] for t in found if name + how in t], PAPER.get(name))
                for name in names
            ]
            print_table(f"{clicks}{how}: {seeds} trials, mm, mean ± spread", columns, rows)


def _is_of(row: str, how: str) -> bool:
    """Return whether a row is triangulated this way; the first way has no name."""
    from flows.results.ablation import TRIANGULATIONS

    return max((end for end in TRIANGULATIONS if row.endswith(end)), key=len) == how


def _row(
    name: str, scores: list[Score], paper: tuple[float, float] | None
) -> tuple[str, str, str, str, str, str]:
    def values(figure: str) -> list[float]:
        return [getattr(score, figure) for score in scores]

    def mean(figure: str, digits: int) -> str:
        return f"{np.mean(values(figure)):.{digits}f}" if scores else "-"

    def told(figure: str, digits: int) -> str:
        return f"{mean(figure, digits)} ± {np.std(values(figure)):.{digits}f}" if scores else "-"

    return (
        name,
        told("g_mpjpe_mm", 1),
        told("pa_mpjpe_mm", 1),
        mean("ground_error_m", 3),
        mean("marking_error_px", 2),
        "-" if paper is None else f"{paper[0]:.1f} / {paper[1]:.1f}",
    )
