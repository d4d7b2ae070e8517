"""One HTML page about a run: what was done, how good it is, and what it looks like."""

from __future__ import annotations

import base64
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from html import escape
from typing import Final

from data_contracts.evaluation import Evaluation
from data_contracts.run import RunRecord
from worldpose.release.meanings import score_rows, shown_number

_STYLE: Final = """
:root { color-scheme: light; }
body { font: 16px/1.5 system-ui, "Segoe UI", "DejaVu Sans", sans-serif; color: #222;
  background: #fff; max-width: 68rem; margin: 2.5rem auto; padding: 0 1.5rem; }
h1 { font-size: 1.9rem; line-height: 1.2; margin: 0 0 .3rem; }
h2 { font-size: 1.25rem; margin: 2.6rem 0 .6rem; }
p.lead { color: #555; margin: 0 0 1.2rem; }
div.table { overflow-x: auto; }
table { border-collapse: collapse; width: 100%; font-size: .93rem; }
th, td { text-align: left; padding: .38rem .8rem .38rem 0; border-bottom: 1px solid #e4e4e4;
  vertical-align: top; overflow-wrap: break-word; }
th { color: #555; font-weight: 600; border-bottom: 2px solid #c8c8c8; }
td.number, th.number { text-align: right; font-variant-numeric: tabular-nums; }
td.number { white-space: nowrap; }
td.bad { color: #a33b00; font-weight: 600; }
figure { margin: 1.4rem 0 2rem; }
figure img { width: 100%; height: auto; border: 1px solid #e4e4e4; }
figcaption { color: #555; font-size: .93rem; margin-top: .3rem; }
@media (max-width: 40rem) {
  body { margin: 1.2rem auto; padding: 0 .9rem; }
  h1 { font-size: 1.5rem; overflow-wrap: anywhere; }
  table { font-size: .86rem; }
  td:not(.number) { min-width: 4.5rem; }
  td:last-child:not(.number) { min-width: 10rem; }
}
"""


@dataclass(frozen=True)
class Picture:
    """A PNG and what it shows."""

    caption: str
    png: bytes


@dataclass(frozen=True)
class CameraSummary:
    """What is known of one static camera.

    Attributes:
        camera_id: the camera.
        origin: `given`, or what it was calibrated from.
        ground_error_median_m: expected on the pitch, over what the camera sees [m].
        ground_error_p95_m: the same; exceeded on a twentieth of it [m].
        reprojection_rms_px: of the clicks that the camera rests on [px].
        clicks_used: number of clicked points that it rests on.
        clicks_wrong: names of those that it does not.
        weak: why a person should look at it; empty where nothing is the matter.
    """

    camera_id: str
    origin: str
    ground_error_median_m: float | None = None
    ground_error_p95_m: float | None = None
    reprojection_rms_px: float | None = None
    clicks_used: int | None = None
    clicks_wrong: tuple[str, ...] = ()
    weak: tuple[str, ...] = ()


@dataclass(frozen=True)
class Table:
    """A table with a heading.

    Attributes:
        heading: what it is about.
        columns: their titles; ">" before one aligns numbers.
        rows: of text.
    """

    heading: str
    columns: tuple[str, ...]
    rows: tuple[tuple[str, ...], ...]


class _Failure(str):
    """Text of a table's cell that is shown as a failure."""


def report_page(
    title: str,
    run: RunRecord,
    *,
    seconds: Mapping[str, float],
    scores: Evaluation | None = None,
    pictures: Sequence[Picture] = (),
    cameras: Sequence[CameraSummary] = (),
    camera_pictures: Sequence[Picture] = (),
    tables: Sequence[Table] = (),
) -> str:
    """Return a whole HTML page that needs nothing beside itself and asks for nothing outside.

    Args:
        title: heading of the page.
        run: what was run, with the quality figures of its units.
        seconds: how long each unit took when it was computed, by `stage/unit` [s].
        scores: figures against truth, where there is a reference.
        pictures: shown in this order.
        cameras: the static cameras, in the order of the match.
        camera_pictures: shown below their table.
        tables: shown below these.
    """
    sections = [
        f"<h1>{escape(title)}</h1>",
        f'<p class="lead">Match {escape(run.match_id)}, run {escape(run.run_id)}: '
        f"{escape(run.state)}</p>",
        *_scores(scores),
        *(_figure(picture) for picture in pictures),
        *_cameras(cameras),
        *(_figure(picture) for picture in camera_pictures),
        *(
            text
            for table in tables
            for text in (
                f"<h2>{escape(table.heading)}</h2>",
                _table(table.columns, table.rows),
            )
        ),
        "<h2>What was run</h2>",
        _table(("", ""), _about(run)),
        "<h2>Units of work</h2>",
        _table(("unit", "", ">seconds"), _units(run, seconds)),
        "<h2>Quality figures</h2>",
        _table(("unit", "figure", ">value"), _figures(run)),
        *_settings(run),
    ]
    body = "\n".join(sections)
    return (
        '<!doctype html>\n<html lang="en">\n<head>\n<meta charset="utf-8">\n'
        '<meta http-equiv="Content-Security-Policy" '
        "content=\"default-src 'none'; img-src data:; style-src 'unsafe-inline'\">\n"
        '<meta name="viewport" content="width=device-width, initial-scale=1">\n'
        f"<title>{escape(title)}</title>\n<style>{_STYLE}</style>\n</head>\n"
        f"<body>\n{body}\n</body>\n</html>\n"
    )


def _scores(scores: Evaluation | None) -> list[str]:
    if scores is None:
        return []
    heading = "<h2>Against the truth</h2>"
    rows = [row[1:] for row in score_rows(scores)]
    return [heading, _table(("score", ">value", "what it says"), rows)]


def _cameras(cameras: Sequence[CameraSummary]) -> list[str]:
    if not cameras:
        return []
    columns = (
        "camera",
        "from",
        ">expected ground error m",
        ">95 % m",
        ">clicks rms px",
        ">clicks",
        "wrong clicks",
        "weak because",
    )
    rows = [
        (
            camera.camera_id,
            camera.origin,
            *_or_dash(camera.ground_error_median_m, camera.ground_error_p95_m),
            *_or_dash(camera.reprojection_rms_px, camera.clicks_used),
            ", ".join(camera.clicks_wrong),
            _Failure("; ".join(camera.weak)),
        )
        for camera in cameras
    ]
    return ["<h2>Static cameras</h2>", _table(columns, rows)]


def _or_dash(*values: float | None) -> list[str]:
    return ["-" if value is None else shown_number(value) for value in values]


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
    failed = {failure.unit: _Failure(f"failed: {failure.message}") for failure in run.failed}
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


def _settings(run: RunRecord) -> list[str]:
    rows = [
        (stage, name, f"{value}")
        for stage, values in run.overrides.items()
        for name, value in values.items()
    ]
    if not rows:
        return []
    return [
        "<h2>Settings other than the defaults</h2>",
        _table(("stage", "setting", "value"), rows),
    ]


def _figure(picture: Picture) -> str:
    data = base64.b64encode(picture.png).decode("ascii")
    caption = escape(picture.caption)
    return (
        f'<figure><img alt="{caption}" src="data:image/png;base64,{data}">'
        f"<figcaption>{caption}</figcaption></figure>"
    )


def _table(columns: Sequence[str], rows: Sequence[Sequence[str]]) -> str:
    """A table of plain text; columns from ">" on hold numbers."""
    kinds = [' class="number"' if column.startswith(">") else "" for column in columns]
    lines = []
    if any(columns):
        cells = (
            f"<th{kind}>{escape(column.removeprefix('>'))}</th>"
            for kind, column in zip(kinds, columns, strict=True)
        )
        lines.append(f"<tr>{''.join(cells)}</tr>")
    for row in rows:
        cells = (
            f'<td class="bad">{escape(cell)}</td>'
            if isinstance(cell, _Failure)
            else f"<td{kind}>{escape(cell)}</td>"
            for kind, cell in zip(kinds, row, strict=True)
        )
        lines.append(f"<tr>{''.join(cells)}</tr>")
    return '<div class="table"><table>\n' + "\n".join(lines) + "\n</table></div>"
