"""Positions of a tracking provider as reference: kloppy's tables and our own, on the ground."""

from __future__ import annotations

import warnings
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from data_contracts.arrays import Floats, Integers
from worldpose.errors import InputError, say_failure
from worldpose.evaluation.matching import joint_distances, select_frames
from worldpose.formats.joints_file import JointTracks

if TYPE_CHECKING:
    import pandas as pd


def read_positions(path: Path) -> tuple[Integers, tuple[str, ...], Floats, float]:
    """Return frames (frames,), names of people, places (frames, persons, 2) [m], and rate [1/s].

    The rate is that of the column `timestamp` or `time_s`; NaN without one.

    The file is a CSV of `worldpose export --format positions`, or of kloppy's `to_df`: columns
    `<player>_x` and `<player>_y`, or `player_id`, x and y, beside `frame_id`. The ball is left out.

    Raises:
        InputError: the file has another form, or places that cannot be metres from the centre spot.
    """
    import pandas as pd  # late: it takes half a second

    ours = {"frame_id": "frame", "player_id": "person", "x_m": "x", "y_m": "y"}
    try:
        table = pd.read_csv(path).rename(columns=ours).set_index("frame").sort_index()
        clock = next((table[name] for name in ("timestamp", "time_s") if name in table), None)
        rate = np.nan if clock is None else _rate(clock[~clock.index.duplicated()])
        if {"person", "x", "y"} <= {*table}:
            named = "name" in table and table["name"].notna().all()
            table = table.pivot(columns="name" if named else "person", values=["x", "y"])
            table.columns = [f"{name}_{axis}" for axis, name in table.columns]
        names = tuple(
            name
            for name in (column.removesuffix("_x") for column in table if column.endswith("_x"))
            if f"{name}_y" in table and name != "ball"
        )
        x, y = (table[[f"{n}_{axis}" for n in names]].to_numpy(np.float64) for axis in "xy")
        reach = float(np.nanmax(np.abs([x, y]), initial=0.0))
        if not 1.5 < reach < 200.0 or not table.index.is_unique:
            raise ValueError(f"{len(names)} people at places up to {reach:g} in {len(x)} rows")
        return table.index.to_numpy(np.int64), names, np.stack([x, y], axis=-1), rate
    except (OSError, ValueError, KeyError) as error:
        raise InputError(
            str(path),
            expected="frame_id, each once, and places of people in metres from the centre spot",
            found=say_failure(error),
            todo="Save kloppy's table: dataset.transform(...).to_df().to_csv(FILE).",
        ) from error


def _rate(clock: pd.Series) -> float:
    """Return frames per second of times by frame; NaN if these are no times of several frames.

    Times of each half may start at 0.
    """
    import pandas as pd

    seconds = pd.to_numeric(clock, errors="coerce")
    if seconds.isna().any():
        seconds = pd.to_timedelta(clock, errors="coerce").dt.total_seconds()
    steps, passed = np.diff(clock.index.to_numpy(np.float64)), np.diff(seconds.to_numpy())
    rises = passed > 0.0
    return float(steps[rises].sum() / passed[rises].sum()) if rises.any() else np.nan


def align_positions(
    path: Path, prediction: JointTracks, first: int | None = None, fps: float | None = None
) -> tuple[JointTracks, JointTracks, list[str]]:
    """Return a prediction and given places as tracks on the ground, and what was found.

    Axes of providers may point the other way: of the four ways, the one is taken that clearly
    agrees with the prediction.

    `first` is the match frame of the file's first row; None = its frames are match frames. Places
    at another rate than `fps` [1/s] are interpolated in the match frames.

    Raises:
        InputError: the file is invalid, or no way of its axes clearly agrees.
    """
    most, hips = 1.0, [11, 12]  # largest median distance of one person in both [m]
    frames, names, xy, rate = read_positions(path)
    frames, notes = frames if first is None else frames - frames[0] + first, list[str]()
    if fps is not None and abs(fps / rate - 1.0) * np.ptp(frames) > 1.0:
        if first is None:
            raise InputError(
                f"{path}: timestamp",
                expected=f"{fps:g} frames per second, as of the match",
                found=f"{rate:.6g}",
                todo="State the match frame of the first row: --first-frame NUMBER.",
            )
        given = first + (frames - first) * (fps / rate)
        frames = np.arange(first, int(given[-1]) + 1)
        paths = xy.reshape(len(xy), -1).T
        xy = np.stack([np.interp(frames, given, path) for path in paths], axis=-1)
        xy = xy.reshape(len(frames), -1, 2)
        notes.append(f"positions at {rate:.6g} per second, interpolated in frames of {fps:g}")

    def on_ground(frames: Integers, places: Floats) -> JointTracks:
        joints = np.full((*places.shape[:2], 17, 3), np.nan)
        joints[:, :, hips, :2] = places[:, :, None]
        joints[:, :, hips, 2] = np.where(np.isfinite(places[..., :1]), 0.0, np.nan)
        return JointTracks(frames, np.arange(places.shape[1]), joints)

    mine = on_ground(prediction.frames, prediction.joints[:, :, hips, :2].mean(axis=2))
    mine = replace(mine, person_ids=prediction.person_ids)
    seen = select_frames(mine.joints, mine.frames, frames)
    found = []
    for way in ((1.0, 1.0), (-1.0, -1.0), (1.0, -1.0), (-1.0, 1.0)):
        turned = on_ground(frames, xy * way)
        apart = joint_distances(seen, turned.joints)
        nearest = apart.min(axis=1, initial=np.inf)
        known = nearest[np.isfinite(nearest)]
        found.append((float(np.median(known)) if len(known) else np.inf, way, turned, apart))
    (best, way, turned, apart), (second, *_) = sorted(found, key=lambda each: each[0])[:2]
    if not best < min(most, 0.5 * second):
        raise InputError(
            str(path),
            expected=f"places within {most:g} m of the people of the match, one way round",
            found=f"median distances of {best:.2f} and {second:.2f} m, the two best ways",
            todo="State the match frame of the first row: --first-frame NUMBER.",
        )
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", RuntimeWarning)  # of people who share no frame
        off = np.nanmedian(np.where(np.isfinite(apart), apart, np.nan), axis=0)
    off = np.where(off < most, off, np.inf)
    pairs = (
        (person, int(row.argmin())) for person, row in zip(mine.person_ids, off.T, strict=True)
    )
    said = (f"{person}: {names[n]}" for p, (person, n) in enumerate(pairs) if off[n, p] < most)
    if way != (1.0, 1.0):
        notes.append("axes of the positions: {:+g} x, {:+g} y".format(*way))
    notes.append(f"people: {{{', '.join(said)}}}")
    return mine, turned, notes
