"""Task of stage `ingest`: store one camera's 2D poses, or the index of its video."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
from pydantic import TypeAdapter

from data_contracts.ingest import INGEST
from data_contracts.keypoints import KeypointDetections
from data_contracts.work import Work
from tasks.unit import require_registered, unit_task
from worldpose.formats.keypoint_files import read_observations
from worldpose.ingest.footage import Footage, UnitFrames, read_footage
from worldpose.review.detections import DetectionEdit, replay_detections
from worldpose.store.store import Store
from worldpose.store.writer import ResultWriter


@unit_task
def ingest(work: Work) -> str:
    """Publish the observations or the index; return the key."""
    with Store.open(work.project).publish(work) as result:
        if "detections" in work.recipe.sources:
            _write_observations(result, work)
        else:
            _write_footage(result, work)
    return work.key


def _write_observations(result: ResultWriter, work: Work) -> None:
    observations = _observations(work)
    if "edits" in work.recipe.sources:
        edits = TypeAdapter(list[DetectionEdit]).validate_python(work.recipe.sources["edits"])
        replay = replay_detections(observations, edits)
        observations = replay.observations
        result.figures["corrections_refused"] = float(sum(map(bool, replay.objections)))
    result.write(
        INGEST,
        arrays=observations.arrays(),
        coordinates={"frame": observations.frame},
        attributes={"camera_id": work.recipe.unit, "video": None, **observations.labels()},
    )
    result.figures["frames"] = observations.frame.size
    result.figures["detections"] = int(np.isfinite(observations.score).sum())


def _write_footage(result: ResultWriter, work: Work) -> None:
    footage = _footage(work)
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
            "camera_id": work.recipe.unit,
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


def _observations(work: Work) -> KeypointDetections:
    """Read the unit's 2D poses on match frames, and verify that the file matches the key.

    Raises:
        InputError: the file differs from the registered one.
    """
    sources: dict[str, Any] = work.recipe.sources
    path = Path(work.folder) / sources["detections"]
    ranges = [(first + sources["offset_frames"], count) for first, count in sources["ranges"]]
    observations = read_observations(path, ranges)
    require_registered(path, sources["detections_sha256"])
    return replace(observations, frame=observations.frame - sources["offset_frames"])


def _footage(work: Work) -> Footage:
    """Index the unit's video on match frames; raises like `_observations`."""
    sources: dict[str, Any] = work.recipe.sources
    path = Path(work.folder) / sources["video"]
    width, height = sources["image_size"]
    footage = read_footage(
        path,
        float(sources["fps"]),
        (width, height),
        UnitFrames(sources["first_frame"], sources["frame_count"], sources["offset_frames"]),
        [(clip, first, count) for clip, (first, count) in sources["clips"].items()],
    )
    require_registered(path, sources["video_sha256"])
    return footage
