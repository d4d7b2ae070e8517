"""Stage `refitting`: one unit per clip with broadcast detections or shared players (S1, S4).

Without static cameras: one unit per clip whose people are tracked and that has monocular poses.
"""

from __future__ import annotations

from pydantic import JsonValue

from data_contracts.records import Record
from flows.stage import Match, Stage, once_a_match
from flows.stages import (
    body_fitting,
    broadcast_calibration,
    broadcast_pooling,
    broadcast_tracking,
    detection,
    tracking,
)
from worldpose.body.body_file import OPEN_BODY
from worldpose.ingest.footage import unit_frames


class RefittingSettings(Record):
    """Bodies of triangulated people are refitted with the settings of `body_fitting`."""

    body_model: str = OPEN_BODY
    """Body model of people in a match without static cameras, which `body_fitting` has no units
    for: the open body, or one installed with `worldpose body install`."""


@once_a_match
def units(match: Match) -> tuple[str, ...]:
    """Return clips with broadcast camera and detections, and those with players of other clips.

    Without static cameras these are the clips with tracked people and monocular poses.
    """
    if not match.has_static_cameras:
        tracked = broadcast_tracking.units(match)
        return tuple(clip for clip in tracked if clip in match.folder.estimates)
    clips = (clip.id for clip in match.folder.spec.clips)
    return tuple(clip for clip in clips if _is_broadcast(match, clip) or _namesakes(match, clip))


def inputs(match: Match, unit: str) -> tuple[str, ...]:
    """Return `body_fitting`, its inputs, the broadcast camera, and other clips' shapes.

    Without static cameras: the broadcast camera, its detections and the tracks on the pitch.
    """
    if not match.has_static_cameras:
        return (*broadcast_tracking.inputs(match, unit), f"broadcast_tracking/{unit}")
    names = [*body_fitting.inputs(match, unit), f"body_fitting/{unit}"]
    if _is_broadcast(match, unit):
        names += [f"broadcast_calibration/{unit}", *detection.seen_in_broadcast(match, unit)]
    if _is_broadcast(match, unit) and unit in broadcast_pooling.units(match):
        names.append(f"broadcast_pooling/{unit}")
    return (*names, *(f"body_fitting/{clip}" for clip in _namesakes(match, unit)))


def sources(match: Match, unit: str) -> dict[str, JsonValue]:
    """Return the clip, monocular poses of the broadcast video, its clock, and the identities."""
    folder = match.folder
    clip = folder.spec.clip(unit)
    file = folder.estimates.get(unit) if _is_broadcast(match, unit) else None
    path = None if file is None else file.relative_to(folder.folder).as_posix()
    estimated: dict[str, JsonValue] = {
        "estimates": path,
        "estimates_sha256": None if path is None else match.registration.digest_of(path),
        "offset_frames": unit_frames(folder.spec, unit).offset,
    }
    if not match.has_static_cameras:
        return {**broadcast_tracking.sources(match, unit), **estimated}
    named = {unit: clip.people, **_namesakes(match, unit)}
    return {
        **body_fitting.sources(match, unit),
        **estimated,
        "seen_in_broadcast": next(iter(detection.seen_in_broadcast(match, unit)), None),
        "broadcast_offset_frames": clip.broadcast_offset_frames,
        "people": {
            name: {str(person): player for person, player in sorted(people.items())}
            for name, people in named.items()
        },
    }


def _is_broadcast(match: Match, unit: str) -> bool:
    """Return whether a broadcast camera is calibrated, and has detections."""
    seen = detection.seen_in_broadcast(match, unit)
    return bool(seen) and unit in broadcast_calibration.units(match)


def _namesakes(match: Match, unit: str) -> dict[str, dict[int, str]]:
    """Return a clip's players in other clips: clip to their person ids and names there."""
    clips = match.folder.spec.clips
    here = set(match.folder.spec.clip(unit).people.values())
    there = {
        clip.id: {person: name for person, name in clip.people.items() if name in here}
        for clip in clips
        if clip.id != unit
    }
    return {clip: people for clip, people in there.items() if people}


def outside(settings: RefittingSettings) -> dict[str, JsonValue]:
    """Return the digest of an installed body model, as `body_fitting.outside`."""
    return body_fitting.digest_of_model(settings.body_model)


def filtering_inputs(match: Match, unit: str) -> tuple[str, ...]:
    """Return the filtering results of the clip's detections; none without static cameras."""
    return tracking.filtering_inputs(match, unit) if match.has_static_cameras else ()


STAGE = Stage(
    name="refitting",
    about="fit bodies again with the broadcast camera and other clips",
    settings=RefittingSettings,
    units=units,
    inputs=inputs,
    sources=sources,
    previous_pass_inputs=filtering_inputs,
    late_inputs=tracking.found_again,
    external_inputs=outside,
)
