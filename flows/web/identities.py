"""Identities of a clip: presence over time, ground trajectories, and uncertain joins."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any, Final

import numpy as np
from fastapi import APIRouter, HTTPException
from fastapi.responses import Response
from numpy.typing import NDArray

from data_contracts.arrays import Image, find_runs
from data_contracts.conventions import COCO17_HIPS
from data_contracts.review import Correction, SplitTrack
from flows.layers import pitch_of_run
from flows.reports.match_pictures import frame_picture
from flows.review.descriptions import in_words
from flows.review.detections import detections_now
from flows.review.identities import identities_now
from flows.stage import Match
from flows.web.app_context import PageContext
from flows.web.browser_words import in_browser
from flows.web.images import image_response
from worldpose.review.detections import DETECTION_EDITS
from worldpose.review.identities import Identities, find_sighting
from worldpose.store.store import Store, open_run
from worldpose.triangulation.camera_changes import describe_change

if TYPE_CHECKING:
    import xarray as xr

TRAJECTORY_POINTS: Final = 300
"""Points of a person's trajectory that are sent."""
CROP_HALF_HEIGHT: Final = 0.9
"""Half the height of a person's crop, as a multiple of the height of the person's box."""


def routes(context: PageContext) -> APIRouter:
    """Create the routes of the identities in one clip."""
    router = APIRouter(prefix="/api/matches/{match_id}/identities/{clip}")

    def open_identities(match_id: str, clip: str) -> tuple[Match, Identities]:
        match = context.match(match_id)
        if clip not in {each.id for each in match.folder.spec.clips}:
            raise HTTPException(404, "no such clip")
        return match, identities_now(context.store, match, clip).identities

    @router.get("")
    def identities(match_id: str, clip: str) -> dict[str, Any]:
        match, found = open_identities(match_id, clip)
        spec = match.folder.spec
        first = int(found.frame[0])
        step = max(1, len(found.frame) // TRAJECTORY_POINTS)
        run = open_run(context.store.url, match_id)
        pitch = pitch_of_run(run, lambda: match.folder.pitch)
        ways = _ways(found, run[f"tracking/{clip}"])
        return {
            "clip": clip,
            "fps": spec.fps,
            "first_frame": first,
            "frame_count": len(found.frame),
            "step": step,
            "pitch": None if pitch is None else {"length": pitch.length, "width": pitch.width},
            "roster": [{"id": each.id, "name": each.name or each.id} for each in spec.roster],
            "events": _list_events(match, clip, found),
            "has_video": any(camera in match.folder.videos for camera in found.cameras),
            "people": [_person(found, ways, track.person, step) for track in found.tracks],
            "joins": [
                {
                    **join.model_dump(mode="json"),
                    "last_frame": join.last_frame + first,
                    "first_frame": join.first_frame + first,
                }
                for join in found.joins
            ],
        }

    @router.get("/crop")
    def crop(match_id: str, clip: str, person: int, frame: int) -> Response:
        match, found = open_identities(match_id, clip)
        if person not in found.person or frame not in found.frame:
            raise HTTPException(404, "the person is not present")
        return image_response(_crop(context.store, match, found, person, frame), "png")

    return router


def _list_events(match: Match, clip: str, found: Identities) -> list[dict[str, Any]]:
    """Return what happened in frames of the clip: corrections, and cameras that changed."""
    first, last = int(found.frame[0]), int(found.frame[-1])
    events: list[dict[str, Any]] = [
        {
            "kind": "camera",
            "frame": first if change.frame is None else change.frame,
            "words": in_browser(describe_change(change)),
        }
        for change in found.changes
    ]
    corrected: dict[int, list[Correction]] = {}
    for each in match.corrections:
        edit = each.edit
        frame = edit.frame if isinstance(edit, DETECTION_EDITS) else None
        if isinstance(edit, SplitTrack) and edit.clip == clip:
            frame = edit.first_frame_of_new
        if frame is not None and first <= frame <= last:
            corrected.setdefault(frame, []).append(each)
    for frame, made in corrected.items():
        words = in_words(made[-1]) + (f", and {len(made) - 1} more" if len(made) > 1 else "")
        events.append({"kind": "correction", "frame": frame, "words": words})
    return events


def _person(found: Identities, ways: NDArray[np.float64], person: int, step: int) -> dict[str, Any]:
    k = found.person.tolist().index(person)
    views = np.count_nonzero(found.detection_index[:, :, k] >= 0, axis=1)
    first = int(found.frame[0])
    seen = find_sighting(found, person)
    return {
        "id": person,
        "name": found.names.get(person),
        "seen": None if seen is None else seen.model_dump(),
        "segments": [[first + run.start, first + run.stop - 1] for run in find_runs(views > 0)],
        "views": round(float(views[views > 0].mean()), 1),
        "way": [
            None if np.isnan(place).any() else np.round(place, 2).tolist()
            for place in ways[::step, k]
        ],
    }


def _ways(found: Identities, tracked: xr.Dataset) -> NDArray[np.float64]:
    """Return the ground positions (frames, persons, 2) [m]: mid-hips or feet, NaN if unknown.

    The tracks of the latest run have the places of feet.
    """
    hips = found.joints[:, :, COCO17_HIPS, :2].astype(np.float64)
    known = np.asarray(np.isfinite(hips).all(axis=3))
    total = np.where(known[..., None], hips, 0.0).sum(axis=2)
    count = known.sum(axis=2)[..., None]
    ways = np.where(count > 0, total / np.maximum(count, 1), np.nan)
    if "ground" not in tracked:
        return ways
    ground, stored = tracked["ground"].values, tracked["detection_index"].values
    for k in np.flatnonzero(found.on_plane.any(axis=0)):
        own = found.detection_index[:, :, k, None]
        is_same = ((stored == own) & (own >= 0)).any(axis=1)  # (frames, tracked people)
        feet = ground[np.arange(len(ground)), is_same.argmax(axis=1)]
        is_placed = found.on_plane[:, k] & is_same.any(axis=1) & np.isnan(ways[:, k, 0])
        ways[is_placed, k] = feet[is_placed]
    return ways


def _crop(store: Store, match: Match, found: Identities, person: int, frame: int) -> Image:
    """Return one person from the view with the largest image of the person."""
    import cv2  # imported here: few pages decode an image

    k, f = found.person.tolist().index(person), int(np.searchsorted(found.frame, frame))
    best: tuple[float, str, NDArray[np.float32]] | None = None
    for c, name in enumerate(found.cameras):
        detection = int(found.detection_index[f, c, k])
        if detection < 0 or name not in match.folder.videos:
            continue
        box = detections_now(store, match, name, frame).boxes[0, detection]
        tall = float(box[3] - box[1])
        if np.isfinite(tall) and (best is None or tall > best[0]):
            best = (tall, name, box)
    if best is None:
        raise HTTPException(404, "no video shows this person")
    tall, name, box = best
    picture = frame_picture(store, match, name, frame)
    if picture is None:
        raise HTTPException(404, "there is no image of this frame")
    half = max(16, round(CROP_HALF_HEIGHT * tall))
    x, y = np.round((box[:2] + box[2:]) / 2.0).astype(int)
    piece = picture[max(0, y - half) : y + half, max(0, x - half) : x + half]
    if not piece.size:
        raise HTTPException(404, "the person is out of the picture")
    sized = cv2.resize(piece, None, fx=200 / (2 * half), fy=200 / (2 * half))
    return np.asarray(sized, dtype=np.uint8)
