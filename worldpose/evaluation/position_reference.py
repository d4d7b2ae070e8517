"""Positions of a tracking provider as reference: kloppy's tables and our own, on the ground."""

from __future__ import annotations

import io
import re
import warnings
from dataclasses import replace
from pathlib import Path

import numpy as np

from data_contracts.arrays import Floats, Integers
from worldpose.errors import InputError, say_failure
from worldpose.evaluation.matching import joint_distances, select_frames
from worldpose.formats.joints_file import JointTracks
from worldpose.parsing import DECIMAL_COMMA, clock_seconds, decode_table


def read_positions(path: Path) -> tuple[Integers, tuple[str, ...], Floats, float]:
    """Return frames (frames,), names of people, their places (frames, persons, 2) [m], and a rate.

    The rate is that of the frames by their times [1/s]; NaN without times.

    The file is a CSV of `worldpose export --format positions`, or of kloppy's `to_df`: columns
    `<player>_x` and `<player>_y`, or `player_id`, x and y, beside `frame_id`. The ball is left out.
    An archive may hold it. InputError for places that cannot be metres from the centre spot.
    """
    import pandas as pd  # late: it takes half a second

    ours = {"frame_id": "frame", "player_id": "person", "x_m": "x", "y_m": "y"}
    try:
        text = re.sub(r"\Asep=.\s*", "", decode_table(path.read_bytes()))  # of Excel
        separator = max(",;\t", key=text.partition("\n")[0].count)
        cells = re.split(f"[{separator}\r\n]", text[: 1 << 16])
        # A name may have a comma between digits beside numbers with points.
        has_points = any(re.fullmatch(r"[-+]?\d*\.\d+", cell) for cell in cells)
        sign = "," if not has_points and any(map(DECIMAL_COMMA.fullmatch, cells)) else "."
        table = pd.read_csv(io.StringIO(text), sep=separator, decimal=sign)
        ours |= {} if "timestamp" in table else {"time_s": "timestamp"}
        table = table.rename(columns=ours).set_index("frame").sort_index()
        rate = np.nan
        if "timestamp" in table:
            each = table.groupby(level=0).first()
            time = each["timestamp"]
            if is_text := not pd.api.types.is_numeric_dtype(time):
                seconds = time.map(clock_seconds)
                spans = pd.to_timedelta(time, errors="coerce").dt.total_seconds()  # 40ms, PT0.04S
                seconds = seconds.where(seconds.notna(), spans)
                if (odd := time[seconds.isna() & time.notna()]).size:
                    raise ValueError(
                        f"the time {odd.iloc[0]!r:.40}, neither 00:01:02.5 nor seconds"
                    )
                time = seconds
            period = pd.factorize(each["period_id"])[0] if "period_id" in each else 0.0 * time
            rows = np.array([time.index, time, period], np.float64)
            # A clock may be coarser than a frame: only rows at which it moves on are exact.
            steps = np.diff(rows[:, 1:][:, np.diff(rows[1]) != 0.0])
            # Times begin again in each period, and perhaps later than the last one of before.
            steps = steps[:, (steps[1] > 0.0) & (steps[2] == 0.0)]
            rate = float(steps[0].sum() / steps[1].sum()) if steps.size else np.nan
            step = float(np.median(steps[1])) if steps.size else np.nan
            while 0.0 < rate < 1.0 and not is_text:  # times are in ms or smaller units
                rate, step = 1000.0 * rate, step / 1000.0
            # Frames may be counted in milliseconds, but not 240 rows a second of a clock of 1 ms
            # be exceeded: then times are in minutes or so.
            rate = rate if rate >= 1.0 and step > 0.0039 else np.nan
        if {"person", "x", "y"} <= {*table}:
            named = "name" in table and table["name"].notna().all()
            who = table["name" if named else "person"]
            # Two people of one name differ by their ids; pieces of one track may share a name.
            twice = who[who.groupby([who.index, who]).transform("size") > 1]
            whole = who.astype(str) + " " + table["person"].astype(str)
            table["who"] = who.where(~who.isin(twice), whole)
            table = table.pivot(columns="who", values=["x", "y"])
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


def _at_match_frames(
    frames: Integers, xy: Floats, step: float, first: int | None
) -> tuple[Integers, Floats]:
    """Return match frames and places in them, linear between rows, of `step` frames per number."""
    place = step * frames if first is None else step * (frames - frames[0]) + first
    if step == 1.0 or len(frames) < 2:
        return np.rint(place).astype(np.int64), xy
    whole = np.arange(int(np.ceil(place[0] - 1e-6)), int(place[-1] + 1e-6) + 1)
    after = np.clip(np.searchsorted(place, whole), 1, len(place) - 1)
    gap = place[after] - place[after - 1]
    share = ((whole - place[after - 1]) / gap)[:, None, None]
    between = (1.0 - share) * xy[after - 1] + share * xy[after]
    between = np.where((gap > 1.5 * gap.min())[:, None, None], np.nan, between)
    between = np.where(share < 1e-6, xy[after - 1], between)
    return whole, np.where(share > 1.0 - 1e-6, xy[after], between)


def align_positions(
    path: Path, prediction: JointTracks, first: int | None = None, fps: float | None = None
) -> tuple[JointTracks, JointTracks, list[str]]:
    """Return a prediction and given places as tracks on the ground, and what was found.

    Axes of providers may point the other way: of the four ways, the one is taken that clearly
    agrees with the prediction; InputError if none does.

    `first` is the match frame of the file's first row; None = its frames are match frames. At
    another rate than the match's (`fps`), by the file's times or by the best agreement of usual
    rates, match frame 0 is still frame 0.
    """
    most, hips = 1.0, [11, 12]  # largest median distance of one person in both [m]
    numbers, names, given, rate = read_positions(path)
    usual = (25.0, 10.0, 50.0, 30.0, 20.0, 12.5, 5.0, 60.0)
    rates = (rate,) if np.isfinite(rate) else usual
    if fps:  # rows of television rates may lie beside a match of a whole rate, or the reverse
        slow = tuple(each / 1.001 for each in (rates if np.isfinite(rate) else (30.0, 60.0)))
        rates = (*rates, *slow, *(1.001 * each for each in rates if np.isfinite(rate)))
    owns = {fps} if fps else {*usual}
    if fps and not np.isfinite(rate) and abs(fps - round(fps)) < 2e-3 * fps:
        owns.add(float(round(fps)))  # 59.94 to 29.97 is 2 to 1, as 60 to 30 is
    ratios = {own / each for own in owns for each in rates}
    # A rate by a coarse clock may be wrong by a frame over the file.
    likely = fps / rate if fps and abs(fps / rate - 1.0) * np.ptp(numbers) > 1.0 else 1.0
    steps = sorted({1.0 if abs(step - 1.0) < 5e-4 else step for step in ratios} | {1.0})

    def on_ground(frames: Integers, places: Floats) -> JointTracks:
        joints = np.full((*places.shape[:2], 17, 3), np.nan)
        joints[:, :, hips, :2] = places[:, :, None]
        joints[:, :, hips, 2] = np.where(np.isfinite(places[..., :1]), 0.0, np.nan)
        return JointTracks(frames, np.arange(places.shape[1]), joints)

    mine = on_ground(prediction.frames, prediction.joints[:, :, hips, :2].mean(axis=2))
    mine = replace(mine, person_ids=prediction.person_ids)

    def try_step(step: float) -> list[tuple[float, tuple[float, float], JointTracks, Floats]]:
        frames, xy = _at_match_frames(numbers, given, step, first)
        seen = select_frames(mine.joints, mine.frames, frames)
        found = []
        for way in ((1.0, 1.0), (-1.0, -1.0), (1.0, -1.0), (-1.0, 1.0)):
            turned = on_ground(frames, xy * way)
            apart = joint_distances(seen, turned.joints)
            nearest = apart.min(axis=1, initial=np.inf)
            known = nearest[np.isfinite(nearest)]
            found.append((float(np.median(known)) if len(known) else np.inf, way, turned, apart))
        return sorted(found, key=lambda each: each[0])[:2]

    tried = {step: try_step(step) for step in steps}
    # The rate of the times, or the match's own, holds unless another agrees clearly better.
    step = min(
        tried,
        key=lambda step: (tried[step][0][0] * (0.5 if step == likely else 1.0), step != likely),
    )
    (best, way, turned, apart), (second, *_) = tried[step]
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
    notes = [f"people: {{{', '.join(said)}}}"]
    alike = 0.05  # distances of two rates that tell nothing [m]
    likewise = [each for each in tried if tried[each][0][0] <= max(2.0 * best, alike)]
    # Rates that differ by a frame over the file at most are one.
    apart_by = max(abs(each - step) for each in likewise) * np.ptp(numbers)
    if not np.isfinite(rate) and apart_by > 1.0:
        told = "warning: the positions have no times, and people move too little to tell their rate"
        notes.insert(0, f"{told}; one frame of theirs is taken as {step:g} of the match")
    if step != 1.0:
        how = "by its times" if step == likely else "by agreement alone"
        notes.insert(0, f"each frame of the positions is {step:g} frames of the match, {how}")
    elif step != likely:
        notes.insert(0, f"places agree frame by frame, not at the times' {rate:g} per second")
    if way != (1.0, 1.0):
        notes.insert(0, "axes of the positions: {:+g} x, {:+g} y".format(*way))
    return mine, turned, notes
