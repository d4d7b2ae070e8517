"""Stage `refitting`: one unit per clip with broadcast detections or shared players (S1, S4)."""

from __future__ import annotations

from pydantic import JsonValue

from data_contracts.records import Record
from flows.stage import Match, Stage, once_a_match
from flows.stages import body_fitting, broadcast_calibration, broadcast_pooling, detection, tracking
from worldpose.ingest import unit_frames


class RefittingSettings(Record):
    """No settings of its own: bodies are refitted with the settings of `body_fitting`."""


@once_a_match
def units(match: Match) -> tuple[str, ...]:
    """Return clips with broadcast camera and detections, and those with players of other clips.

    Without static cameras there are no bodies to refit.
    """
    if not match.has_static_cameras:
        return ()
    clips = (clip.id for clip in match.folder.spec.clips)
    return tuple(clip for clip in clips if _is_broadcast(match, clip) or _namesakes(match, clip))


def inputs(match: Match, unit: str) -> tuple[str, ...]:
    """Return `body_fitting`, its inputs, the broadcast camera, and other clips' shapes."""
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
    named = {unit: clip.people, **_namesakes(match, unit)}
    return {
        **body_fitting.sources(match, unit),
        "seen_in_broadcast": next(iter(detection.seen_in_broadcast(match, unit)), None),
        "estimates": path,
        "estimates_sha256": None if path is None else match.registration.digest_of(path),
        "offset_frames": unit_frames(folder.spec, unit).offset,
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


STAGE = Stage(
    name="refitting",
    about="fit bodies again with the broadcast camera and other clips",
    settings=RefittingSettings,
    units=units,
    inputs=inputs,
    sources=sources,
    previous_pass_inputs=tracking.filtering_inputs,
    late_inputs=tracking.found_again,
    needs_static_cameras=True,
)
