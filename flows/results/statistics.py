"""Statistics of data sets, clip by clip."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

from data_contracts.release import DataSetStatistics
from flows.results.checking import USUAL_FPS, stated_rates
from worldpose.dataset.statistics import (
    camera_kind,
    clip_statistics,
    data_set_statistics,
    read_places,
)
from worldpose.errors import UsageError


def count(folders: Sequence[Path], *, fps: float | None = None) -> DataSetStatistics:
    """Count the content of one data set, which can span several folders.

    One clip is in memory at a time.

    Args:
        folders: written by `worldpose export`, or others of the same layouts.
        fps: frames per second; None = as the data sets state, or 50.

    Raises:
        InputError: a file cannot be read.
        UsageError: two folders have the same name and clips.
    """
    clips = {}
    for folder in folders:
        rates = stated_rates(folder, fps)
        cameras = sorted((folder / "cameras").glob("*.npz"))
        for name, rate in rates.items():
            own = folder / "cameras" / f"{name}.npz"
            kind = camera_kind(own)
            if not own.is_file() and any(file.stem not in rates for file in cameras):
                kind = "S"
            label = name if len(folders) == 1 else f"{folder.resolve().name}/{name}"
            if label in clips:
                raise UsageError(
                    str(folder),
                    expected="folders of different names",
                    found=f"{label} twice",
                    todo="Name each folder once, or rename one.",
                )
            clips[label] = clip_statistics(read_places(folder, name), rate or USUAL_FPS, kind)
    return data_set_statistics(clips)
