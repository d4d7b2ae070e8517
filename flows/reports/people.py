"""Report sections about people, adjusted cameras and fitted bodies."""

from __future__ import annotations

from collections.abc import Mapping
from typing import TYPE_CHECKING

import numpy as np

from data_contracts.conventions import COCO17, JOINT_GROUPS
from flows.results.best_results import bodies_unit, clip_positions, clip_title, person_kinds
from flows.results.run_cameras import ADJUSTED
from flows.review.metric_words import point_words
from worldpose.formats.tables import people_table
from worldpose.reports.html_page import Table
from worldpose.reports.run_report import format_number, format_scaled
from worldpose.store.store import Run

if TYPE_CHECKING:
    import xarray as xr

MAX_ROWS = 20
"""Maximum number of rows of the outlier lists, worst first."""

_BODIES = {
    "residual_m": ("body from joints mm", 1000.0, 1),
    "reprojection_px": ("body from keypoints px", 1.0, 2),
    "bone_spread_m": ("bones change by mm", 1000.0, 1),
    "skating_m": ("standing feet slide mm per frame", 1000.0, 3),
    "jerk_m_s3": ("jerk m/s³", 1.0, 0),
}
"""Title of each body metric, its display factor, and decimals."""


def people_tables(run: Run, clips: tuple[str, ...], fps: float) -> list[Table]:
    """Tabulate kind, time, distance and top speed of every person, by clip."""
    tables = []
    for clip in clips:
        positions, kinds = clip_positions(run, clip), person_kinds(run, clip)
        named = any(positions.names)
        rows = []
        for person, own in people_table(positions, fps).groupby("person"):
            cells = [str(person), str(own["name"].iloc[0])] if named else [str(person)]
            cells += [kinds[int(str(person))], f"{len(own) / fps:.1f}"]
            cells += [f"{own['distance_m'].iloc[-1]:.1f}", _number(float(own["speed_m_s"].max()))]
            rows.append(tuple(cells))
        columns = (">person", *(("name",) if named else ()), "kind", ">seconds")
        tables.append(
            Table(clip_title(clip), (*columns, ">distance m", ">top speed m/s"), tuple(rows))
        )
    return tables


def adjustment_tables(run: Run) -> list[Table]:
    """Tabulate clicks and people by camera, and the outliers after adjustment."""
    if ADJUSTED not in run:
        return []
    result = run[ADJUSTED]
    names = [str(name) for name in result["camera"].values]
    rows = []
    for c, name in enumerate(names):
        marking, people = result["marking_error"].values[c], result["held_out_error"].values[c]
        judges = str(int(result["judges"].values[c]))
        said = (str(result.attrs[each][c]) for each in ("reasons", "weak"))
        rows.append((name, *said, *map(_number, (*marking, *people)), judges))
    cameras = Table(
        "Clicked markings and held-out people, before and after the adjustment",
        (
            *("camera", "change", "least certain direction", ">markings before px", ">after px"),
            *(">people before px", ">after px", ">held-out keypoints"),
        ),
        tuple(rows),
    )
    return [table for table in (cameras, _clicks(result, names), _people(result, names)) if table]


def _clicks(result: xr.Dataset, names: list[str]) -> Table | None:
    rows = [
        (
            names[int(result["click_camera"].values[k])],
            point_words(str(result["click"].values[k])),
            _number(float(np.linalg.norm(result["click_residual"].values[k]))),
            _number(float(result["click_surprise"].values[k])),
            str(result.attrs["click_problem"][k]),
        )
        for k in np.flatnonzero(result["click_wrong"].values)[:MAX_ROWS]
    ]
    if not rows:
        return None
    columns = ("camera", "marking", ">off px", ">standard deviations", "")
    return Table("Clicks to look at: proposed for removal", columns, tuple(rows))


def _people(result: xr.Dataset, names: list[str]) -> Table | None:
    count = int(result.attrs["outliers_found"])
    frame, camera, person, joint, surprise = (
        result[f"outlier_{name}"].values[:MAX_ROWS]
        for name in ("frame", "camera", "person", "joint", "surprise")
    )
    if not len(frame):
        return None
    rows = tuple(
        (
            str(int(frame[k])),
            names[int(camera[k])],
            str(int(person[k])),
            "most of the person" if joint[k] < 0 else COCO17[int(joint[k])].replace("_", " "),
            _number(float(surprise[k])),
        )
        for k in range(len(frame))
    )
    columns = (">frame", "camera", ">person", "joint", ">standard deviations")
    return Table(f"Keypoints that disagree: the worst {len(rows)} of {count:,}", columns, rows)


def body_tables(run: Run, clips: tuple[str, ...]) -> list[Table]:
    """Tabulate the metrics of every fitted person, by clip."""
    tables = []
    for clip in clips:
        unit = bodies_unit(run, clip)
        if unit not in run:
            continue
        figures = run.record.figures.get(unit, {})
        columns = [
            name for name in _BODIES if any(key.startswith(f"{name}.person") for key in figures)
        ]
        rows = tuple(
            (
                str(person),
                *(
                    format_scaled(figures.get(f"{name}.person{person}"), *_BODIES[name][1:])
                    for name in columns
                ),
            )
            for person in run[unit]["person"].values.tolist()
        )
        titles = (f">{_BODIES[name][0]}" for name in columns)
        tables += [Table(clip_title(clip), (">person", *titles), rows)] if rows else []
        tables += _held_out_tables(clip, run.record.figures.get(f"body_fitting/{clip}", {}))
        without = run[unit].attrs.get("without_body") or {}
        if without:
            heading = f"{clip_title(clip)}: people with a place on the ground and no body"
            tables.append(Table(heading, (">person", "reason"), tuple(without.items())))
    return tables


def _held_out_tables(clip: str, figures: Mapping[str, float]) -> list[Table]:
    """Tabulate fitted against triangulated joints in held-out cameras, if these were compared."""
    names = ("fitted", "triangulated", "excess", "excess_error", "certain_excess")
    rows = []
    for group in JOINT_GROUPS:
        values = [figures.get(f"held_out_{name}_m.{group}") for name in names]
        if None in values:
            continue
        fitted, triangulated, excess, error, certain = (1e3 * (value or 0.0) for value in values)
        rows.append(
            (
                group,
                *(f"{value:.1f}" for value in (fitted, triangulated, excess, error)),
                f"at least {certain:.0f} mm more error" if certain > 0.0 else "",
            )
        )
    if not rows:
        return []
    columns = (
        *("joints", ">bodies mm", ">triangulated mm"),
        *(">difference mm", ">standard error mm", "bodies are worse"),
    )
    heading = f"{clip_title(clip)}: distance to the keypoints of cameras that were held out"
    return [Table(heading, columns, tuple(rows))]


def _number(value: float) -> str:
    return format_number(value) if np.isfinite(value) else "-"
