"""Clicked markings of static cameras: one JSON file a camera, checked against the match's pitch."""

from __future__ import annotations

from collections.abc import Collection, Mapping, Sequence
from difflib import get_close_matches
from pathlib import Path
from typing import Final

from data_contracts.match import CameraSpec, MatchSpec
from data_contracts.pitch import PitchSpec
from data_contracts.static_calibration import ClickedMarkings, Pixel
from worldpose.errors import InputError
from worldpose.ingest.places import existing_file
from worldpose.ingest.text_files import read_json
from worldpose.ingest.validation import validate_record
from worldpose.pitch import PitchTemplate

CLICKED_FOLDER: Final = "annotations/static_calibration"
"""Where a match folder keeps `<camera>.json`, relative to it."""


def clicked_file(camera_id: str) -> str:
    """Path of a camera's clicked markings, relative to the match folder."""
    return f"{CLICKED_FOLDER}/{camera_id}.json"


def read_clicked(
    folder: Path, spec: MatchSpec, pitch: PitchSpec | None
) -> dict[str, ClickedMarkings]:
    """What was clicked in the static cameras of a match folder, in their order.

    Args:
        folder: the match folder.
        spec: its match.yaml.
        pitch: its pitch; None where it has none.

    Raises:
        InputError: a file of no static camera, or one that is not as it must be.
    """
    static = {camera.id: camera for camera in spec.static_cameras}
    clicked = {}
    names = sorted(path.name for path in (folder / CLICKED_FOLDER).glob("[!.]*"))
    for name in names:
        file = existing_file(folder, f"{CLICKED_FOLDER}/{name}", str(folder))
        if file.suffix != ".json" or file.stem not in static:
            raise InputError(
                str(file),
                expected=f"<camera>.json of a static camera: {', '.join(static)}",
                found=repr(name),
                todo="Rename or remove the file, or add the camera to match.yaml.",
            )
        clicked[file.stem] = read_clicked_markings(file, static[file.stem], pitch)
    return {name: clicked[name] for name in static if name in clicked}


def read_clicked_markings(
    file: Path, camera: CameraSpec, pitch: PitchSpec | None
) -> ClickedMarkings:
    """What a person clicked in one camera's picture.

    Args:
        file: JSON, a `ClickedMarkings`.
        camera: the camera; everything clicked lies in its picture.
        pitch: the match's; the names are those of its template.

    Raises:
        InputError: naming file and entry: not JSON, an unknown key or name, no number, a name given
            twice, a place outside the picture, nothing clicked, or a match without a pitch.
    """
    if pitch is None:
        raise InputError(
            str(file),
            expected="no clicked markings where match.yaml says `pitch: none`",
            found="a file of them",
            todo="Remove it, or take `pitch: none` out of match.yaml.",
        )
    clicked = validate_record(ClickedMarkings, read_json(file), str(file))
    if not (clicked.points or clicked.drawn):
        raise InputError(
            str(file), expected="points or drawn markings", found="none", todo="Click some."
        )
    template = PitchTemplate.from_spec(pitch)
    points = [(f"points[{n}]", point.name, (point.xy,)) for n, point in enumerate(clicked.points)]
    drawn = [(f"drawn[{n}]", marking.name, marking.xy) for n, marking in enumerate(clicked.drawn)]
    _require_known(file, points, "a point", template.points)
    _require_known(file, drawn, "a marking", template.marking_names)
    for place, _, (pixel,) in points:
        _require_inside(f"{file}: {place}.xy", pixel, camera)
    for place, _, along in drawn:
        for number, pixel in enumerate(along):
            _require_inside(f"{file}: {place}.xy[{number}]", pixel, camera)
    return clicked


def write_clicked_markings(folder: Path, clicked: Mapping[str, ClickedMarkings]) -> None:
    """Write each camera's file into a match folder."""
    for camera_id, markings in clicked.items():
        file = folder / clicked_file(camera_id)
        file.parent.mkdir(parents=True, exist_ok=True)
        file.write_text(markings.model_dump_json(indent=2) + "\n", encoding="utf-8")


def _require_known(
    file: Path,
    entries: Sequence[tuple[str, str, Sequence[Pixel]]],
    kind: str,
    known: Collection[str],
) -> None:
    """Refuse names that the pitch does not have, and names that come twice."""
    places: dict[str, str] = {}
    for place, name, _ in entries:
        if name not in known:
            close = get_close_matches(name, known, n=1)
            raise InputError(
                f"{file}: {place}.name",
                expected=f"the name of {kind} of the pitch",
                found=repr(name),
                todo=f"Did you mean {close[0]!r}?" if close else f"Known: {', '.join(known)}.",
            )
        if name in places:
            raise InputError(
                f"{file}: {place}.name",
                expected="every name once",
                found=f"{name!r} again, after {places[name]}",
                todo="Remove one, or put all places along one marking into one entry.",
            )
        places[name] = place


def _require_inside(where: str, pixel: Pixel, camera: CameraSpec) -> None:
    inside = all(
        -0.5 <= value <= size - 0.5
        for value, size in zip(pixel, (camera.width, camera.height), strict=True)
    )
    if not inside:
        raise InputError(
            where,
            expected=f"a place in the picture of {camera.width} x {camera.height} px",
            found=f"{list(pixel)}",
            todo="Remove it, or click it again in this camera's picture.",
        )
