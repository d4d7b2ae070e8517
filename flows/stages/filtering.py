"""Stages `filtering` and `redetection`: detections compared with the bodies.

`filtering` has one unit per clip. `redetection` searches again, from the second iteration on, where
the bodies of the previous one say that people are: one unit per static camera's video and clip.
"""

from __future__ import annotations

from collections.abc import Container

from pydantic import JsonValue

from data_contracts.detection import detection_unit
from flows.stage import Match, Stage, once_a_match
from flows.stages import body_fitting, detection, tracking, triangulation
from worldpose.detection.settings import RedetectionSettings
from worldpose.filtering.settings import FilteringSettings

STAGE = tracking.of_clips(
    name="filtering",
    about="find the keypoints and boxes that bodies contradict",
    settings=FilteringSettings,
    inputs=lambda match, unit: (
        *triangulation.retriangulation_inputs(match, unit),
        f"retriangulation/{unit}",
        body_fitting.last_bodies(match, unit),
    ),
    sources=tracking.clip_sources,
)


@once_a_match
def _searched(match: Match) -> dict[str, tuple[str, str]]:
    """Return the static camera and the clip of each unit: those with detections from a video."""
    spec = match.folder.spec
    return {
        detection_unit(camera.id, clip.id): (camera.id, clip.id)
        for camera in spec.static_cameras
        for clip in spec.clips
        if detection.again(match, camera.id, clip.id)
    }


def redetection_inputs_from_before(match: Match, unit: str) -> tuple[str, ...]:
    """Return the adjusted cameras, the last fitted bodies, and the filtering results."""
    _, clip = _searched(match)[unit]
    placed = (f"{stage}/{clip}" for stage in ("tracking", "triangulation", "retriangulation"))
    bodies = body_fitting.last_bodies(match, clip)
    return ("bundle_adjustment/cameras", *placed, bodies, f"filtering/{clip}")


def redetection_sources(match: Match, unit: str) -> dict[str, JsonValue]:
    """Return camera and clip; `detection` has all other sources."""
    return dict(zip(("camera", "clip"), _searched(match)[unit], strict=True))


def seen_in(run: Container[str], match: Match, camera_id: str, clip_id: str) -> str:
    """Return the result with all of a static camera's people in a clip that a run used.

    `run` has the names of its results, as `stage/unit`.
    """
    again = (name for name in detection.again(match, camera_id, clip_id) if name in run)
    return next(again, detection.seen_by(match, camera_id, clip_id))


REDETECTION = Stage(
    name="redetection",
    task_file="filtering",
    about="look again for people where bodies say they must be",
    settings=RedetectionSettings,
    units=lambda match: tuple(_searched(match)),
    # The index of the video, and the detections.
    inputs=lambda match, unit: (
        f"ingest/{_searched(match)[unit][0]}",
        detection.seen_by(match, *_searched(match)[unit]),
    ),
    sources=redetection_sources,
    previous_pass_inputs=redetection_inputs_from_before,
    first_pass=2,
    worker_tag="GPU",
    needs_static_cameras=True,
)
