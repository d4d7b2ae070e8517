"""HTML page about a run: units, quality metrics, scores and plots."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

from data_contracts.evaluation import Evaluation
from data_contracts.run import RunRecord
from worldpose.reports.html_page import Failure, Folded, Section, Table, whole_page
from worldpose.reports.score_names import score_rows, shown_number


@dataclass(frozen=True)
class CameraSummary:
    """Accuracy of one static camera.

    Attributes:
        camera_id: the camera.
        origin: `given`, or the evidence of its calibration.
        ground_error_median_m: expected ground error, median over the visible pitch [m].
        ground_error_p95_m: the same, 95th percentile [m].
        reprojection_rms_px: of the inlying clicks [px].
        clicks_used: number of inlying clicks.
        clicks_wrong: names of outliers among the clicks.
        weak: why a person should review it; empty without warnings.
    """

    camera_id: str
    origin: str
    ground_error_median_m: float | None = None
    ground_error_p95_m: float | None = None
    reprojection_rms_px: float | None = None
    clicks_used: int | None = None
    clicks_wrong: tuple[str, ...] = ()
    weak: tuple[str, ...] = ()


def report_page(
    title: str,
    run: RunRecord,
    *,
    seconds: Mapping[str, float],
    scores: Evaluation | None = None,
    sections: Sequence[Section] = (),
    tiles: Sequence[tuple[str, str]] = (),
) -> str:
    """Return a self-contained HTML page without external resources.

    Args:
        title: heading of the page.
        run: record of the run, with the quality metrics of its units.
        seconds: computation time of each unit, by `stage/unit` [s].
        scores: metrics against the truth, if there is a reference.
        sections: sections of the page; those without blocks are left out.
        tiles: key metrics at the top, each with its label.
    """
    shown = list(sections)
    if run.warnings:
        table = Table("", ("",), tuple((Failure(text),) for text in run.warnings))
        shown.insert(0, Section("Warnings", (table,)))
    if scores is not None:
        rows = tuple(row[1:] for row in score_rows(scores))
        table = Table("", ("score", ">value", "what it says"), rows)
        shown.append(Section("Against the truth", (table,)))
    return whole_page(
        title,
        f"Run {run.run_id} of match {run.match_id}, {run.started_at:%d %B %Y}: {run.state}",
        shown,
        tiles=tiles,
        last=Folded("Record", _record(run, seconds)),
    )


def _record(run: RunRecord, seconds: Mapping[str, float]) -> tuple[Table, ...]:
    """Return tables of the run, its settings, units and quality metrics."""
    settings = ("stage", "setting", "value")
    return (
        Table("What was run", ("", ""), tuple(_about(run))),
        Table("Settings other than the defaults", settings, tuple(_settings(run))),
        Table("Units of work", ("unit", "", ">seconds"), tuple(_units(run, seconds))),
        Table("Quality figures", ("unit", "figure", ">value"), tuple(_figures(run))),
    )


def camera_table(cameras: Sequence[CameraSummary]) -> Table:
    """Return a table of static cameras."""
    columns = (
        "camera",
        "from",
        ">expected ground error mm",
        ">95 % mm",
        ">clicks rms px",
        ">clicks",
        "wrong clicks",
        "weak because",
    )
    rows = tuple(
        (
            camera.camera_id,
            camera.origin,
            _or_dash(camera.ground_error_median_m, 1000.0, 1),
            _or_dash(camera.ground_error_p95_m, 1000.0, 1),
            _or_dash(camera.reprojection_rms_px, 1.0, 2),
            _or_dash(camera.clicks_used, 1.0, 0),
            ", ".join(camera.clicks_wrong),
            Failure("; ".join(camera.weak)),
        )
        for camera in cameras
    )
    return Table("", columns, rows)


def _or_dash(value: float | None, scale: float, decimals: int) -> str:
    return "-" if value is None else f"{scale * value:,.{decimals}f}"


def _about(run: RunRecord) -> list[tuple[str, ...]]:
    return [
        ("started", f"{run.started_at:%Y-%m-%d %H:%M:%S %Z}".strip()),
        ("took", f"{run.seconds:.1f} s"),
        ("run before it", run.parent or "none"),
        (
            "units computed, reused, failed",
            f"{len(run.executed)}, {len(run.reused)}, {len(run.failed)}",
        ),
        *((f"version of {name}", version) for name, version in run.versions.items()),
    ]


def _units(run: RunRecord, seconds: Mapping[str, float]) -> list[tuple[str, ...]]:
    failed = {failure.unit: Failure(f"failed: {failure.message}") for failure in run.failed}
    states = {
        **dict.fromkeys(run.executed, "computed"),
        **dict.fromkeys(run.reused, "reused"),
        **failed,
    }
    units = [unit for unit in (*run.results, *failed) if unit in states]
    return [
        (unit, states[unit], f"{seconds[unit]:.2f}" if unit in seconds else "") for unit in units
    ]


def _figures(run: RunRecord) -> list[tuple[str, ...]]:
    return [
        (unit if number == 0 else "", name, shown_number(value))
        for unit, figures in run.figures.items()
        for number, (name, value) in enumerate(figures.items())
    ]


def _settings(run: RunRecord) -> list[tuple[str, ...]]:
    return [
        (stage, name, f"{value}")
        for stage, values in run.overrides.items()
        for name, value in values.items()
    ]
