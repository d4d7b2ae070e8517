"""Current detections of a camera: given or detected, with all corrections since."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING

from pydantic import JsonValue

from data_contracts.keypoints import KeypointDetections
from data_contracts.review import Edit
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
from worldpose.store import Store, recipe_key

if TYPE_CHECKING:  # imports dask, which planning a run must not load
    import xarray as xr


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
    stored, taken_in = _stored(store, match, camera, frame)
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
            found[place] = detections_now(store, match, *place)
        objection = (
            find_objection(found[place], edit) if len(found[place].frame) else "no such frame"
        )
        if objection is not None:
            raise _stale(edit, objection)
        found[place] = replay_detections(found[place], [edit]).observations


def _stale(edit: DetectionEdit, objection: str) -> StaleEditError:
    error = StaleEditError(
        f"{edit.camera}, frame {edit.frame}, {edit.kind}",
        expected="a correction that fits what is seen by now",
        found=objection,
        todo="Look at it again.",
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
        InputError: there are none.
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
            expected="people seen there in the latest run",
            found="none",
            todo=f"Run it first: worldpose run {match.match_id}.",
        )
    return found


def stored_people(store: Store, match: Match, name: str) -> tuple[xr.Dataset, str]:
    """Return a camera's detections by `stage/unit`, and their key without corrections."""
    stored = _result(store, match, name)
    return stored.result, stored.plain


def _stored(
    store: Store, match: Match, camera: str, frame: int
) -> tuple[xr.Dataset, list[JsonValue]]:
    """Return the result with a frame of a camera, and the edits of that frame that it contains."""
    stored = _result(store, match, results_of(store, match, camera, frame)[0])
    here = [each for each in stored.edits if isinstance(each, dict) and each["frame"] == frame]
    return stored.result, list(here)


@dataclass(frozen=True, eq=False)
class _Result:
    """Stored detections of a camera.

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
    key = store.run(match.match_id).results[name]
    place = (match.match_id, stage, unit)
    recipe = store.manifest(*place, key).recipe
    sources = dict(recipe.sources)
    taken_in = sources.pop("edits", None) or []
    assert isinstance(taken_in, list)
    plain = recipe_key(recipe.model_copy(update={"sources": sources}))
    if store.has(*place, plain):
        return _Result(store.open_result(*place, plain), plain, [])
    return _Result(store.open_result(*place, key), plain, taken_in)
