"""Task of stage `broadcast_calibration`: the moving camera of one clip in every frame."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from data_contracts.broadcast_calibration import BROADCAST_CALIBRATION, KeyFrame
from data_contracts.pitch import PitchSpec
from data_contracts.run import Work
from tasks.static_calibration import clicked_markings
from tasks.unit import open_input, require_registered, unit_task
from worldpose.broadcast_calibration import (
    BroadcastCalibrationSettings,
    BroadcastReport,
    People,
    broadcast_arrays,
    broadcast_attributes,
    calibrate_broadcast,
)
from worldpose.pitch import PitchTemplate
from worldpose.store import Store
from worldpose.video import VideoReader


@unit_task
def broadcast_calibration(work: Work) -> str:
    """Publishes a camera a frame, and how well it is known; returns the key."""
    store = Store.open(work.project)
    sources: dict[str, Any] = work.recipe.sources
    first, count = sources["first_frame"], sources["frame_count"]
    start = first + sources["offset_frames"]
    path = Path(work.folder) / sources["video"]
    ((file, clicked),) = sources["key_frames"].items()

    def pictures() -> Iterator[NDArray[np.uint8]]:
        with VideoReader(path) as video:
            yield from (picture for _, picture in video.frames(start, start + count, grey=True))

    with store.publishing(work) as result:
        calibration = calibrate_broadcast(
            PitchTemplate.from_spec(PitchSpec.model_validate(sources["pitch"])),
            [
                KeyFrame(frame=int(frame) - start, markings=clicked_markings(markings))
                for frame, markings in clicked.items()
                if start <= int(frame) < start + count
            ],
            pictures,
            float(sources["fps"]),
            people=_people(store, work),
            settings=BroadcastCalibrationSettings.model_validate(work.recipe.settings),
            where=file,
        )
        require_registered(path, sources["video_sha256"])
        result.write(
            BROADCAST_CALIBRATION,
            arrays=broadcast_arrays(calibration),
            coordinates={"frame": np.arange(first, first + count)},
            attributes=broadcast_attributes(work.recipe.unit, calibration),
        )
        result.figures.update(_figures(calibration.report))
    return work.key


def _people(store: Store, work: Work) -> People | None:
    """Fitted people when each picture was taken, and who was seen in it, where that is known."""
    sources: dict[str, Any] = work.recipe.sources
    unit = work.recipe.unit
    if f"ingest/{unit}" not in work.recipe.inputs:
        return None
    first, count, fps = (sources[name] for name in ("first_frame", "frame_count", "fps"))
    offset = float(sources["broadcast_offset_frames"])
    seen = open_input(store, work, f"ingest/{unit}").sel(frame=np.arange(first, first + count))
    joints = open_input(store, work, f"body_fitting/{unit}")["joints"].values
    return People(
        joints=between_frames(joints, round(offset) - offset),
        keypoints=seen["keypoints"].values.astype(np.float64),
        fps=float(fps),
    )


def between_frames(values: NDArray[np.float64], late: float) -> NDArray[np.float64]:
    """Values a part of a frame later, on a straight line between frames; NaN beyond the ends.

    Args:
        values: (frames, ...).
        late: in -0.5..0.5 [frames].
    """
    if late == 0.0:
        return values
    neighbour = np.full_like(values, np.nan)
    if late > 0.0:
        neighbour[:-1] = values[1:]
    else:
        neighbour[1:] = values[:-1]
    return (1.0 - abs(late)) * values + abs(late) * neighbour


def _figures(report: BroadcastReport) -> dict[str, float]:
    """Figures of a calibrated clip; what could not be computed is left out."""
    named = {
        "expected_error_median_px": report.reprojection_error,
        "marking_rms_median_px": report.marking_rms,
        "player_rms_median_px": report.player_rms,
    }
    figures = {
        name: float(np.nanmedian(values))
        for name, values in named.items()
        if np.isfinite(values).any()
    }
    return figures | {"weak": float(bool(report.reasons))}
