"""Task of stage `ingest`: store one camera's 2D poses, or the index of its video."""

from __future__ import annotations

import numpy as np
from pydantic import TypeAdapter

from data_contracts.ingest import INGEST
from tasks.unit import UnitInputs, unit_task
from worldpose.errors import InputError
from worldpose.formats.keypoint_files import read_people
from worldpose.ingest.camera_videos import describe_gaps
from worldpose.ingest.footage import UnitFrames, read_footage
from worldpose.ingest.importing import describe_changes
from worldpose.review.detections import DetectionEdit, replay_detections
from worldpose.store.writer import ResultWriter
from worldpose.video.folder import index_video
from worldpose.video.recordings import describe_video


@unit_task
def ingest(inputs: UnitInputs, result: ResultWriter) -> None:
    """Write the 2D poses or the index of the video."""
    if "detections" in inputs.sources:
        _write_observations(inputs, result)
    else:
        _write_footage(inputs, result)


def _write_observations(inputs: UnitInputs, result: ResultWriter) -> None:
    """Write the unit's 2D poses on match frames, with people's corrections."""
    sources = inputs.sources
    file = inputs.file("detections")
    read = read_people(file)
    result.warnings += describe_changes({inputs.unit: read})
    observations = _unit_frames(inputs).place(file, read.people)
    inputs.require_registered("detections")
    objections = {}
    if "edits" in sources:
        edits = TypeAdapter(list[DetectionEdit]).validate_python(sources["edits"])
        replay = replay_detections(observations, edits)
        observations, objections = replay.observations, {"objections": [*replay.objections]}
        result.figures["corrections_refused"] = float(sum(map(bool, replay.objections)))
    result.write(
        INGEST,
        arrays=observations.arrays(),
        coordinates={"frame": observations.frame},
        attributes={
            "camera_id": inputs.unit,
            "video": None,
            "left_out": None,
            **objections,
            **observations.labels(),
        },
    )
    result.figures["frames"] = observations.frame.size
    result.figures["detections"] = int(np.isfinite(observations.score).sum())


def _write_footage(inputs: UnitInputs, result: ResultWriter) -> None:
    """Write the index of the unit's video on match frames, or that it cannot be read."""
    sources, file = inputs.sources, inputs.file("video")
    width, height = sources["image_size"]
    try:
        index = index_video(file)
    except InputError as error:  # one broken video must not end the match
        inputs.require_registered("video")
        reason = str(error).replace(str(file), file.name)
        result.write(
            INGEST,
            arrays={},
            coordinates={"frame": np.empty(0, dtype=np.int64)},
            attributes={"camera_id": inputs.unit, "video": None, "left_out": reason},
        )
        result.left_out[inputs.unit] = reason
        return
    footage = read_footage(
        file,
        float(sources["fps"]),
        (width, height),
        _unit_frames(inputs),
        [(clip, first, count) for clip, (first, count) in sources["clips"].items()],
        index,
    )
    result.warnings += describe_video(file, footage.index)
    if gaps := describe_gaps(footage.picture, footage.frame):
        result.warnings.append(f"{inputs.unit}: {gaps}")
    inputs.require_registered("video")
    base = footage.index.time_base
    result.write(
        INGEST,
        arrays={
            "picture_of_frame": footage.picture,
            "picture_stamp": footage.index.stamps,
            "picture_key": footage.index.key,
        },
        coordinates={"frame": footage.frame},
        attributes={
            "camera_id": inputs.unit,
            "left_out": None,
            "video": {
                "time_base": None if base is None else [base.numerator, base.denominator],
                "size": list(footage.index.size),
                "missing_frames": footage.missing,
                **({"is_counted": True} if footage.index.is_counted else {}),
            },
        },
    )
    result.figures["frames"] = footage.frame.size
    result.figures["pictures"] = len(footage.index)
    result.figures["frames_missing"] = int(np.count_nonzero(footage.picture < 0))


def _unit_frames(inputs: UnitInputs) -> UnitFrames:
    """Return the unit's frames in the match."""
    stated = inputs.sources
    first, count = stated["first_frame"], stated["frame_count"]
    ranges = stated.get("ranges", ())
    return UnitFrames(first, count, stated["offset_frames"], ranges, stated["rate"])
