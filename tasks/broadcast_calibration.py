"""Task of stage `broadcast_calibration`: the moving camera of one clip in every frame."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path
from typing import Any, Final

import numpy as np
from numpy.typing import NDArray

from data_contracts.broadcast_calibration import BROADCAST_CALIBRATION, KeyFrame
from data_contracts.keypoints import KeypointDetections
from data_contracts.pitch import PitchSpec
from data_contracts.work import Work
from tasks.clip_inputs import ADJUSTED, select_frames
from tasks.static_calibration import clicked_markings
from tasks.unit import open_input, require_registered, unit_task
from worldpose.broadcast_calibration.calibration import (
    BroadcastClip,
    broadcast_arrays,
    broadcast_attributes,
    calibrate_broadcast,
)
from worldpose.broadcast_calibration.key_frames import KnownPeople, propose_key_frames
from worldpose.broadcast_calibration.pitch_errors import SIZES
from worldpose.broadcast_calibration.players import People
from worldpose.broadcast_calibration.report import BroadcastReport
from worldpose.broadcast_calibration.settings import BroadcastCalibrationSettings
from worldpose.pitch.template import PitchTemplate
from worldpose.store.store import Store
from worldpose.video.folder import open_video

PROPOSED_FRAMES: Final = 8
"""Frames of a clip without clicks to propose key frames in, evenly spaced [1]."""


@unit_task
def broadcast_calibration(work: Work) -> str:
    """Publish a camera per frame, and its uncertainty; return the key."""
    store = Store.open(work.project)
    sources: dict[str, Any] = work.recipe.sources
    first, count = sources["first_frame"], sources["frame_count"]
    start = first + sources["offset_frames"]
    path = Path(work.folder) / sources["video"]
    ((file, clicked),) = sources["key_frames"].items()

    def pictures() -> Iterator[NDArray[np.uint8]]:
        with open_video(path) as video:
            yield from (picture for _, picture in video.frames(start, start + count, grey=True))

    people, seen, boxes = _people(store, work)
    pitch = _open_pitch(store, work)
    key_frames = [
        KeyFrame(frame=int(frame), markings=clicked_markings(markings))
        for frame, markings in clicked.items()
        if start <= int(frame) < start + count
    ]
    with store.publish(work) as result:
        if "side" in sources:
            key_frames = _propose(work, pitch, people, seen)
        calibration = calibrate_broadcast(
            pitch,
            BroadcastClip(
                key_frames,
                pictures,
                float(sources["fps"]),
                people=people,
                boxes=boxes,
                where=file,
                first=start,
                proposed="side" in sources,
            ),
            BroadcastCalibrationSettings.model_validate(work.recipe.settings),
        )
        require_registered(path, sources["video_sha256"])
        result.write(
            BROADCAST_CALIBRATION,
            arrays=broadcast_arrays(calibration),
            coordinates={"frame": np.arange(first, first + count)},
            attributes=broadcast_attributes(work.recipe.unit, calibration, start),
        )
        result.figures.update(_figures(calibration.report))
    return work.key


def _propose(
    work: Work, pitch: PitchTemplate, people: People | None, seen: KeypointDetections | None
) -> list[KeyFrame]:
    """Return key frames that are proposed from images spread over the clip."""
    sources: dict[str, Any] = work.recipe.sources
    path, count = Path(work.folder) / sources["video"], sources["frame_count"]
    start = sources["first_frame"] + sources["offset_frames"]
    numbers = np.linspace(start, start + count - 1, min(count, PROPOSED_FRAMES)).astype(int)

    def spread_out() -> Iterator[tuple[int, NDArray[np.uint8]]]:
        with open_video(path) as video:
            for number in np.unique(numbers).tolist():
                yield from video.frames(number, number + 1)

    known = None
    if people is not None and seen is not None:
        feet = np.mean(people.joints[:, :, 15:17, :2], axis=2)
        known = KnownPeople(seen, feet, float(sources["fps"]), start)
    return propose_key_frames(
        spread_out(), pitch, side=sources["side"], where=str(path), people=known
    )


def _open_pitch(store: Store, work: Work) -> PitchTemplate:
    """Return the pitch, on the surface that static cameras show, if any."""
    pitch = PitchTemplate.from_spec(PitchSpec.model_validate(work.recipe.sources["pitch"]))
    if ADJUSTED not in work.recipe.inputs:
        return pitch
    surface = open_input(store, work, ADJUSTED).attrs["surface"]
    return pitch if surface is None else pitch.with_surface(surface)


def _people(
    store: Store, work: Work
) -> tuple[People | None, KeypointDetections | None, NDArray[np.float64] | None]:
    """Return people fitted to static cameras at the time of each image, detections and boxes."""
    sources: dict[str, Any] = work.recipe.sources
    unit = work.recipe.unit
    seen_names = [f"{stage}/{unit}" for stage in ("ingest", "detection")]
    names = [name for name in seen_names if name in work.recipe.inputs]
    if not names:
        return None, None, None
    first, count, fps = (sources[name] for name in ("first_frame", "frame_count", "fps"))
    offset = float(sources["broadcast_offset_frames"])
    stored = select_frames(open_input(store, work, names[0]), np.arange(first, first + count))
    seen = KeypointDetections.from_arrays(stored)
    if f"body_fitting/{unit}" not in work.recipe.inputs:
        return None, seen, seen.boxes.astype(np.float64)
    joints = open_input(store, work, f"body_fitting/{unit}")["joints"].values
    people = People(joints, seen.keypoints.astype(np.float64), float(fps))
    return people.later(round(offset) - offset), seen, None


def _figures(report: BroadcastReport) -> dict[str, float]:
    """Return metrics of a calibrated clip; those that could not be computed are left out."""
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
    offset = report.feed_offset
    if offset is not None and offset.determined:
        figures["feed_offset_frames"] = offset.frames
    for name, value, std in zip(SIZES, report.pitch.size, report.pitch.size_std, strict=True):
        if std > 0.0:
            figures |= {f"{name}_m": float(value), f"{name}_std_m": float(std)}
    return figures | {"weak": float(bool(report.reasons))}
