"""Other cameras' views of a person in one camera's image (D4, D6)."""

from __future__ import annotations

from dataclasses import dataclass
from threading import Lock
from typing import Any, Final

import numpy as np
from fastapi import APIRouter
from numpy.typing import NDArray

from data_contracts.conventions import COCO17
from flows.results.best_results import static_cameras
from flows.review.detections import detections_now
from flows.review.identities import identities_now
from flows.stage import Match
from flows.web.app_context import PageContext
from worldpose.errors import InputError
from worldpose.geometry.cameras import Camera
from worldpose.review.evidence import check_views, epipolar_curves
from worldpose.store.store import open_run

CACHED_PEOPLE: Final = 8
"""People whose views are kept in memory while a keypoint is dragged."""


@dataclass(frozen=True, eq=False)
class Group:
    """One person in one frame, as all static cameras see the person.

    Attributes:
        person: the tracker's id; None if there is none.
        names: ids of the cameras.
        cameras: the cameras.
        detections: index in each camera's frame; -1 = not detected.
        keypoints: (cameras, 17, 2) [px].
    """

    person: int | None
    names: list[str]
    cameras: list[Camera]
    detections: list[int]
    keypoints: NDArray[np.float64]


def routes(context: PageContext) -> APIRouter:
    """Create the route of the other cameras' views."""
    router = APIRouter(prefix="/api/matches/{match_id}/detections/{owner}")
    known: dict[tuple[Any, ...], Group] = {}
    lock = Lock()

    @router.get("/views")
    def views(
        match_id: str,
        owner: str,
        frame: int,
        detection: int,
        joint: int | None = None,
        x: float | None = None,
        y: float | None = None,
    ) -> dict[str, Any]:
        match = context.match(match_id)
        if owner not in {camera.id for camera in match.folder.spec.static_cameras}:
            return {"person": None, "views": [], "here": None}
        runs = context.store.runs(match_id)
        said = len(match.journal.entries)
        place = (match_id, runs[-1:], said, owner, frame, detection)
        with lock:
            while len(known) >= CACHED_PEOPLE:
                known.pop(next(iter(known)))
            group = known.get(place) or _group(context, match, owner, frame, detection)
            known[place] = group
        at = None if x is None or y is None or joint is None else (x, y)
        if owner not in group.names or (joint is not None and not 0 <= joint < len(COCO17)):
            return {"person": None, "views": [], "here": None}
        return _describe_view(match, group, owner, joint, at)

    return router


def _group(context: PageContext, match: Match, owner: str, frame: int, detection: int) -> Group:
    """Return a detection's person by tracks and corrections, with its detections in all cameras.

    Raises:
        InputError: there is no such detection in the latest run.
    """
    clip = next(
        (
            each
            for each in match.folder.spec.clips
            if 0 <= frame - each.first_frame < each.frame_count
        ),
        None,
    )
    cameras = static_cameras(open_run(context.store.url, match.match_id), match.folder.spec)
    names = list(cameras)
    detections = [detection if name == owner else -1 for name in names]
    person = None
    try:
        found = None if clip is None else identities_now(context.store, match, clip.id).identities
    except InputError:
        found = None  # no tracks yet
    if found is not None and owner in found.cameras and frame in found.frame:
        here = found.detection_index[int(np.searchsorted(found.frame, frame))]
        (who,) = np.nonzero(here[found.cameras.index(owner)] == detection)
        if len(who):
            person = int(found.person[who[0]])
            for c, name in enumerate(found.cameras):
                if name in names:
                    detections[names.index(name)] = int(here[c, who[0]])
    keypoints = np.full((len(names), len(COCO17), 2), np.nan)
    for c, (name, k) in enumerate(zip(names, detections, strict=True)):
        if k >= 0:
            seen = detections_now(context.store, match, name, frame)
            if len(seen.frame) and k < seen.keypoints.shape[1]:
                keypoints[c] = seen.keypoints[0, k]
    return Group(person, names, list(cameras.values()), detections, keypoints)


def _describe_view(
    match: Match,
    group: Group,
    owner: str,
    joint: int | None,
    at: tuple[float, float] | None,
) -> dict[str, Any]:
    own = group.names.index(owner)
    keypoints = group.keypoints.copy()
    if at is not None and joint is not None:
        keypoints[own, joint] = at
    check = check_views(Camera.stack(group.cameras), keypoints)
    place = None if joint is None else keypoints[own, joint]
    views = []
    for c, name in enumerate(group.names):
        if c == own:
            continue
        curves = (
            []
            if place is None or np.isnan(place).any()
            else epipolar_curves(group.cameras[own], group.cameras[c], place)
        )
        theirs = None if joint is None else keypoints[c, joint]
        if group.detections[c] < 0 and not curves:
            continue
        views.append(
            {
                "camera": name,
                "detection": group.detections[c],
                "size": group.cameras[c].image_size.tolist(),
                "has_picture": name in match.folder.videos,
                "keypoints": _places(keypoints[c]),
                "expected": _places(check.expected[c]),
                "error": _errors(check.error[c]),
                "curves": [_places(curve) for curve in curves],
                "curves_here": []
                if theirs is None or np.isnan(theirs).any()
                else [
                    _places(curve)
                    for curve in epipolar_curves(group.cameras[c], group.cameras[own], theirs)
                ],
            }
        )
    here = {"expected": _places(check.expected[own]), "error": _errors(check.error[own])}
    return {"person": group.person, "views": views, "here": here}


def _places(values: NDArray[np.float64]) -> list[list[float] | None]:
    return [None if np.isnan(xy).any() else np.round(xy, 2).tolist() for xy in values]


def _errors(values: NDArray[np.float64]) -> list[float | None]:
    return [None if np.isnan(value) else round(float(value), 2) for value in values]
