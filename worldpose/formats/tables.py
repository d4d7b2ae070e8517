"""Tables: cells of text files, and tables of people as CSV and Parquet.

Tables of people are pandas data frames with one row per observation and the unit in the name of
every column.
"""

from __future__ import annotations

import csv
import json
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from itertools import pairwise
from pathlib import Path
from typing import TYPE_CHECKING, Any, Final

import numpy as np
from numpy.typing import NDArray

from data_contracts.arrays import Floats, find_runs
from data_contracts.conventions import COCO17
from worldpose.errors import InputError, UsageError
from worldpose.formats.files import whole_file
from worldpose.formats.joints_file import JointTracks

if TYPE_CHECKING:
    import pandas as pd

POSITION_COLUMNS: Final = {
    **{"frame": "%d", "time_s": "%.4f", "person": "%d", "name": "%s", "kind": "%s"},
    **{"x_m": "%.3f", "y_m": "%.3f", "x_std_m": "%.3f", "y_std_m": "%.3f"},
    **{"xy_correlation": "%.3f", "speed_m_s": "%.2f", "height_m": "%.2f"},
    "identity_certainty": "%.4f",
}
"""Columns of a file of positions, of those of `people_table`, and the format of their cells."""
SPEED_WINDOW_S: Final = 0.4
"""Time between the two positions that give a speed [s]."""


@dataclass(frozen=True, eq=False)
class Positions:
    """Where the people of a clip are on the pitch.

    Attributes:
        frames: (frames,) match frames.
        person: (persons,) ids.
        names: (persons,) roster id; empty where not known.
        on_plane: (frames, persons), whether the feet alone give the place, or that of a body fitted
            in one camera's image; else it is the mid-hip of triangulated joints.
        xy: (frames, persons, 2) [m], world; NaN where missing.
        covariance: (frames, persons, 2, 2) [m^2].
        height: (persons,) [m]; NaN where not known.
        identity_certainty: (frames, persons) probability of the identity, as in `JointTracks`.
    """

    frames: NDArray[np.integer]
    person: NDArray[np.integer]
    names: Sequence[str]
    on_plane: NDArray[np.bool_]
    xy: Floats
    covariance: Floats
    height: Floats
    identity_certainty: Floats


def format_cells(values: NDArray[Any], form: str) -> NDArray[np.str_]:
    """Return numbers or texts by a format such as `%.3f`; those that are not finite are empty."""
    cells = np.char.mod(form, values)
    if values.dtype.kind == "f":
        cells[~np.isfinite(values)] = ""
    return np.asarray(cells)


def write_rows(
    path: Path,
    head: Sequence[str],
    parts: Sequence[tuple[NDArray[Any], str]],
    separator: str = "\t",
) -> None:
    """Write header lines and a table, whole or not at all.

    Parts (rows,) or (rows, columns) stand side by side, each with the format of its cells.
    """
    cells = [
        format_cells(values[:, None] if values.ndim == 1 else values, form)
        for values, form in parts
    ]
    rows = map(separator.join, np.concatenate(cells, axis=1).tolist())
    with whole_file(path) as draft:
        draft.write_text("\n".join([*head, *rows]) + "\n", encoding="utf-8")


def write_positions(path: Path, positions: Positions, fps: float) -> None:
    """Write a line per person and frame, frame by frame; missing people have none.

    Columns: frame, time_s (frame / fps), person, name, kind in this frame (triangulated or plane),
    x_m and y_m (world), x_std_m, y_std_m and xy_correlation of their covariance (empty where it is
    not known), speed_m_s over `SPEED_WINDOW_S` (empty at a track's ends), height_m of people placed
    by their feet, identity_certainty (the probability that this is still the person of the id).
    """
    table = people_table(positions, fps)
    cells = []
    for name, form in POSITION_COLUMNS.items():
        values = table[name].to_numpy()
        cells.append(format_cells(values.astype(str) if form == "%s" else values, form).tolist())
    with whole_file(path) as draft, draft.open("w", newline="", encoding="utf-8") as file:
        lines = csv.writer(file, lineterminator="\n")
        lines.writerow(POSITION_COLUMNS)
        lines.writerows(zip(*cells, strict=True))


def _speeds(xy: Floats, fps: float) -> Floats:
    """Return speeds (frames, persons) [m/s]; NaN near the ends of a track."""
    half = max(1, round(0.5 * SPEED_WINDOW_S * fps))
    speed = np.full(xy.shape[:2], np.nan)
    if len(xy) > 2 * half:
        steps = np.linalg.norm(xy[2 * half :] - xy[: -2 * half], axis=-1)
        speed[half:-half] = steps * fps / (2 * half)
    return speed


def joints_table(tracks: JointTracks, fps: float, people: Mapping[int, str]) -> pd.DataFrame:
    """Return one row per frame, person and joint; missing joints have none.

    Heels and toes follow the 17 joints of a person where the clip has them.

    Columns: frame, time_s (frame / fps), person, kind (of `people`, by id), joint, x_m, y_m, z_m
    (world), x_std_m, y_std_m, z_std_m, views (cameras that contribute), filled (no camera does),
    source (as in `JointTracks`; 0 at heels and toes).
    """
    import pandas as pd  # late: it takes half a second

    markers = tracks.markers
    row, person, joint = np.nonzero(np.isfinite(markers.joints[..., 0]))
    there = (row, person, joint)
    kinds = np.array([people[int(one)] for one in tracks.person_ids], dtype=object)
    std = np.full((len(row), 3), np.nan)
    if markers.covariance is not None:
        std = np.sqrt(np.diagonal(markers.covariance[there], axis1=-2, axis2=-1))
    columns = {
        "frame": tracks.frames[row],
        "time_s": tracks.frames[row] / fps,
        "person": tracks.person_ids[person],
        "kind": pd.Categorical(kinds[person]),
        "joint": pd.Categorical.from_codes(joint, categories=list(markers.points)),
        **{f"{axis}_m": markers.joints[there][:, n] for n, axis in enumerate("xyz")},
        **{f"{axis}_std_m": std[:, n] for n, axis in enumerate("xyz")},
    }
    if markers.views is not None:
        columns |= {"views": markers.views[there], "filled": markers.views[there] == 0}
    if tracks.source is not None:
        further = len(markers.points) - len(COCO17)
        columns["source"] = np.pad(tracks.source, ((0, 0), (0, 0), (0, further)))[there]
    return pd.DataFrame(columns)


def people_table(positions: Positions, fps: float) -> pd.DataFrame:
    """Return one row per frame and person; missing people have none.

    The columns are those of `write_positions`, with distance_m after speed_m_s: the way over the
    ground since the person's first frame, from frame to frame; a gap adds nothing.
    """
    import pandas as pd  # late: it takes half a second

    row, person = np.nonzero(np.isfinite(positions.xy[..., 0]))
    there = (row, person)
    steps = np.linalg.norm(np.diff(positions.xy, axis=0, prepend=np.nan), axis=-1)
    steps[1:][np.diff(positions.frames) != 1] = np.nan
    with np.errstate(invalid="ignore"):
        std = np.sqrt(np.diagonal(positions.covariance[there], axis1=-2, axis2=-1))
        correlation = positions.covariance[there][:, 0, 1] / std.prod(axis=-1)
    return pd.DataFrame(
        {
            "frame": positions.frames[row],
            "time_s": positions.frames[row] / fps,
            "person": positions.person[person],
            "name": np.array(positions.names, dtype=object)[person],
            "kind": np.where(positions.on_plane[there], "plane", "triangulated"),
            "x_m": positions.xy[there][:, 0],
            "y_m": positions.xy[there][:, 1],
            "x_std_m": std[:, 0],
            "y_std_m": std[:, 1],
            "xy_correlation": correlation,
            "speed_m_s": _speeds(positions.xy, fps)[there],
            "distance_m": np.nancumsum(steps, axis=0)[there],
            "height_m": positions.height[person],
            "identity_certainty": positions.identity_certainty[there],
        }
    )


def strides_table(tracks: JointTracks, fps: float) -> pd.DataFrame:
    """Return one row per stride: from one contact of a foot to the next of the same foot.

    A contact is where the ankle is farthest ahead of the mid-hip along the direction of motion
    (Zeni, Richards and Higginson, 2008). Columns: person, side, start_frame, start_time_s,
    stride_time_s, stride_length_m (of the ankle, over the ground), speed_m_s, filled (a frame of
    the stride has an ankle to which no camera contributes).
    """
    import pandas as pd  # late: it takes half a second

    rows = []
    ankle_of = {"left": 15, "right": 16}
    for index, person in enumerate(tracks.person_ids.tolist()):
        hips = tracks.joints[:, index, 11:13, :2].mean(axis=1)
        for side, joint in ankle_of.items():
            ankle = tracks.joints[:, index, joint, :2]
            unseen = np.zeros(len(ankle), np.bool_)
            if tracks.views is not None:
                unseen = tracks.views[:, index, joint] == 0
            for first, last in _strides(tracks.frames, hips, ankle, fps):
                duration = float(tracks.frames[last] - tracks.frames[first]) / fps
                length = float(np.linalg.norm(ankle[last] - ankle[first]))
                rows.append(
                    {
                        "person": person,
                        "side": side,
                        "start_frame": int(tracks.frames[first]),
                        "start_time_s": float(tracks.frames[first]) / fps,
                        "stride_time_s": duration,
                        "stride_length_m": length,
                        "speed_m_s": length / duration,
                        "filled": bool(unseen[first : last + 1].any()),
                    }
                )
    columns = ("person", "side", "start_frame", "start_time_s")
    measures = ("stride_time_s", "stride_length_m", "speed_m_s", "filled")
    return pd.DataFrame(rows, columns=[*columns, *measures])


def _strides(
    frames: NDArray[np.integer], hips: Floats, ankle: Floats, fps: float
) -> list[tuple[int, int]]:
    """Return rows of the first and last frame of the strides of one foot."""
    min_swing_m = 0.15  # least travel of the ankle relative to the hips in a stride [m]
    min_stride_s = 0.4  # shortest time between contacts of a foot: sprinters take 2.3 a second
    max_stride_s = 2.0  # longest stride [s]: in a longer one the person stood
    min_stride_speed_m_s = 0.5  # slower people stand, turn or shuffle
    from scipy.signal import find_peaks  # late: it takes a second, and reports need no strides

    half = max(1, round(0.5 * SPEED_WINDOW_S * fps))
    ahead = np.full(len(frames), np.nan)
    if len(frames) > 2 * half:
        step = hips[2 * half :] - hips[: -2 * half]
        whole = frames[2 * half :] - frames[: -2 * half] == 2 * half
        with np.errstate(invalid="ignore", divide="ignore"):
            direction = step / np.linalg.norm(step, axis=-1, keepdims=True)
        middle = slice(half, -half)
        along = np.sum((ankle - hips)[middle] * direction, axis=-1)
        ahead[middle] = np.where(whole, along, np.nan)
    strides = []
    for run in find_runs(np.isfinite(ahead)):
        contacts, _ = find_peaks(
            ahead[run], distance=max(1, round(min_stride_s * fps)), prominence=min_swing_m
        )
        for a, b in pairwise((contacts + run.start).tolist()):
            duration = float(frames[b] - frames[a]) / fps
            speed = float(np.linalg.norm(ankle[b] - ankle[a])) / duration
            if duration <= max_stride_s and speed >= min_stride_speed_m_s:
                strides.append((a, b))
    return strides


def write_csv(path: Path, table: pd.DataFrame, notes: Mapping[str, str]) -> list[Path]:
    """Write a table as CSV, and its description next to it; return both files.

    CSV has no place for metadata: `<file>-metadata.json` holds the notes and the columns, in the
    form and under the name that the W3C's "CSV on the Web" gives.
    """
    about = path.with_name(f"{path.name}-metadata.json")
    kinds = {"i": "integer", "f": "number", "b": "boolean"}
    columns = [
        {"name": name, "titles": name, "datatype": kinds.get(dtype.kind, "string")}
        for name, dtype in table.dtypes.items()
    ]
    description = {
        "@context": "http://www.w3.org/ns/csvw",
        "url": path.name,
        "dc:license": notes["licence"],
        "tableSchema": {"columns": columns},
        "notes": [dict(notes)],
    }
    with whole_file(path) as draft:
        table.to_csv(draft, index=False, float_format="%.5f", lineterminator="\n")
    with whole_file(about) as draft:
        draft.write_text(json.dumps(description, indent=2) + "\n", encoding="utf-8")
    return [path, about]


def write_parquet(path: Path, table: pd.DataFrame, notes: Mapping[str, str]) -> list[Path]:
    """Write a table with notes as its schema's metadata; UsageError without pyarrow."""
    pa, parquet = _import_pyarrow("--format parquet", "choose --format csv")
    content = pa.Table.from_pandas(table, preserve_index=False)
    content = content.replace_schema_metadata({**content.schema.metadata, **notes})
    with whole_file(path) as draft:
        parquet.write_table(content, draft, compression="zstd")
    return [path]


def read_parquet(path: Path, columns: Sequence[str]) -> dict[str, NDArray[Any]]:
    """Return columns of a Parquet file by name; UsageError if pyarrow is not installed."""
    pa, parquet = _import_pyarrow(str(path), "give an npz file")
    try:
        table = parquet.read_table(path)
    except (OSError, pa.ArrowException) as error:
        raise InputError(str(path), "a Parquet table", f"{error}", "Write it again.") from error
    missing = [name for name in columns if name not in table.column_names]
    if missing or not table.num_rows:
        found = f"{table.num_rows} rows with {', '.join(table.column_names)}"
        todo = "Write the file again."
        raise InputError(str(path), f"rows with the columns {', '.join(columns)}", found, todo)
    return {name: table[name].to_numpy() for name in columns}


def _import_pyarrow(where: str, otherwise: str) -> tuple[Any, Any]:
    """Return the modules pyarrow and pyarrow.parquet; UsageError without them."""
    try:
        import pyarrow as pa
        from pyarrow import parquet
    except ImportError:
        expected = "worldpose with the extra tables, which reads and writes it"
        todo = f"Install it: pip install 'worldpose[tables]', or {otherwise}."
        raise UsageError(where, expected, "none installed", todo) from None
    return pa, parquet
