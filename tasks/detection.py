"""Task of stage `detection`: the people of one clip in one camera's video."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from fractions import Fraction

import numpy as np
import xarray as xr
from numpy.typing import NDArray
from pydantic import TypeAdapter

from data_contracts.arrays import Image, Singles
from data_contracts.detection import DETECTION, IMAGE_ARRAYS
from data_contracts.keypoints import KeypointDetections
from tasks.unit import Spool, UnitInputs, unit_task
from worldpose.detection.interfaces import People
from worldpose.detection.models import (
    load_detectors,
    load_landmarks,
    load_pose,
    load_score_map,
    weights_of,
)
from worldpose.detection.pipeline import PeopleFinder, Place
from worldpose.detection.settings import DetectionSettings
from worldpose.errors import InputError
from worldpose.formats.detection_files import read_boxes
from worldpose.ingest.footage import stretches
from worldpose.review.detections import DetectionEdit, replay_detections
from worldpose.static_calibration.venue import join_cameras
from worldpose.store.writer import ResultWriter
from worldpose.video.folder import open_video, readable_at
from worldpose.video.pictures import FrameIndex


@unit_task
def detection(inputs: UnitInputs, result: ResultWriter) -> None:
    """Write boxes and keypoints, with people's corrections."""
    edits = TypeAdapter(list[DetectionEdit]).validate_python(inputs.sources.get("edits") or [])
    with inputs.open_spool() as spool:
        found = _open_uncorrected(inputs) if edits else None
        detections, images, unreadable, figures, warnings = found or _detect_people(inputs, spool)
        result.figures |= figures
        if unreadable:
            first, last = max(unreadable, key=lambda gap: gap[1] - gap[0])
            result.figures |= {"unreadable_from_frame": first, "unreadable_to_frame": last}
        result.warnings += warnings
        objections = {}
        if edits:
            replay = replay_detections(detections, edits)
            detections, objections = replay.observations, {"objections": [*replay.objections]}
            result.figures["corrections_refused"] = float(sum(map(bool, replay.objections)))
        result.write(
            DETECTION,
            arrays=detections.arrays() | images,
            coordinates={"frame": detections.frame},
            attributes={
                "camera_id": inputs.sources["camera"],
                "unreadable": unreadable,
                **objections,
                **detections.labels(),
            },
        )


_Found = tuple[
    KeypointDetections, dict[str, Singles], list[list[int]], dict[str, float], Sequence[str]
]
"""People; `IMAGE_ARRAYS` by name; [first, last] of frames without an image; metrics; warnings."""


def _warn_of_size(detections: KeypointDetections, settings: DetectionSettings) -> list[str]:
    """Return a sentence if people are larger than those whom the bundled detector knows."""
    largest = 2 * 160.0  # twice the tallest people of its training [px]
    boxes, score = np.asarray(detections.boxes), np.asarray(detections.score)
    heights = (boxes[..., 3] - boxes[..., 1])[score >= 0.3]
    if settings.detector != DetectionSettings().detector or not len(heights):
        return []
    usual = float(np.median(heights))
    if usual <= largest:
        return []
    return [
        f"people are {usual:.0f} px tall in the images, and the bundled detector knows people of "
        "28 to 160 px: it misses people and finds wrong ones, and bodies are wrong. Give 2D poses "
        "of another tool, or other nets (settings detection.detector and detection.pose)"
    ]


def _open_uncorrected(inputs: UnitInputs) -> _Found | None:
    """Return the published detections without corrections; None if there are none."""
    published = inputs.open_uncorrected("edits")
    if published is None:
        return None
    stored, manifest = published
    detections = KeypointDetections.from_arrays(stored)
    images = {array.name: stored[array.name].values for array in IMAGE_ARRAYS}
    return detections, images, stored.attrs["unreadable"], manifest.figures, manifest.warnings


def _detect_people(inputs: UnitInputs, spool: Spool) -> _Found:
    """Run the detection nets."""
    settings = inputs.settings(DetectionSettings)
    given = _given_people(inputs) if "boxes" in inputs.sources else None
    finder = PeopleFinder(
        load_detectors(settings) if given is None else (),
        load_pose(settings),
        settings,
        load_score_map(settings) if given is None else None,
        landmarks := load_landmarks(settings),
    )
    require_weights(settings, inputs.sources["weights"])
    most, quality = 0, list[tuple[float, float]]()
    for chunk in finder.find(_read_frames(inputs, quality), _open_place(inputs), given):
        spool.add(chunk.arrays())
        most = max(most, int(np.isfinite(chunk.score).sum(axis=1).max()))
    inputs.require_registered("video")
    report = finder.report
    unreadable = report.unreadable
    told = [reason] if (reason := report.why_no_person()) else []
    if report.cut:
        told.append(
            f"in {report.cut} frames, people beyond the {settings.max_people} of "
            "detection.max_people were left out"
        )
    if len(unreadable) == report.frames and not (_pictures(inputs) >= 0).any():
        # A camera may film other clips alone.
        unreadable, told = [], ["the camera does not film this clip"]
    elif len(unreadable) == report.frames:
        raise InputError(
            str(inputs.file("video")),
            expected="images that can be decoded",
            found=f"none in {report.frames} frames",
            todo="Convert the video with any video tool, and give that one.",
        )
    detections = KeypointDetections.from_arrays(
        {
            "frame": inputs.frames,
            **{name: values[:, :most] for name, values in spool.arrays().items()},
            **({} if landmarks is None else {"point": landmarks.points}),
        }
    )
    told += [] if report.is_given else _warn_of_size(detections, settings)
    return (
        detections,
        {
            array.name: np.array(values, dtype=np.float32)
            for array, values in zip(IMAGE_ARRAYS, zip(*quality, strict=True), strict=True)
        },
        stretches(np.array(unreadable, dtype=np.int64)),
        {
            "frames": report.frames,
            "detections": report.detections,
            "detections_a_frame": report.detections / report.frames,
            "unreadable_share": len(unreadable) / report.frames,
            "empty_share": report.empty / report.frames,
            "stride": settings.stride,
            "turned_deg": 90 * report.quarters,
            "crowd": report.crowd,
            "bridged_share": report.bridged / max(1, report.detections),
            "flicker_share": report.flickers / max(1, report.detections),
            **report.speed(),
        },
        [f"{inputs.recipe.name}: {each}." for each in told],
    )


def _pictures(inputs: UnitInputs) -> NDArray[np.integer]:
    """Return the picture of the video in each frame of the clip; -1 = none."""
    footage, frames = inputs.open(f"ingest/{inputs.sources['camera']}"), inputs.frames
    return footage["picture_of_frame"].sel(frame=slice(frames[0], frames[-1])).values


def _given_people(inputs: UnitInputs) -> dict[int, People]:
    """Return the clip's given boxes by match frame; InputError if the file has changed."""
    index = footage_index(inputs.open(f"ingest/{inputs.sources['camera']}"))
    given = read_boxes(inputs.file("boxes"), index.size, len(index))
    inputs.require_registered("boxes")
    frames, pictures = inputs.frames, _pictures(inputs)
    begins = np.searchsorted(given.frame, pictures, side="left")
    ends = np.searchsorted(given.frame, pictures, side="right")
    return {
        frame: People(given.box[begin:end], given.score[begin:end])
        for frame, begin, end in zip(frames.tolist(), begins, ends, strict=True)
        if end > begin
    }


def _read_frames(
    inputs: UnitInputs, quality: list[tuple[float, float]]
) -> Iterator[tuple[int, Image | None]]:
    """Yield every match frame of the clip with its image.

    Brightness and sharpness of each are added to `quality`.
    """
    index = footage_index(inputs.open(f"ingest/{inputs.sources['camera']}"))
    with open_video(inputs.file("video"), index) as video:
        shown = readable_at(video, _pictures(inputs))
        for frame, picture in zip(inputs.frames.tolist(), shown, strict=True):
            quality.append(measure_image(picture))
            yield frame, picture


def measure_image(picture: Image | None) -> tuple[float, float]:
    """Return brightness and sharpness of an image (height, width, 3), as of `IMAGE_ARRAYS`."""
    if picture is None:
        return np.nan, np.nan
    rows = picture[::16, :, 1].astype(np.float32)  # a few rows tell as much as all
    return float(rows.mean()), float(np.abs(np.diff(rows, axis=1)).mean())


def footage_index(footage: xr.Dataset) -> FrameIndex:
    """Return the frame index of a video, as `ingest` stored it."""
    video = footage.attrs["video"]
    width, height = video["size"]
    time_base = None if video["time_base"] is None else Fraction(*video["time_base"])
    return FrameIndex(
        footage["picture_stamp"].values,
        footage["picture_key"].values,
        time_base,
        (width, height),
        is_counted=video.get("is_counted", False),
    )


def _open_place(inputs: UnitInputs) -> Place | None:
    """Return the camera, on the pitch if there is one; None if it is not known."""
    pitch, name = inputs.pitch, f"static_calibration/{inputs.sources['camera']}"
    if name not in inputs:
        return None
    venue = join_cameras([inputs.open(name).data_vars])
    if pitch is not None and venue.surface is not None:
        pitch = pitch.with_surface(venue.surface.shape)
    return Place(venue.cameras[0], pitch)


def require_weights(settings: DetectionSettings, planned: dict[str, str | None]) -> None:
    """Refuse weights or libraries that differ from the run plan."""
    found = weights_of(settings)
    if found != planned:
        names = sorted(name for name in planned if found.get(name) != planned[name])
        raise InputError(
            f"detection: {', '.join(names)}",
            expected="the weights and libraries that the run was planned with",
            found="others",
            todo="Give all workers the same files and libraries, restart them, and run again.",
        )
