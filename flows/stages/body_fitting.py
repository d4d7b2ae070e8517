"""Stages `body_fitting` and `refitting`: bodies of one clip each.

`body_fitting` fits them to triangulated joints. `refitting` has the clips with broadcast
detections or with players of other clips, and without static cameras those whose people
are tracked and have monocular poses.
"""

from __future__ import annotations

from itertools import chain

from pydantic import JsonValue

from data_contracts.records import Record
from flows.stage import Match, Stage, once_a_match
from flows.stages import broadcast_calibration, detection, tracking, triangulation
from worldpose.body.body_file import OPEN_BODY, digest_of_body, is_open_body
from worldpose.body_fitting.settings import BodyFittingSettings


def inputs(match: Match, unit: str) -> tuple[str, ...]:
    """Return the results with triangulated joints, and with every camera's tracked detections."""
    return (*triangulation.adjusted_inputs(match, unit), f"retriangulation/{unit}")


def sources(match: Match, unit: str) -> dict[str, JsonValue]:
    """Return the clip, the clock, the camera order, and the pitch that bounds the feet."""
    return {**tracking.clip_sources(match, unit), "pitch": match.pitch_source}


def body_model_digest(
    match: Match, settings: BodyFittingSettings | RefittingSettings
) -> dict[str, JsonValue]:
    """Return the digest of an installed body model.

    It is None for the open body, which is part of the code and so of the code's digest.
    """
    name = settings.body_model
    digest = None if is_open_body(name) else digest_of_body(name, match.body_folder)
    return {"body_model_sha256": digest}


STAGE = tracking.of_clips(
    name="body_fitting",
    about="fit a body to every person",
    settings=BodyFittingSettings,
    inputs=inputs,
    sources=sources,
    external_inputs=body_model_digest,
)


class RefittingSettings(Record):
    """Bodies of triangulated people are refitted with the settings of `body_fitting`."""

    body_model: str = OPEN_BODY
    """Body model of people in a match without static cameras, which `body_fitting` has no units
    for: the open body, or one installed with `worldpose body install`."""


@once_a_match
def refitted_clips(match: Match) -> tuple[str, ...]:
    """Return clips with broadcast camera and detections, and those with players of other clips.

    Without static cameras these are the clips with tracked people and monocular poses.
    """
    if not match.has_static_cameras:
        tracked = broadcast_calibration.clips_without_static_cameras(match)
        return tuple(clip for clip in tracked if clip in match.folder.estimates)
    clips = (clip.id for clip in match.folder.spec.clips)
    return tuple(clip for clip in clips if _views(match, clip) or _namesakes(match, clip))


def last_bodies(match: Match, clip: str) -> str:
    """Return the result with the last fitted bodies of a clip."""
    return f"refitting/{clip}" if clip in refitted_clips(match) else f"body_fitting/{clip}"


def refitting_inputs(match: Match, unit: str) -> tuple[str, ...]:
    """Return `body_fitting`, its inputs, the broadcast camera, and other clips' shapes.

    Without static cameras: the broadcast camera, its detections and the tracks on the pitch.
    """
    if not match.has_static_cameras:
        return (*broadcast_calibration.camera_inputs(match, unit), f"broadcast_tracking/{unit}")
    cameras = (broadcast_calibration.camera_inputs(match, view) for view in _views(match, unit))
    others = (f"body_fitting/{clip}" for clip in _namesakes(match, unit))
    fitted = (*inputs(match, unit), f"body_fitting/{unit}")
    return (*fitted, *chain.from_iterable(cameras), *others)


def refitting_sources(match: Match, unit: str) -> dict[str, JsonValue]:
    """Return the clip, the identities, and of each broadcast view poses, detections and clock.

    The names of a view's sources end with `.<view>` if its clip has several.
    """
    spec, estimates = match.folder.spec, match.folder.estimates
    if not match.has_static_cameras:
        own = match.file_sources("estimates", estimates.get(unit))
        return {**broadcast_calibration.tracking_sources(match, unit), **own}
    named = _namesakes(match, unit)
    shared = {name for people in named.values() for name in people.values()}
    here = {person: name for person, name in spec.clip(unit).people.items() if name in shared}
    named = {unit: here, **named}
    seen: dict[str, JsonValue] = {}
    for view in _views(match, unit):
        clock = match.frame_sources(view)
        view_sources = {
            "offset_frames": clock["offset_frames"],
            **({} if clock["rate"] == 1.0 else {"rate": clock["rate"]}),
            "seen_in_broadcast": next(iter(detection.seen_in_broadcast(match, view)), None),
            "broadcast_offset_frames": spec.broadcast_views[view].offset,
        }
        ends = "" if view == unit else f".{view}"
        seen |= match.file_sources(f"estimates{ends}", estimates.get(view))
        seen |= {f"{name}{ends}": value for name, value in view_sources.items()}
    return {
        **sources(match, unit),
        **seen,
        "people": {
            name: {str(person): player for person, player in sorted(people.items())}
            for name, people in named.items()
        },
    }


def _views(match: Match, clip: str) -> tuple[str, ...]:
    """Return a clip's broadcast views with a calibrated camera and detections."""
    known = {*broadcast_calibration.units(match)}
    views = match.folder.spec.views_of(clip)
    return tuple(v for v in views if v in known and detection.seen_in_broadcast(match, v))


def _namesakes(match: Match, unit: str) -> dict[str, dict[int, str]]:
    """Return a clip's players in other clips: clip to their person ids and names there."""
    here = set(match.folder.spec.clip(unit).people.values())
    there = {
        clip.id: {person: name for person, name in clip.people.items() if name in here}
        for clip in match.folder.spec.clips
        if clip.id != unit
    }
    return {clip: people for clip, people in there.items() if people}


REFITTING = Stage(
    name="refitting",
    about="fit bodies again with the broadcast camera and other clips",
    settings=RefittingSettings,
    units=refitted_clips,
    inputs=refitting_inputs,
    sources=refitting_sources,
    previous_pass_inputs=tracking.filtering_inputs,
    late_inputs=detection.again_by_cameras,
    external_inputs=body_model_digest,
)
