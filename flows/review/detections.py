"""Current detections of a camera: given or detected, with all corrections since."""

from __future__ import annotations

import uuid
from collections.abc import Sequence
from dataclasses import dataclass
from datetime import UTC, datetime
from typing import TYPE_CHECKING

from pydantic import JsonValue

from data_contracts.keypoints import KeypointDetections
from data_contracts.review import Acceptance, Edit
from flows.review.edit_conflicts import StaleEditError, edits_since
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
from worldpose.store.recipes import recipe_key
from worldpose.store.store import Store

if TYPE_CHECKING:
    import xarray as xr

    from worldpose.review.evidence import OpenDetections


def detections_now(store: Store, match: Match, camera: str, frame: int) -> KeypointDetections:
    """Return a camera's corrected detections in one match frame; no row if the camera has no frame.

    Args:
        store: the store.
        match: the match with all corrections.
        camera: a static camera, or the clip of a broadcast camera.
        frame: match frame.

    Raises:
        InputError: the latest run has no detections of this camera in this frame, or only with a
            correction that was withdrawn since.
    """
    stored, taken_in = _open_stored(store, match, camera, frame)
    row = stored.sel(frame=slice(frame, frame))
    found = KeypointDetections.from_arrays(row)
    said = [edit for edit in edits_by_camera(match).get(camera, ()) if edit.frame == frame]
    later = edits_since(said, taken_in, f"{camera}, frame {frame}", match.match_id)
    return replay_detections(found, later).observations


def require_seen(store: Store, match: Match, edits: Sequence[Edit]) -> None:
    """Refuse corrections that do not fit the cameras' current, corrected detections.

    Raises:
        StaleEditError: another person changed the detection, or the edit never fitted.
    """
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
            raise _stale(edit, objection)
        found[place] = replay_detections(found[place], [edit]).observations


def _stale(edit: DetectionEdit, objection: str) -> StaleEditError:
    error = StaleEditError(
        f"{edit.camera}, frame {edit.frame}, {edit.kind}",
        expected="a correction that fits the current detections",
        found=objection,
        todo="Load the frame again and repeat the correction if it is still needed.",
    )
    error.difference = {"camera": edit.camera, "frame": edit.frame, "now": objection}
    return error


def results_of(
    store: Store, match: Match, camera: str, frame: int | None = None
) -> tuple[str, ...]:
    """Return the latest run's results with a camera's detections, as `stage/unit`.

    Args:
        store: the store.
        match: the match.
        camera: a static camera, or the clip of a broadcast camera.
        frame: only clips with this match frame; None = all clips.

    Raises:
        InputError: there are no such results.
    """
    spec = match.folder.spec
    clips = [
        clip
        for clip in spec.clips
        if frame is None or 0 <= frame - clip.first_frame < clip.frame_count
    ]
    names: list[str] = []
    if camera in {each.id for each in spec.static_cameras}:
        names = [seen_by(match, camera, clip.id) for clip in clips]
    elif camera in {clip.id for clip in clips}:
        names = [*seen_in_broadcast(match, camera)]
    results = store.run(match.match_id).results if store.runs(match.match_id) else {}
    found = tuple(dict.fromkeys(name for name in names if name in results))
    if not found:
        place = f"{match.match_id}, {camera}"
        raise InputError(
            place if frame is None else f"{place}, frame {frame}",
            expected="detections of this camera in the latest run",
            found="none",
            todo=f"Run the match first: worldpose run {match.match_id}.",
        )
    return found


def stored_people(store: Store, match: Match, name: str) -> tuple[xr.Dataset, str]:
    """Return a camera's detections by `stage/unit`, and their key without corrections."""
    stored = _result(store, match, name)
    return stored.result, stored.plain


def _open_stored(
    store: Store, match: Match, camera: str, frame: int
) -> tuple[xr.Dataset, list[JsonValue]]:
    """Return the result that contains one frame of one camera, and its edits of that frame."""
    stored = _result(store, match, results_of(store, match, camera, frame)[0])
    here = [each for each in stored.edits if isinstance(each, dict) and each["frame"] == frame]
    return stored.result, list(here)


@dataclass(frozen=True, eq=False)
class _Result:
    """One camera's stored detections.

    Attributes:
        result: without corrections if that version is stored.
        plain: key of the result without corrections.
        edits: the corrections that it contains.
    """

    result: xr.Dataset
    plain: str
    edits: list[JsonValue]


def _result(store: Store, match: Match, name: str) -> _Result:
    """Return a result of the latest run, by `stage/unit`."""
    stage, _, unit = name.partition("/")
    match_id = match.match_id
    key = store.run(match_id).results[name]
    recipe = store.manifest(match_id, stage, unit, key).recipe
    sources = dict(recipe.sources)
    taken_in = sources.pop("edits", None) or []
    assert isinstance(taken_in, list)
    plain = recipe_key(recipe.model_copy(update={"sources": sources}))
    if store.has(match_id, stage, unit, plain):
        return _Result(store.open_result(match_id, stage, unit, plain), plain, [])
    return _Result(store.open_result(match_id, stage, unit, key), plain, taken_in)


def left_to_look_at(store: Store, match: Match, camera: str) -> list[OpenDetections]:
    """Return the detections that no person has accepted or corrected, by result of the camera.

    Args:
        store: the store.
        match: the match with its journal.
        camera: a static camera, or the clip of a broadcast camera.

    Raises:
        InputError: the latest run has no detections of this camera.
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
        result, plain = stored_people(store, match, name)
        accepted = [each for each in said if each.results.get(name) == plain]
        found.append(
            open_detections(result["frame"].values, result["score"].values, accepted, edits)
        )
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

    Args:
        store: the store that holds the journal.
        match: the match.
        camera: a static camera, or the clip of a broadcast camera.
        at_least: accept every detection with at least this score [1]; None = only those in
            `people`.
        people: match frame, and index among the detections of the frame.
        who: name of the reviewer.

    Raises:
        InputError: the latest run has no detections of this camera.
    """
    names = results_of(store, match, camera)
    acceptance = Acceptance(
        id=f"acceptance.{uuid.uuid4().hex[:12]}",
        match_id=match.match_id,
        results={name: stored_people(store, match, name)[1] for name in names},
        at_least=at_least,
        people=tuple(people),
        who=who,
        accepted_at=datetime.now(UTC),
    )
    say(store, match.match_id, lambda journal: [acceptance])
    return acceptance
