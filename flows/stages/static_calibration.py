"""Stage `static_calibration`: one unit per static camera, given, clicked or proposed (C1-C5)."""

from __future__ import annotations

from pydantic import JsonValue

from data_contracts.static_calibration import ClickedMarkings
from flows.stage import Match, Stage
from flows.stages.ingest import video_sources
from worldpose.ingest import unit_frames
from worldpose.ingest.annotations import clicked_file
from worldpose.static_calibration import StaticCalibrationSettings


def units(match: Match) -> tuple[str, ...]:
    """Return the static cameras in order."""
    return tuple(camera.id for camera in match.folder.spec.static_cameras)


def inputs(match: Match, unit: str) -> tuple[str, ...]:
    """Return nothing: a camera comes from given files or clicks, never from detections."""
    return ()


def sources(match: Match, unit: str) -> dict[str, JsonValue]:
    """Return the given calibration alone, or else clicks, pitch, lens and an image of the camera.

    A camera without clicks has its side instead.

    Clicks are listed under the file's name, by marking, so that a difference between two runs names
    the file and the point.
    """
    folder = match.folder
    camera = folder.spec.camera(unit)
    given = folder.calibrations.get(unit)
    if given is not None:
        return {"calibration": given.model_dump(mode="json")}
    clicked = folder.clicked.get(unit)  # without clicks registration ensures a side
    still = folder.stills.get(unit)
    path = None if still is None else still.relative_to(folder.folder).as_posix()
    lens = folder.lenses.get(unit)
    return {
        "calibration": None,
        **({} if lens is None else {"lens": lens.model_dump(mode="json")}),
        "clicked": {} if clicked is None else {clicked_file(unit): _by_name(clicked)},
        **({"side": camera.side} if clicked is None else {}),
        "pitch": None if folder.pitch is None else folder.pitch.model_dump(mode="json"),
        "image_size": [camera.width, camera.height],
        "still": path,
        "still_sha256": None if path is None else match.registration.digest_of(path),
        "filmed": _video_for_still(match, unit) if still is None else None,
    }


def _by_name(clicked: ClickedMarkings) -> dict[str, JsonValue]:
    return {
        "points": {point.name: list(point.xy) for point in clicked.points},
        "drawn": {marking.name: [list(xy) for xy in marking.xy] for marking in clicked.drawn},
    }


def _video_for_still(match: Match, unit: str) -> dict[str, JsonValue] | None:
    """Return the camera's video, for a still without people if none is given."""
    if unit not in match.folder.videos:
        return None
    offset = unit_frames(match.folder.spec, unit).offset
    return {**video_sources(match, unit), "offset_frames": offset}


STAGE = Stage(
    name="static_calibration",
    about="find every static camera from clicked or proposed markings",
    settings=StaticCalibrationSettings,
    units=units,
    inputs=inputs,
    sources=sources,
    leaves_out=True,
    needs_static_cameras=True,
)
