"""Whom a camera saw in one frame: boxes and keypoints to be looked at and corrected (D4, D6)."""

from __future__ import annotations

from typing import Any

import numpy as np
from fastapi import APIRouter, HTTPException
from fastapi.responses import Response
from numpy.typing import NDArray

from data_contracts.conventions import COCO17, COCO17_BONES
from flows.detections import detections_now
from flows.pages.desk import Desk
from flows.stage import Match
from worldpose.errors import InputError
from worldpose.ingest import Observations, unit_frames
from worldpose.video import open_video


def routes(desk: Desk) -> APIRouter:
    """Routes of the people in one frame of a static camera, or of a clip's broadcast camera."""
    router = APIRouter(prefix="/api/matches/{match_id}/detections/{owner}")

    @router.get("")
    def detections(match_id: str, owner: str, frame: int | None = None) -> dict[str, Any]:
        match = desk.match(match_id)
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
            "people": _people(detections_now(desk.store, match, owner, frame)),
            "cameras": [camera.id for camera in spec.static_cameras],
        }

    @router.get("/image")
    def image(match_id: str, owner: str, frame: int) -> Response:
        import cv2  # late: few pages open a picture

        match = desk.match(match_id)
        if owner not in match.folder.videos:
            raise HTTPException(404, "there is no video")
        number = frame + unit_frames(match.folder.spec, owner).offset
        with open_video(match.folder.videos[owner]) as video:
            if not 0 <= number < len(video):
                raise HTTPException(404, "the video has no such frame")
            try:
                picture = video.frame(number)
            except InputError as error:
                raise HTTPException(404, error.found) from error
        content = cv2.imencode(".jpg", cv2.cvtColor(picture, cv2.COLOR_RGB2BGR))[1]
        return Response(bytes(content), media_type="image/jpeg")

    return router


def _size(match: Match, owner: str) -> tuple[int, int]:
    spec = match.folder.spec
    broadcast = {clip.id: clip.broadcast for clip in spec.clips if clip.broadcast is not None}
    camera = spec.camera(broadcast.get(owner, owner))
    return camera.width, camera.height


def _people(found: Observations) -> list[dict[str, Any]]:
    """Everybody in the first row, the least certain first."""
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
