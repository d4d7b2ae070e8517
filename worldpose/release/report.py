"""One HTML page about a run: what was done, how good it is, and what it looks like."""

from __future__ import annotations

import base64
import hashlib
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from html import escape
from importlib.resources import files
from itertools import count

from data_contracts.evaluation import Evaluation
from data_contracts.run import RunRecord
from worldpose.release.meanings import score_rows, shown_number
from worldpose.release.scene import Scene, scene_html
from worldpose.release.web_pictures import small_enough


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


@dataclass(frozen=True)
class Section:
    """A part of the page that can be jumped to.

    Attributes:
        heading: also in the page's bar.
        blocks: in this order.
        lead: what a reader should know first.
    """

    heading: str
    blocks: tuple[Picture | Table | Scene, ...]
    lead: str = ""


class Failure(str):
    """Text of a table's cell that is shown as a failure."""


def report_page(
    title: str,
    run: RunRecord,
    *,
    seconds: Mapping[str, float],
    scores: Evaluation | None = None,
    sections: Sequence[Section] = (),
    tiles: Sequence[tuple[str, str]] = (),
) -> str:
    """Return a whole HTML page that needs nothing beside itself and asks for nothing outside.

    Args:
        title: heading of the page.
        run: what was run, with the quality figures of its units.
        seconds: how long each unit took when it was computed, by `stage/unit` [s].
        scores: figures against truth, where there is a reference.
        sections: what there is to see; those without blocks are left out.
        tiles: the few figures at the top, each with what it is.
    """
    shown = [section for section in sections if section.blocks]
    if scores is not None:
        rows = tuple(row[1:] for row in score_rows(scores))
        table = Table("", ("score", ">value", "what it says"), rows)
        shown.append(Section("Against the truth", (table,)))
    script = _part("scene.js") if any(map(_has_scene, shown)) else ""
    allowed = base64.b64encode(hashlib.sha256(script.encode()).digest()).decode("ascii")
    policy = "default-src 'none'; img-src data:; style-src 'unsafe-inline'"
    policy += f"; script-src 'sha256-{allowed}'" if script else ""
    numbers = count(1)
    parts = "\n".join(_section(section, next(numbers)) for section in shown)
    links = "".join(
        f'<a href="#part{number}">{escape(section.heading)}</a>'
        for number, section in enumerate(shown, 1)
    )
    marks = "".join(
        f"<div><b>{escape(value)}</b><span>{escape(what)}</span></div>" for value, what in tiles
    )
    return (
        '<!doctype html>\n<html lang="en">\n<head>\n<meta charset="utf-8">\n'
        f'<meta http-equiv="Content-Security-Policy" content="{policy}">\n'
        '<meta name="viewport" content="width=device-width, initial-scale=1">\n'
        f"<title>{escape(title)}</title>\n<style>{_part('report.css')}</style>\n</head>\n<body>\n"
        f"<header><div><h1>{escape(title)}</h1><p>Run {escape(run.run_id)} of match "
        f"{escape(run.match_id)}, {run.started_at:%d %B %Y}: {escape(run.state)}</p>"
        f'<div class="tiles">{marks}</div></div></header>\n'
        f'<nav aria-label="Parts of this page"><div>{links}<a href="#record">Record</a></div>'
        "</nav>\n"
        f"<main>\n{parts}\n{_record(run, seconds)}\n</main>\n"
        + (f"<script>{script}</script>\n" if script else "")
        + "</body>\n</html>\n"
    )


def _part(name: str) -> str:
    """A file that pages are made of."""
    return (files("worldpose.release") / "page" / name).read_text(encoding="utf-8")


def _has_scene(section: Section) -> bool:
    return any(isinstance(block, Scene) for block in section.blocks)


def _section(section: Section, number: int) -> str:
    lead = f'<p class="lead">{escape(section.lead)}</p>\n' if section.lead else ""
    blocks = "\n".join(map(_block, section.blocks))
    return (
        f'<section id="part{number}"><h2>{escape(section.heading)}</h2>\n{lead}{blocks}</section>'
    )


def _block(block: Picture | Table | Scene) -> str:
    if isinstance(block, Scene):
        return scene_html(block)
    if isinstance(block, Picture):
        return _figure(block)
    heading = f"<h3>{escape(block.heading)}</h3>\n" if block.heading else ""
    return heading + _table(block.columns, block.rows)


def _record(run: RunRecord, seconds: Mapping[str, float]) -> str:
    """How it came about, for those who ask: folded."""
    tables = (
        ("What was run", ("", ""), _about(run)),
        ("Settings other than the defaults", ("stage", "setting", "value"), _settings(run)),
        ("Units of work", ("unit", "", ">seconds"), _units(run, seconds)),
        ("Quality figures", ("unit", "figure", ">value"), _figures(run)),
    )
    folded = "\n".join(
        f"<details{' open' if heading == 'What was run' else ''}><summary>{heading}</summary>"
        f"{_table(columns, rows)}</details>"
        for heading, columns, rows in tables
        if rows
    )
    return f'<section id="record"><h2>Record</h2>\n{folded}</section>'


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


def _figure(picture: Picture) -> str:
    kind, content, (width, height) = small_enough(picture.png)
    data = base64.b64encode(content).decode("ascii")
    caption = escape(picture.caption)
    return (
        f'<figure><img alt="{caption}" width="{width}" height="{height}" decoding="async" '
        f'src="data:image/{kind};base64,{data}">'
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
            if isinstance(cell, Failure)
            else f"<td{kind}>{escape(cell)}</td>"
            for kind, cell in zip(kinds, row, strict=True)
        )
        lines.append(f"<tr>{''.join(cells)}</tr>")
    return '<div class="table"><table>\n' + "\n".join(lines) + "\n</table></div>"
