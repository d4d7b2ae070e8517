"""Current detections of a camera: given or detected, with all corrections since."""

from __future__ import annotations

import uuid
from collections.abc import Sequence
from datetime import UTC, datetime
from typing import TYPE_CHECKING

import numpy as np
from pydantic import JsonValue, TypeAdapter

from data_contracts.keypoints import KeypointDetections
from data_contracts.review import Acceptance, Edit
from flows.review.edit_conflicts import (
    MOST_REPLAYED,
    StaleEditError,
    StoredResult,
    edits_since,
    open_stored,
    require_results,
)
from flows.stage import Match
from flows.stages.detection import seen_by, seen_in_broadcast
from flows.stages.ingest import edits_by_camera
from worldpose.errors import InputError
from worldpose.review.detections import (
    DETECTION_EDITS,
    DetectionEdit,
    find_objection,
    replay_detections,
)
from worldpose.review.journal import say
from worldpose.store.store import Run, Store

if TYPE_CHECKING:
    from worldpose.review.evidence import OpenDetections


def detections_now(store: Store, match: Match, camera: str, frame: int) -> KeypointDetections:
    """Return the corrected detections in one match frame; no row if the camera has no frame.

    The camera is a static one, or the clip of a broadcast camera; here and below. InputError if the
    latest run has no detections of this camera in this frame, or only with a correction that was
    withdrawn since.
    """
    stored = _open(store, match, results_of(store, match, camera, frame)[0])
    taken_in = [each for each in stored.edits if isinstance(each, dict) and each["frame"] == frame]
    found = KeypointDetections.from_arrays(stored.result.sel(frame=slice(frame, frame)))
    said = [edit for edit in edits_by_camera(match).get(camera, ()) if edit.frame == frame]
    later = edits_since(said, taken_in, f"{camera}, frame {frame}", match.match_id)
    return replay_detections(found, later).observations


def require_seen(store: Store, match: Match, edits: Sequence[Edit]) -> None:
    """Raise StaleEditError for corrections that do not fit the current, corrected detections."""
    found: dict[tuple[str, int], KeypointDetections] = {}
    for edit in edits:
        if not isinstance(edit, DETECTION_EDITS):
            continue
        place = (edit.camera, edit.frame)
        if place not in found:
            found[place] = detections_now(store, match, edit.camera, edit.frame)
        objection = (
            find_objection(found[place], edit) if len(found[place].frame) else "no such frame"
        )
        if objection is not None:
            raise StaleEditError.of_edit(
                f"{edit.camera}, frame {edit.frame}, {edit.kind}",
                *("detections", "frame", objection),
                camera=edit.camera,
                frame=edit.frame,
            )
        found[place] = replay_detections(found[place], [edit]).observations


def objections_in(run: Run, name: str, taken: Sequence[JsonValue]) -> Sequence[str | None]:
    """Return why each correction that a result has `taken` in does not apply; None if it does.

    Results of older versions lack this: it is replayed over the result without corrections.
    """
    told: Sequence[str | None] | None = run[name].attrs.get("objections")
    if told is not None:
        return told
    edits = TypeAdapter(list[DetectionEdit]).validate_python(taken)
    stored = open_stored(run.store, run.record, name, "edits")
    if stored.edits:
        return ["the result does not tell whether it applies: run the match again"] * len(taken)
    edited = np.isin(stored.result["frame"].values, [edit.frame for edit in edits])
    found = KeypointDetections.from_arrays(stored.result.isel(frame=edited))  # all can be many
    return replay_detections(found, edits).objections


def replay_objections(store: Store, match: Match, camera: str) -> dict[int, str | None]:
    """Return why a camera's corrections that its latest results lack do not apply, by their index.

    Those of them that apply have None. Objections to all others are in the results. Of a result
    that lacks more than `MOST_REPLAYED`, there are none. InputError as `detections_now`.
    """
    said = edits_by_camera(match).get(camera, [])
    objections: dict[int, str | None] = {}
    run = store.run(match.match_id)
    for name in results_of(store, match, camera):
        own = [*range(len(said))]
        if not name.startswith("ingest/"):  # which takes in all
            stage, _, unit = name.partition("/")
            result = store.open_result(match.match_id, stage, unit, run.results[name])
            frame = result["frame"].values
            own = [n for n in own if frame[0] <= said[n].frame <= frame[-1]]
        edits = [said[n] for n in own]
        stored = open_stored(store, run, name, "edits", edits)
        later = edits_since(edits, stored.edits, camera, match.match_id)
        if not 0 < len(later) <= MOST_REPLAYED:
            continue
        edited = np.isin(stored.result["frame"].values, [edit.frame for edit in later])
        found = KeypointDetections.from_arrays(stored.result.isel(frame=edited))
        whys = replay_detections(found, later).objections
        objections |= dict(zip(own[len(own) - len(later) :], whys, strict=True))
    return objections


def _open(store: Store, match: Match, name: str) -> StoredResult:
    return open_stored(store, store.run(match.match_id), name, "edits")


def results_of(
    store: Store, match: Match, camera: str, frame: int | None = None
) -> tuple[str, ...]:
    """Return the latest run's results with a camera's detections, as `stage/unit`, or InputError.

    With a match frame, only those of clips that contain it.
    """
    spec = match.folder.spec
    clips = spec.clips if frame is None else spec.clips_with(frame)
    names: list[str] = []
    if camera in {each.id for each in spec.static_cameras}:
        names = [seen_by(match, camera, clip.id) for clip in clips]
    elif camera in {view for clip in clips for view in spec.views_of(clip.id)}:
        names = [*seen_in_broadcast(match, camera)]
    results = store.run(match.match_id).results if store.runs(match.match_id) else {}
    found = tuple(dict.fromkeys(name for name in names if name in results))
    place = camera if frame is None else f"{camera}, frame {frame}"
    require_results(found, place, "detections of this camera", match.match_id)
    return found


def left_to_look_at(store: Store, match: Match, camera: str) -> list[OpenDetections]:
    """Return the detections that no person has accepted or corrected, by result of the camera.

    InputError if the latest run has none of this camera.
    """
    from worldpose.review.evidence import open_detections  # late: it imports the calibration

    said = [each for each in match.journal.records if isinstance(each, Acceptance)]
    edits = [
        correction.edit
        for correction in match.corrections
        if isinstance(correction.edit, DETECTION_EDITS) and correction.edit.camera == camera
    ]
    found = []
    for name in results_of(store, match, camera):
        stored = _open(store, match, name)
        frame, score = (stored.result[key].values for key in ("frame", "score"))
        accepted = [each for each in said if each.results.get(name) == stored.plain]
        found.append(open_detections(frame, score, accepted, edits))
    return found


def accept(
    store: Store,
    match: Match,
    camera: str,
    *,
    at_least: float | None,
    people: Sequence[tuple[int, int]],
    who: str,
) -> Acceptance:
    """Record in the journal that a person accepted detections.

    The person accepts every detection with at least the score `at_least` [1], if it is given, and
    those in `people`: match frame, and index among the detections of the frame. InputError if the
    latest run has no detections of this camera, or not all of `people`.
    """
    names = results_of(store, match, camera)
    opened = {name: _open(store, match, name) for name in names}
    known: set[tuple[int, int]] = set()
    for each in opened.values():
        row, detection = np.nonzero(np.isfinite(each.result["score"].values))
        known.update(
            zip(each.result["frame"].values[row].tolist(), detection.tolist(), strict=True)
        )
    for frame, number in people:
        if (frame, number) not in known:
            raise InputError(
                f"detection {number} of {camera} in frame {frame}",
                expected="a detection of the latest run",
                found="none",
                todo="Load the page again.",
            )
    acceptance = Acceptance(
        id=f"acceptance.{uuid.uuid4().hex[:12]}",
        match_id=match.match_id,
        results={name: each.plain for name, each in opened.items()},
        at_least=at_least,
        people=tuple(people),
        who=who,
        accepted_at=datetime.now(UTC),
    )
    say(store, match.match_id, lambda journal: [acceptance])
    return acceptance
