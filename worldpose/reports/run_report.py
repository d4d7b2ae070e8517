"""HTML page about a run: units, quality metrics, scores and plots."""

from __future__ import annotations

from collections.abc import Mapping, Sequence

from data_contracts.evaluation import CameraErrors, Evaluation
from data_contracts.records import Record
from data_contracts.run import RunRecord
from worldpose.reports.html_page import Failure, Folded, Section, Table, whole_page


def score_rows(scores: Evaluation) -> list[tuple[str, str, str, str]]:
    """Return name, label, value with unit, and description of every available metric."""
    figures = scores.model_dump(exclude_none=True)
    groups = figures.pop("cameras", {})
    rows = [(name, *_score_row(Evaluation, name, value)) for name, value in figures.items()]
    for kind, errors in groups.items():
        for name, value in errors.items():
            label, shown, meaning = _score_row(CameraErrors, name, value)
            rows.append(
                (f"cameras.{kind}.{name}", f"{kind.capitalize()} cameras: {label}", shown, meaning)
            )
    return rows


def _score_row(record: type[Record], name: str, value: float) -> tuple[str, str, str]:
    """Return label, value with the unit that ends the description, and description."""
    field = record.model_fields[name]
    words, _, unit = (field.description or "").removesuffix("]").partition(" [")
    is_share = unit == "0..1"
    shown = format_number(100.0 * value if is_share else value)
    return field.title or name, f"{shown} {'%' if is_share else unit}".strip(), words


def format_number(value: float) -> str:
    """Return a number with four digits, without exponent if possible."""
    return f"{value:,.0f}" if float(value).is_integer() or abs(value) >= 1e4 else f"{value:.4g}"


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

    `seconds` is the computation time of each unit, by `stage/unit` [s]; scores are metrics against
    the truth, if there is a reference.
    """
    shown = list(sections)
    usability = run.usability
    if said := dict.fromkeys((*usability.reservations, *run.warnings)):
        heading = usability.verdict.capitalize() if usability.reservations else "Warnings"
        table = Table("", ("",), tuple((Failure(text),) for text in said))
        shown.insert(0, Section(heading, (table,)))
    if scores is not None:
        rows = tuple(row[1:] for row in score_rows(scores))
        table = Table("", ("score", ">value", "what it says"), rows)
        shown.append(Section("Against the truth", (table,)))
    return whole_page(
        title,
        f"Run {run.run_id} of match {run.match_id}, {run.started_at:%d %B %Y}: {run.state}, "
        f"{usability.verdict}",
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
        Table("Quality metrics", ("unit", "metric", ">value"), tuple(_figures(run))),
    )


def format_scaled(value: float | None, scale: float, decimals: int) -> str:
    """Return a number times a factor with some decimals; a dash for none."""
    return "-" if value is None else f"{scale * value:,.{decimals}f}"


def _about(run: RunRecord) -> list[tuple[str, ...]]:
    return [
        ("started", f"{run.started_at:%Y-%m-%d %H:%M:%S %Z}".strip()),
        ("took, after the start of Prefect", f"{run.seconds:.1f} s"),
        ("latest run that had ended before it", run.parent or "none"),
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
        (unit if number == 0 else "", name, format_number(value))
        for unit, figures in run.figures.items()
        for number, (name, value) in enumerate(figures.items())
    ]


def _settings(run: RunRecord) -> list[tuple[str, ...]]:
    return [
        (stage, name, f"{value}")
        for stage, values in run.overrides.items()
        for name, value in values.items()
    ]
