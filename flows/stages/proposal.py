"""Stage `proposal`: one unit per static camera without clicks; of all, where a side is unknown."""

from __future__ import annotations

from pydantic import JsonValue

from flows.stage import Match, Stage, once_a_match
from flows.stages import detection
from flows.stages.ingest import video_sources
from worldpose.detection.settings import DetectionSettings
from worldpose.ingest.annotations import clicked_file
from worldpose.ingest.footage import unit_frames
from worldpose.static_calibration.settings import ProposalSettings


@once_a_match
def units(match: Match) -> tuple[str, ...]:
    """Return the static cameras without clicks, in order.

    If one of them has no stated side, the people of all static cameras decide.
    """
    static = tuple(camera.id for camera in match.folder.spec.static_cameras)
    return static if _needs_people(match) else tuple(proposed_cameras(match))


@once_a_match
def proposed_cameras(match: Match) -> dict[str, str | None]:
    """Return the cameras that are neither given nor clicked, each with its side if it is stated."""
    folder = match.folder
    known = {*folder.calibrations, *folder.clicked}
    return {each.id: each.side for each in folder.spec.static_cameras if each.id not in known}


def sources(match: Match, unit: str) -> dict[str, JsonValue]:
    """Return the camera's image, pitch and lens, its stated side, and the clips with people."""
    folder = match.folder
    people: JsonValue = None
    if _needs_people(match):
        filmed = unit not in folder.detections
        people = {
            "video": video_sources(match, unit)["video"] if filmed else None,
            "ranges": [[first, count] for first, count in unit_frames(folder.spec, unit).ranges],
        }
    return {
        **camera_sources(match, unit),
        "side": folder.spec.camera(unit).side,
        "fps": folder.spec.fps,
        "people": people,
    }


def needed_proposals(match: Match, unit: str) -> tuple[str, ...]:
    """Return the proposals that the calibration of a camera needs; none if it has clicks."""
    if unit not in proposed_cameras(match):
        return ()
    names = units(match) if _needs_people(match) else (unit,)
    return tuple(f"proposal/{name}" for name in names)


def camera_sources(match: Match, unit: str) -> dict[str, JsonValue]:
    """Return the given calibration alone, or else clicks, side, pitch, lens and an image.

    Clicks are listed under the file's name, by marking, so that a difference between two runs names
    the file and the point.
    """
    folder = match.folder
    camera = folder.spec.camera(unit)
    given = folder.calibrations.get(unit)
    if given is not None:
        return {"calibration": given.model_dump(mode="json")}
    clicked = folder.clicked.get(unit)
    still, lens = folder.stills.get(unit), folder.lenses.get(unit)
    return {
        "calibration": None,
        **({} if lens is None else {"lens": lens.model_dump(mode="json")}),
        "clicked": {} if clicked is None else {clicked_file(unit): clicked.by_name()},
        **({} if clicked is None or camera.side is None else {"side": camera.side}),
        "pitch": match.pitch_source,
        "image_size": [camera.width, camera.height],
        **match.file_sources("still", still),
        "filmed": _video_for_still(match, unit) if still is None else None,
    }


def _needs_people(match: Match) -> bool:
    """Return whether a camera without clicks has no stated side."""
    return None in proposed_cameras(match).values()


def _video_for_still(match: Match, unit: str) -> dict[str, JsonValue] | None:
    """Return the camera's video, for a still without people if none is given."""
    if unit not in match.folder.videos:
        return None
    frames = match.frame_sources(unit)
    clock = {name: frames[name] for name in ("offset_frames", "rate")}
    return {**video_sources(match, unit), **clock}


STAGE = Stage(
    name="proposal",
    about="propose the cameras without clicks",
    settings=ProposalSettings,
    units=units,
    # The given 2D poses or the index of the video, if people decide.
    inputs=lambda match, unit: (f"ingest/{unit}",) if _needs_people(match) else (),
    sources=sources,
    # The versions of the libraries that run the bundled detector.
    external_inputs=lambda match, settings: detection.outside(match, DetectionSettings()),
    needs_static_cameras=True,
)
