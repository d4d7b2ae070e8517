"""Click and keypoint outliers of an adjustment, each with the edit that removes it (B3)."""

from __future__ import annotations

import math
from collections.abc import Iterator
from typing import Any, Final

import numpy as np
from fastapi import APIRouter, HTTPException

from data_contracts.conventions import COCO17
from data_contracts.review import DeletedDetection, MovedKeypoint, MovedPoint
from flows.results.best_results import ADJUSTED
from flows.stage import Match
from flows.stages.detection import seen_by
from flows.web.app_context import PageContext
from worldpose.review.clicks import current_value
from worldpose.review.journal import requests_by_id
from worldpose.store.store import Run, open_run

MAX_LISTED: Final = 60
"""Maximum number of listed keypoints, by largest Mahalanobis distance."""
Outlier = tuple[float, str, MovedPoint | MovedKeypoint | DeletedDetection, bool]
"""Mahalanobis distance [standard deviations], subject, edit that removes it, and whether it is
already removed."""


def routes(context: PageContext) -> APIRouter:
    """Create the route of the outliers of the adjustment that a review request refers to."""
    router = APIRouter(prefix="/api/matches/{match_id}/reviews/{request}")

    @router.get("/outliers")
    def outliers(match_id: str, request: str) -> list[dict[str, Any]]:
        match = context.match(match_id)
        asked = requests_by_id(match.journal.questions).get(request)
        if asked is None:
            raise HTTPException(404, "no such review")
        run = open_run(context.store.url, match_id, asked.run_id)
        if ADJUSTED not in asked.keys or ADJUSTED not in run:
            return []
        return [
            {
                "surprise": round(surprise, 1) if math.isfinite(surprise) else None,
                "of": of,
                "edit": edit.model_dump(mode="json"),
                "out": out,
            }
            for surprise, of, edit, out in (*_clicks(run, match), *_keypoints(run, match))
        ]

    return router


def _clicks(run: Run, match: Match) -> Iterator[Outlier]:
    """Yield clicked points proposed for removal."""
    result = run[ADJUSTED]
    names = [str(name) for name in result["camera"].values]
    for k in np.flatnonzero(result["click_wrong"].values):
        camera, marking = (
            names[int(result["click_camera"].values[k])],
            str(result["click"].values[k]),
        )
        edit = MovedPoint(camera=camera, marking=marking, xy=None)
        was = current_value(match.folder, edit)
        surprise = float(result["click_surprise"].values[k])
        yield surprise, "click", edit.model_copy(update={"was": was}), was is None


def _keypoints(run: Run, match: Match) -> Iterator[Outlier]:
    """Yield keypoints, and people in one image, that are outliers to the other cameras."""
    result = run[ADJUSTED]
    names = [str(name) for name in result["camera"].values]
    said = {_place(correction.edit) for correction in match.corrections}
    for k in range(min(MAX_LISTED, result.sizes["outlier"])):
        frame, c, person, joint = (
            int(result[f"outlier_{name}"].values[k])
            for name in ("frame", "camera", "person", "joint")
        )
        clip = next(
            clip.id
            for clip in match.folder.spec.clips
            if 0 <= frame - clip.first_frame < clip.frame_count
        )
        tracks = run[f"tracking/{clip}"].sel(frame=frame, person=person)
        detection = int(tracks["detection_index"].values[c])
        seen = run[seen_by(match, names[c], clip)]
        # The next iteration repeats redetection: these people need no correction.
        if not 0 <= detection < seen.sizes["detection"]:
            continue
        place = {"camera": names[c], "frame": frame, "detection": detection}
        edit: MovedKeypoint | DeletedDetection
        if joint < 0:
            edit = DeletedDetection(**place)
        else:
            pixel = seen["keypoints"].sel(frame=frame).values[detection, joint]
            x, y = (float(value) for value in pixel)
            edit = MovedKeypoint(**place, joint=COCO17[joint], was=(x, y), xy=None)
        surprise = float(result["outlier_surprise"].values[k])
        yield surprise, f"person {person}", edit, _place(edit) in said


def _place(edit: object) -> tuple[object, ...]:
    """Return the target of a detection edit."""
    names = ("kind", "camera", "frame", "detection", "joint")
    return tuple(getattr(edit, name, None) for name in names)
