"""Detections of a camera in one frame: boxes and keypoints for review and correction (D4, D6)."""

from __future__ import annotations

from typing import Any, Final

import numpy as np
from fastapi import APIRouter, HTTPException
from fastapi.responses import Response
from numpy.typing import NDArray
from pydantic import Field

from data_contracts.conventions import COCO17, COCO17_BONES
from data_contracts.keypoints import KeypointDetections
from data_contracts.records import DetectionIndex, Frame, Record
from flows.reports.match_pictures import frame_picture
from flows.review.detections import accept, detections_now, left_to_look_at
from flows.stage import Match
from flows.web.app_context import PageContext, Person
from worldpose.errors import InputError
from worldpose.store.store import Store

MAX_LISTED: Final = 60
"""Maximum number of listed detections to review."""
MAX_ACCEPTED: Final = 500
"""Maximum number of detections accepted by name at once."""


class Accepting(Record):
    """Detections that a person accepts."""

    at_least: float | None = Field(default=None, ge=0, le=1)
    """Accept every detection with at least this score [1]; None = only those in `people`."""
    people: tuple[tuple[Frame, DetectionIndex], ...] = Field(default=(), max_length=MAX_ACCEPTED)
    """Match frame, and index among the detections of the frame."""


def routes(context: PageContext) -> APIRouter:
    """Create the routes of the detections in one frame of a static or broadcast camera."""
    router = APIRouter(prefix="/api/matches/{match_id}/detections/{owner}")

    @router.get("")
    def detections(match_id: str, owner: str, frame: int | None = None) -> dict[str, Any]:
        match = context.match(match_id)
        spec = match.folder.spec
        frames = [
            [clip.first_frame, clip.first_frame + clip.frame_count - 1]
            for clip in spec.clips
            if owner in (clip.id, *(camera.id for camera in spec.static_cameras))
        ]
        if not frames:
            raise HTTPException(404, "no such camera")
        frame = frames[0][0] if frame is None else frame
        return {
            "frame": frame,
            "frames": frames,
            "size": _size(match, owner),
            "has_picture": owner in match.folder.videos,
            "joints": COCO17,
            "bones": COCO17_BONES,
            **_describe_detections(detections_now(context.store, match, owner, frame)),
            "cameras": [camera.id for camera in spec.static_cameras],
        }

    @router.get("/image")
    def image(match_id: str, owner: str, frame: int) -> Response:
        import cv2  # imported here: few pages decode an image

        try:
            picture = frame_picture(context.store, context.match(match_id), owner, frame)
        except InputError as error:
            raise HTTPException(404, error.found) from error
        if picture is None:
            raise HTTPException(404, "there is no image of this frame")
        content = cv2.imencode(".jpg", cv2.cvtColor(picture, cv2.COLOR_RGB2BGR))[1]
        return Response(bytes(content), media_type="image/jpeg")

    @router.get("/queue")
    def queue(match_id: str, owner: str) -> dict[str, Any]:
        return _queue(context.store, context.match(match_id), owner)

    @router.post("/acceptances")
    def take(match_id: str, owner: str, given: Accepting, who: Person) -> dict[str, Any]:
        match = context.match(match_id)
        people, at_least = given.people, given.at_least
        accept(context.store, match, owner, at_least=at_least, people=people, who=who)
        return _queue(context.store, context.match(match_id), owner)

    return router


def _queue(store: Store, match: Match, owner: str) -> dict[str, Any]:
    """Count a camera's unreviewed detections, and list the least certain of them."""
    left = left_to_look_at(store, match, owner)
    rows = sorted(
        (float(score), int(frame), int(detection))
        for each in left
        for frame, detection, score in zip(
            each.frame[:MAX_LISTED],
            each.detection[:MAX_LISTED],
            each.score[:MAX_LISTED],
            strict=True,
        )
    )
    return {
        "left": sum(len(each.frame) for each in left),
        "people": sum(each.people for each in left),
        "next": [
            {"frame": frame, "detection": detection, "score": round(score, 3)}
            for score, frame, detection in rows[:MAX_LISTED]
        ],
    }


def _size(match: Match, owner: str) -> tuple[int, int]:
    spec = match.folder.spec
    broadcast = {clip.id: clip.broadcast for clip in spec.clips if clip.broadcast is not None}
    camera = spec.camera(broadcast.get(owner, owner))
    return camera.width, camera.height


def _describe_detections(found: KeypointDetections) -> dict[str, Any]:
    """Return all detections of the first row, and the index for an added person."""
    there = np.isfinite(found.score[:1]).any(axis=0)
    occupied = np.flatnonzero(there)
    free = int(occupied[-1]) + 1 if len(occupied) else 0
    return {"people": _people(found), "free": free}


def _people(found: KeypointDetections) -> list[dict[str, Any]]:
    """Return all detections of the first row, the least certain first."""
    if not len(found.frame):
        return []
    there = np.flatnonzero(np.isfinite(found.score[0]))
    return [
        {
            "detection": int(k),
            "score": round(float(found.score[0, k]), 3),
            "box": _numbers(found.boxes[0, k]),
            "keypoints": [_numbers(place) for place in found.keypoints[0, k]],
            "confidence": [None if np.isnan(c) else round(float(c), 3) for c in confidence],
        }
        for k in there[np.argsort(found.score[0, there], kind="stable")]
        for confidence in (found.confidence[0, k],)
    ]


def _numbers(values: NDArray[np.float32]) -> list[float] | None:
    return None if np.isnan(values).any() else [round(float(value), 3) for value in values]
