"""Positions of a tracking provider as reference: kloppy's tables and our own, on the ground."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from data_contracts.arrays import Floats
from worldpose.errors import InputError, say_failure
from worldpose.evaluation.matching import joint_distances, select_frames
from worldpose.formats.joints_file import JointTracks

_HIPS = (11, 12)  # of COCO-17: they stand for the person


def read_positions(path: Path) -> tuple[NDArray[np.int64], tuple[str, ...], Floats]:
    """Return frames (frames,), names of people, and their places (frames, persons, 2) [m].

    The file is a CSV of `worldpose export --format positions`, or of kloppy's `to_df`: columns
    `<player>_x` and `<player>_y`, or `player_id`, x and y, beside `frame_id`. The ball is left out.

    Raises:
        InputError: the file has another form, or places that cannot be metres from the centre spot.
    """
    import pandas as pd  # late: it takes half a second

    try:
        table = pd.read_csv(path).rename(columns={"frame_id": "frame", "player_id": "person"})
        table = table.rename(columns={"x_m": "x", "y_m": "y"}).set_index("frame")
        if {"person", "x", "y"} <= {*table}:
            keys = ["name"] if "name" in table and table["name"].notna().all() else ["person"]
            wide = table.pivot(columns=keys[0], values=["x", "y"]).sort_index()
            names = tuple(map(str, wide["x"].columns))
            x, y = (wide[axis].to_numpy(np.float64) for axis in "xy")
            shown = np.array([name != "ball" for name in names])
        else:
            names = tuple(c[:-2] for c in table if c.endswith("_x") and f"{c[:-2]}_y" in table)
            wide = table.sort_index()
            x, y = (wide[[f"{n}_{axis}" for n in names]].to_numpy(np.float64) for axis in "xy")
            shown = np.array([name != "ball" for name in names], dtype=np.bool_)
        frames, xy = wide.index.to_numpy(np.int64), np.stack([x, y], axis=-1)[:, shown]
        if not xy.size or not wide.index.is_unique:
            raise ValueError("no people" if not xy.size else "frames that occur twice")
        reach = float(np.nanmax(np.abs(xy)))
        if not 1.5 < reach < 200.0:
            raise ValueError(f"places up to {reach:g}")
    except (OSError, ValueError, KeyError) as error:
        raise InputError(
            str(path),
            expected="frame_id and places of people in metres from the centre spot",
            found=say_failure(error),
            todo="Save kloppy's table: dataset.transform(...).to_df().to_csv(FILE).",
        ) from error
    return frames, tuple(np.array(names)[shown].tolist()), xy


def align_positions(
    path: Path, prediction: JointTracks, first: int | None = None
) -> tuple[JointTracks, JointTracks, list[str]]:
    """Return a prediction and given places as tracks on the ground, and what was found.

    Axes of providers may point the other way: of the four ways, the one is taken that clearly
    agrees with the prediction.

    Args:
        path: as for `read_positions`.
        prediction: the joints of the same people.
        first: match frame of the file's first row; None = its frames are match frames.

    Raises:
        InputError: the file is invalid, or no way of its axes clearly agrees.
    """
    most = 1.0  # largest median distance of one person in both [m]
    frames, names, xy = read_positions(path)
    frames = frames if first is None else frames - frames[0] + first

    def on_ground(frames: NDArray[np.int64], places: Floats) -> JointTracks:
        joints = np.full((*places.shape[:2], 17, 3), np.nan)
        joints[:, :, _HIPS, :2] = places[:, :, None]
        joints[:, :, _HIPS, 2] = np.where(np.isfinite(places[..., :1]), 0.0, np.nan)
        return JointTracks(frames, np.arange(places.shape[1]), joints)

    middle = prediction.joints[:, :, _HIPS, :2].mean(axis=2)
    mine = replace(on_ground(prediction.frames, middle), person_ids=prediction.person_ids)
    seen = select_frames(mine.joints, mine.frames, frames)
    found = []
    for way in ((1.0, 1.0), (-1.0, -1.0), (1.0, -1.0), (-1.0, 1.0)):
        turned = on_ground(frames, xy * way)
        apart = joint_distances(seen, turned.joints)
        nearest = apart.min(axis=1, initial=np.inf)
        known = np.isfinite(nearest)
        off = float(np.median(nearest[known])) if known.any() else np.inf
        found.append((off, way, turned, apart))
    (best, way, turned, apart), (second, *_) = sorted(found, key=lambda each: each[0])[:2]
    if not best < min(most, 0.5 * second):
        raise InputError(
            str(path),
            expected=f"places within {most:g} m of the people of the match, one way round",
            found=f"median distances of {best:.2f} and {second:.2f} m, the two best ways",
            todo="State the match frame of the first row: --first-frame NUMBER.",
        )
    notes = (
        []
        if way == (1.0, 1.0)
        else ["axes of the positions are turned: {:+g} x, {:+g} y".format(*way)]
    )
    apart[~np.isfinite(apart)] = np.nan
    with np.errstate(invalid="ignore"):
        middle_off = np.array([[_median(each) for each in row] for row in apart.transpose(2, 1, 0)])
    players = {
        int(person): names[int(np.nanargmin(off))]
        for person, off in zip(mine.person_ids, middle_off, strict=True)
        if np.nanmin(off, initial=np.inf) < most
    }
    said = ", ".join(f"{person}: {name}" for person, name in players.items())
    return mine, turned, [*notes, f"people: {{{said}}}"]


def _median(values: Floats) -> float:
    known = values[np.isfinite(values)]
    return float(np.median(known)) if len(known) else np.inf
