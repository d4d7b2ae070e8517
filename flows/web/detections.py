"""Detections of a camera in one frame: review, correction, and other cameras' views."""

from __future__ import annotations

import uuid
from collections.abc import Hashable, Iterable
from dataclasses import dataclass
from functools import lru_cache
from typing import Any, Final

import numpy as np
from fastapi import APIRouter, HTTPException
from fastapi.responses import Response
from numpy.typing import NDArray
from pydantic import Field

from data_contracts.conventions import COCO17, COCO17_BONES
from data_contracts.keypoints import KeypointDetections
from data_contracts.records import DetectionIndex, Frame, Name, Record
from data_contracts.review import MovedKeypoint
from flows.reports.match_pictures import frame_picture
from flows.results.run_cameras import static_cameras
from flows.review.corrections import keep_edits
from flows.review.detections import accept, detections_now, left_to_look_at
from flows.review.identities import identities_now
from flows.stage import Match
from flows.stages.ingest import edits_by_camera
from flows.web.app_context import PageContext, Person
from flows.web.browser_words import describe_error
from flows.web.images import image_response
from worldpose.errors import InputError
from worldpose.geometry.cameras import Camera
from worldpose.review.evidence import check_views, epipolar_curves
from worldpose.review.identities import Identities
from worldpose.store.store import Store, open_run

MAX_LISTED: Final = 60
"""Maximum number of listed detections to review."""
MAX_INTERPOLATED: Final = 100
"""Maximum number of frames between two corrections that are filled in."""
MAX_ACCEPTED: Final = 500
"""Maximum number of detections accepted by name at once."""


class Accepting(Record):
    """Detections that a person accepts."""

    at_least: float | None = Field(default=None, ge=0, le=1)
    """Accept every detection with at least this score [1]; None = only those in `people`."""
    people: tuple[tuple[Frame, DetectionIndex], ...] = Field(default=(), max_length=MAX_ACCEPTED)
    """Match frame, and index among the detections of the frame."""


class Interpolating(Record):
    """A keypoint that moves along a line from its last correction to a frame."""

    frame: Frame
    detection: DetectionIndex
    joint: Name


def routes(context: PageContext) -> APIRouter:
    """Create the routes of the detections in one frame of a static or broadcast camera."""
    router = APIRouter(prefix="/api/matches/{match_id}/detections/{owner}")

    @router.get("")
    def detections(match_id: str, owner: str, frame: int | None = None) -> dict[str, Any]:
        match = context.match(match_id)
        spec = match.folder.spec
        frames = [
            [clip.first_frame, clip.first_frame + clip.frame_count - 1]
            for clip in spec.clips_of(owner)
        ]
        camera = spec.filming_camera(owner)
        if camera is None:
            raise HTTPException(404, "no such camera")
        frame = frames[0][0] if frame is None else frame
        return {
            "frame": frame,
            "frames": frames,
            "size": (camera.width, camera.height),
            "has_picture": owner in match.folder.videos,
            "joints": COCO17,
            "bones": COCO17_BONES,
            **_read_frame(context.store, match, owner, frame),
            "cameras": [camera.id for camera in spec.static_cameras],
        }

    @router.get("/image")
    def image(match_id: str, owner: str, frame: int) -> Response:
        try:
            picture = frame_picture(context.store, context.match(match_id), owner, frame)
        except InputError as error:
            raise HTTPException(404, error.found) from error
        if picture is None:
            raise HTTPException(404, "there is no image of this frame")
        return image_response(picture, "jpeg")

    @router.get("/queue")
    def queue(match_id: str, owner: str) -> dict[str, Any]:
        return _queue(context.store, context.match(match_id), owner)

    @router.post("/acceptances")
    def take(match_id: str, owner: str, given: Accepting, who: Person) -> dict[str, Any]:
        match = context.match(match_id)
        people, at_least = given.people, given.at_least
        accept(context.store, match, owner, at_least=at_least, people=people, who=who)
        return _queue(context.store, context.match(match_id), owner)

    @router.post("/interpolation")
    def interpolate(
        match_id: str, owner: str, given: Interpolating, who: Person
    ) -> dict[str, list[str]]:
        edits = _interpolate(context.store, context.match(match_id), owner, given)
        named = {f"moved_keypoint.{uuid.uuid4().hex[:16]}": edit for edit in edits}
        note = "placed along a line"
        keep_edits(context.store, lambda: context.match(match_id), named, who=who, note=note)
        return {"kept": [*named]}

    _add_views(router, context)
    return router


def _interpolate(
    store: Store, match: Match, camera: str, given: Interpolating
) -> list[MovedKeypoint]:
    """Return the edits between the last correction of a person's keypoint and a frame.

    The person's track tells the detections in between; frames without one are skipped, and so are
    those in which the keypoint was corrected to be invisible. InputError if the detection has no
    track, or no earlier correction is of this keypoint.
    """
    clips = match.folder.spec.clips_with(given.frame)
    found = identities_now(store, match, clips[0].id).identities if clips else None
    number = {} if found is None else {int(frame): row for row, frame in enumerate(found.frame)}
    if found is None or camera not in found.cameras or given.frame not in number:
        raise InputError(
            f"{camera}, frame {given.frame}",
            expected="a camera and a frame whose people are tracked",
            found="none",
            todo="Fill in between corrections in a static camera's frames.",
        )
    index = found.detection_index[:, found.cameras.index(camera)]
    own = np.flatnonzero(index[number[given.frame]] == given.detection)
    known = {} if not len(own) else dict(zip(number, index[:, own[0]].tolist(), strict=True))
    corrected = {  # the last correction of each frame counts
        edit.frame: edit
        for edit in edits_by_camera(match).get(camera, ())
        if isinstance(edit, MovedKeypoint)
        and edit.joint == given.joint
        and given.frame - MAX_INTERPOLATED <= edit.frame < given.frame
        and known.get(edit.frame) == edit.detection
    }
    hidden = {frame for frame, edit in corrected.items() if edit.xy is None}
    last = corrected.get(max(corrected.keys() - hidden, default=-1))
    shown = detections_now(store, match, camera, given.frame).keypoints[0]
    is_there = given.joint in COCO17 and given.detection < len(shown)
    joint = COCO17.index(given.joint) if is_there else 0
    now = shown[given.detection, joint] if is_there else np.full(2, np.nan)
    if last is None or last.xy is None or not np.isfinite(now).all():
        raise InputError(
            f"{given.joint} of detection {given.detection} in {camera}, frame {given.frame}",
            expected=f"a correction of it in the {MAX_INTERPOLATED} frames before, of one track",
            found="none",
            todo="Correct this keypoint in an earlier frame first, then here.",
        )
    edits = []
    for frame in range(last.frame + 1, given.frame):
        detection = known.get(frame, -1)
        if detection < 0 or frame in hidden:
            continue
        there = detections_now(store, match, camera, frame)
        if np.isnan(there.score[0, detection]):  # a correction deleted it
            continue
        place = there.keypoints[0, detection, joint]
        was = (float(place[0]), float(place[1])) if np.isfinite(place).all() else None
        share = (frame - last.frame) / (given.frame - last.frame)
        x, y = (1.0 - share) * np.asarray(last.xy) + share * np.asarray(now)
        at = {"camera": camera, "frame": frame, "detection": detection, "joint": given.joint}
        edits.append(MovedKeypoint(**at, was=was, xy=(round(float(x), 2), round(float(y), 2))))
    return edits


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
    )[:MAX_LISTED]
    names = _name_people(store, match, owner, [(frame, k) for _, frame, k in rows])
    return {
        "left": sum(len(each.frame) for each in left),
        "people": sum(each.people for each in left),
        "next": [
            {
                "frame": frame,
                "detection": detection,
                "called": names[frame, detection],
                "score": round(score, 3),
            }
            for score, frame, detection in rows
        ],
    }


def _read_frame(store: Store, match: Match, owner: str, frame: int) -> dict[str, Any]:
    """Return the detections of a frame; without any in the latest run, a note about it."""
    try:
        found = detections_now(store, match, owner, frame)
    except InputError as error:  # the image can be looked at
        return {"people": [], "free": 0, "note": describe_error(error)}
    told = _describe_frame(found)
    names = _name_people(
        store, match, owner, [(frame, each["detection"]) for each in told["people"]]
    )
    for each in told["people"]:
        each["called"] = names[frame, each["detection"]]
    return {**told, "note": ""}


def _find_tracks(store: Store, match: Match, owner: str, frame: int) -> Identities | None:
    """Return the tracks of a frame's clip; None if there are none of this camera."""
    clip = next(iter(match.folder.spec.clips_with(frame)), None)
    try:
        found = None if clip is None else identities_now(store, match, clip.id).identities
    except InputError:
        return None  # no tracks yet
    return None if found is None or owner not in found.cameras else found


def _name_people(
    store: Store, match: Match, owner: str, places: Iterable[tuple[int, int]]
) -> dict[tuple[int, int], str]:
    """Return what the page calls people, by frame and detection: as their tracks are called."""
    roster = {each.id: each.name or each.id for each in match.folder.spec.roster}
    clips: dict[tuple[str, ...], Identities | None] = {}
    names = {}
    for frame, detection in places:
        clip = tuple(each.id for each in match.folder.spec.clips_with(frame))
        if clip not in clips:
            clips[clip] = _find_tracks(store, match, owner, frame)
        found, names[frame, detection] = clips[clip], f"detection {detection}"
        if found is None or frame not in found.frame:
            continue
        names[frame, detection] += ", in no track"
        here = found.detection_index[np.searchsorted(found.frame, frame)]
        for person in found.person[here[found.cameras.index(owner)] == detection].tolist():
            name = found.names.get(person, f"person {person}")
            names[frame, detection] = roster.get(name, name)
    return names


def _describe_frame(found: KeypointDetections) -> dict[str, Any]:
    """Return all detections of the first row, the least certain first; index of an added one."""
    score = found.score[0] if len(found.frame) else np.empty(0)
    there = np.flatnonzero(np.isfinite(score))
    people = [
        {
            "detection": int(k),
            "score": round(float(score[k]), 3),
            "box": _numbers(found.boxes[0, k]),
            "keypoints": [_numbers(place) for place in found.keypoints[0, k]],
            "confidence": [
                None if np.isnan(c) else round(float(c), 3) for c in found.confidence[0, k]
            ],
        }
        for k in there[np.argsort(score[there], kind="stable")]
    ]
    return {"people": people, "free": int(there[-1]) + 1 if len(there) else 0}


def _numbers(values: NDArray[np.float32]) -> list[float] | None:
    return None if np.isnan(values).any() else [round(float(value), 3) for value in values]


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


def _add_views(router: APIRouter, context: PageContext) -> None:
    """Add the route of the other cameras' views."""

    @lru_cache(CACHED_PEOPLE)
    def find_group(match_id: str, state: Hashable, owner: str, frame: int, detection: int) -> Group:
        return _group(context, context.match(match_id), owner, frame, detection)

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
        state = (*context.store.runs(match_id)[-1:], len(match.journal.entries))
        group = find_group(match_id, state, owner, frame, detection)
        at = None if x is None or y is None or joint is None else (x, y)
        if owner not in group.names or (joint is not None and not 0 <= joint < len(COCO17)):
            return {"person": None, "views": [], "here": None}
        return _describe_view(match, group, owner, joint, at)


def _group(context: PageContext, match: Match, owner: str, frame: int, detection: int) -> Group:
    """Return a detection's person by tracks and corrections, with its detections in all cameras."""
    cameras = static_cameras(open_run(context.store.url, match.match_id), match.folder.spec)
    names = list(cameras)
    detections = [detection if name == owner else -1 for name in names]
    person, found = None, _find_tracks(context.store, match, owner, frame)
    if found is not None and frame in found.frame:
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
    match: Match, group: Group, owner: str, joint: int | None, at: tuple[float, float] | None
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
