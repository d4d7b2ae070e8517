"""Readers of clicked markings, validated against the match's pitch."""

from __future__ import annotations

from collections.abc import Collection, Sequence
from difflib import get_close_matches
from pathlib import Path
from typing import Final

from data_contracts.broadcast_calibration import KeyFrames
from data_contracts.match import CameraSpec, MatchSpec
from data_contracts.pitch import PitchSpec
from data_contracts.static_calibration import ClickedMarkings, Pixel
from worldpose.errors import InputError
from worldpose.formats.files import read_json
from worldpose.ingest.validation import files_by_unit, validate_record
from worldpose.pitch.template import PitchTemplate

CLICKED_FOLDER: Final = "annotations/static_calibration"
"""Folder of `<camera>.json`, relative to the match folder."""

KEY_FRAMES_FOLDER: Final = "annotations/broadcast_calibration"
"""Folder of `<clip>.json`, relative to the match folder."""

BROADCAST_FILES: Final = "a clip with a broadcast camera"
"""Units of files of broadcast cameras, for messages."""


def clicked_file(camera_id: str) -> str:
    """Return the path of a camera's clicked markings, relative to the match folder."""
    return f"{CLICKED_FOLDER}/{camera_id}.json"


def key_frames_file(clip_id: str) -> str:
    """Return the path of a clip's clicked key frames, relative to the match folder."""
    return f"{KEY_FRAMES_FOLDER}/{clip_id}.json"


def read_clicked(
    folder: Path, spec: MatchSpec, pitch: PitchSpec | None, whose: str | None = "the pitch"
) -> dict[str, ClickedMarkings]:
    """Return the clicks of a match's static cameras, in their order.

    There is no pitch if it is None; `whose` it is serves messages, None = names are not checked.
    InputError if a file belongs to no static camera.
    """
    static = {camera.id: camera for camera in spec.static_cameras}
    clicked = {}
    of_cameras = "<camera>.json of a static camera"
    files = files_by_unit(folder, CLICKED_FOLDER, (".json",), static, of_cameras, alone=True)
    for name, file in files.items():
        clicked[name] = read_clicked_markings(file, static[name], pitch, whose)
    return {name: clicked[name] for name in static if name in clicked}


def read_clicked_markings(
    file: Path, camera: CameraSpec, pitch: PitchSpec | None, whose: str | None = "the pitch"
) -> ClickedMarkings:
    """Return the clicks, a `ClickedMarkings` of JSON, that are inside one camera's image.

    The pitch's template defines the names; `whose` is as in `read_clicked`. InputError also for a
    repeated name, no clicks, or no pitch; the error names file and entry.
    """
    template = _template(file, pitch, whose)
    clicked = validate_record(ClickedMarkings, read_json(file), str(file))
    _require_markings(str(file), "", clicked, camera, template, whose)
    return clicked


def read_key_frames(
    folder: Path, spec: MatchSpec, pitch: PitchSpec | None, whose: str | None = "the pitch"
) -> dict[str, KeyFrames]:
    """Return the clicked key frames by broadcast view, in their order; see `read_clicked`."""
    views, picked = spec.broadcast_views, {}
    of_clips = f"<clip>.json of {BROADCAST_FILES}"
    files = files_by_unit(folder, KEY_FRAMES_FOLDER, (".json",), views, of_clips, alone=True)
    for name, file in files.items():
        camera = views[name].camera
        template = _template(file, pitch, whose)
        key_frames = validate_record(KeyFrames, read_json(file), str(file))
        numbers = [key_frame.frame for key_frame in key_frames.key_frames]
        if numbers != sorted(set(numbers)):
            expected = "every frame once, in rising order"
            todo = "Sort them, and put all clicks of one frame into one entry."
            raise InputError(f"{file}: key_frames", expected, f"{numbers}", todo)
        for n, key_frame in enumerate(key_frames.key_frames):
            inside = f"key_frames[{n}].markings"
            _require_markings(str(file), inside, key_frame.markings, camera, template, whose)
        picked[name] = key_frames
    return {name: picked[name] for name in views if name in picked}


def _template(file: Path, pitch: PitchSpec | None, whose: str | None) -> PitchTemplate | None:
    if pitch is None:
        expected = "no clicked markings where match.yaml says `pitch: none`"
        todo = "Remove it, or take `pitch: none` out of match.yaml."
        raise InputError(str(file), expected, "a file of them", todo)
    return PitchTemplate.from_spec(pitch) if whose else None


def _require_markings(
    file: str,
    within: str,
    clicked: ClickedMarkings,
    camera: CameraSpec,
    template: PitchTemplate | None,
    whose: str | None,
) -> None:
    """Raise InputError for unknown markings, and for pixels outside the image."""
    if not (clicked.points or clicked.drawn):
        expected = "points or drawn markings"
        raise InputError(f"{file}: {within}" if within else file, expected, "none", "Click some.")
    dot = f"{within}." if within else ""
    points = [
        (f"{dot}points[{n}]", point.name, (point.xy,)) for n, point in enumerate(clicked.points)
    ]
    drawn = [
        (f"{dot}drawn[{n}]", marking.name, marking.xy) for n, marking in enumerate(clicked.drawn)
    ]
    _require_known(
        file, points, f"a point of {whose}", None if template is None else template.points
    )
    names = None if template is None else template.marking_names
    _require_known(file, drawn, f"a marking of {whose}", names)
    for place, _, (pixel,) in points:
        _require_inside(f"{file}: {place}.xy", pixel, camera)
    for place, _, along in drawn:
        for number, pixel in enumerate(along):
            _require_inside(f"{file}: {place}.xy[{number}]", pixel, camera)


def _require_known(
    file: str,
    entries: Sequence[tuple[str, str, Sequence[Pixel]]],
    kind: str,
    known: Collection[str] | None,
) -> None:
    """Raise InputError for unknown and for repeated names."""
    places: dict[str, str] = {}
    for place, name, _ in entries:
        if known is not None and name not in known:
            close = get_close_matches(name, known, n=1)
            expected = f"the name of {kind}"
            todo = f"Did you mean {close[0]!r}?" if close else f"Known: {', '.join(known)}."
            raise InputError(f"{file}: {place}.name", expected, repr(name), todo)
        if name in places:
            found = f"{name!r} again, after {places[name]}"
            todo = (
                "Which of the two is meant? Remove or rename the other; put all places along "
                "one marking into one entry."
            )
            raise InputError(f"{file}: {place}.name", "every name once", found, todo)
        places[name] = place


def _require_inside(where: str, pixel: Pixel, camera: CameraSpec) -> None:
    # One pixel more than the image: for tools that count from 1, and clicks on its border.
    inside = all(
        -1.0 <= value <= size
        for value, size in zip(pixel, (camera.width, camera.height), strict=True)
    )
    if not inside:
        expected = f"a place in the image of {camera.width} x {camera.height} px"
        todo = "Remove it, or click it again in this camera's picture."
        raise InputError(where, expected, f"{list(pixel)}", todo)
