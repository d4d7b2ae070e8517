"""Atomic writer of match folders."""

from __future__ import annotations

import shutil
import tempfile
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from pathlib import Path
from types import MappingProxyType

import numpy as np
import yaml
from numpy.typing import NDArray

from data_contracts.broadcast_calibration import KeyFrames
from data_contracts.cameras import CameraCalibration
from data_contracts.keypoints import KeypointDetections
from data_contracts.match import ClockOffset, MatchSpec
from data_contracts.pitch import PitchSpec
from data_contracts.static_calibration import ClickedMarkings
from worldpose.compiled import map_in_threads
from worldpose.errors import InputError, say_failure
from worldpose.formats.calibration_files import known_id
from worldpose.formats.calibration_writer import write_calibration_toml
from worldpose.formats.detection_files import read_boxes
from worldpose.formats.files import FULL, whole_file
from worldpose.formats.keypoint_files import read_keypoint_arrays, write_keypoint_arrays
from worldpose.ingest.annotations import clicked_file, key_frames_file
from worldpose.ingest.footage import write_still
from worldpose.ingest.match_folder import read_match
from worldpose.ingest.pitch_file import NO_PITCH
from worldpose.ingest.validation import require_local, validate_record
from worldpose.store.blobs import sync_path
from worldpose.video.folder import index_video
from worldpose.video.pictures import FrameIndex


@dataclass(frozen=True)
class MatchAnnotations:
    """A match's clicked markings, written to `annotations/`."""

    clicked: Mapping[str, ClickedMarkings] = field(default_factory=dict)
    """Clicks in one image, by static camera id."""
    key_frames: Mapping[str, KeyFrames] = field(default_factory=dict)
    """Clicked key frames by broadcast view."""


def write_match(
    folder: Path,
    spec: MatchSpec,
    *,
    calibrations: Mapping[str, CameraCalibration],
    observations: Mapping[str, KeypointDetections],
    pitch: PitchSpec | None = None,
    annotations: MatchAnnotations | None = None,
    stills: Mapping[str, NDArray[np.uint8]] = MappingProxyType({}),
    further: Callable[[Path], None] | None = None,
) -> None:
    """Write a match folder that `read_match` accepts, atomically.

    The function builds and reads back a temporary folder in the same parent, syncs it to disk and
    renames it.

    Args:
        folder: absent, or an empty folder.
        spec: match.yaml.
        calibrations: static cameras by id.
        observations: detections by id of a static camera or name of a broadcast view; `frame` is
            the camera's own frame number, as in the files, not the match frame.
        pitch: written to the file named by `spec.pitch`, else to pitch.json.
        annotations: clicked markings of the cameras; None = no clicks.
        stills: images (height, width, 3), RGB, by camera id; written to the file named by the
            camera's `still`, else to stills/<camera>.png.
        further: called with the temporary match folder, to add videos and `reference/`.

    Raises:
        InputError: the folder is not empty, its disk is full, or the arguments contradict.
    """
    annotations = annotations or MatchAnnotations()
    clicked, key_frames = annotations.clicked, annotations.key_frames
    _require_known(spec, [*calibrations, *observations, *clicked, *stills, *key_frames])
    require_local(spec.pitch or "pitch.json", "match.yaml: pitch")
    for camera_id in stills:
        require_local(_still_name(spec, camera_id), f"match.yaml: camera {camera_id}: still")
    _require_empty(folder)
    _make_parent(folder)
    try:
        with tempfile.TemporaryDirectory(prefix=f".{folder.name}.", dir=folder.parent) as workshop:
            # One level down: the temporary folder is private, the match has the usual permissions.
            building = Path(workshop) / folder.name
            (building / "detections").mkdir(parents=True)
            (building / "match.yaml").write_text(_yaml(spec), encoding="utf-8")
            if calibrations:
                write_calibration_toml(building / "calibration.toml", calibrations)
            for name, people in observations.items():
                file = building / "detections" / f"{name}.npz"
                write_keypoint_arrays(file, people)
                read_keypoint_arrays(file)
            if pitch is not None:
                _write_pitch(building, spec, pitch)
            records: dict[str, ClickedMarkings | KeyFrames] = {
                **{clicked_file(name): each for name, each in clicked.items()},
                **{key_frames_file(name): each for name, each in key_frames.items()},
            }
            for name, record in records.items():
                (building / name).parent.mkdir(parents=True, exist_ok=True)
                (building / name).write_text(record.model_dump_json(indent=2) + "\n", "utf-8")

            def write(camera_id: str) -> None:
                write_still(building / _still_name(spec, camera_id), stills[camera_id])

            for _ in map_in_threads(write, stills):
                pass
            if further is not None:
                further(building)
            read_match(building)
            for path in (building, *building.rglob("*")):
                sync_path(path)
            try:
                building.rename(folder)  # replaces an empty folder, fails on any other
            except OSError:
                _require_empty(folder)
                raise
    except OSError as error:
        if error.errno not in FULL:
            raise
        expected = "space for the match folder"
        todo = "Free some, or choose another place; nothing was written."
        raise InputError(str(folder), expected, say_failure(error), todo) from error
    sync_path(folder.parent)


def _require_known(spec: MatchSpec, names: list[str]) -> None:
    named = [camera.id for camera in spec.cameras] + [clip.id for clip in spec.clips]
    known = [*dict.fromkeys((*named, *spec.broadcast_views))]
    for name in names:
        if name not in known:
            expected = f"data of its cameras and clips: {', '.join(known)}"
            todo = "Add the camera to the match, or leave its data out."
            raise InputError(f"match {spec.match_id}", expected, repr(name), todo)


def _still_name(spec: MatchSpec, camera_id: str) -> str:
    return spec.camera(camera_id).still or f"stills/{camera_id}.png"


def _make_parent(folder: Path) -> None:
    try:
        folder.parent.mkdir(parents=True, exist_ok=True)
    except OSError as error:
        expected = "a place where a folder can be made"
        todo = "Choose another place."
        raise InputError(str(folder), expected, say_failure(error), todo) from error


def _require_empty(folder: Path) -> None:
    if folder.is_symlink() or (folder.exists() and not folder.is_dir()):
        found = "a link or file"
    elif folder.is_dir() and any(folder.iterdir()):
        found = "a folder with files in it"
    else:
        return
    todo = "Choose another name, or remove it first; it was left as it was."
    raise InputError(str(folder), "nothing, or an empty folder", found, todo)


def _yaml(spec: MatchSpec) -> str:
    content = spec.model_dump(mode="json", exclude_none=True)
    if not spec.roster:
        del content["roster"]
    for clip in content["clips"]:
        if not clip["people"]:
            del clip["people"]
    text: str = yaml.safe_dump(content, sort_keys=False, allow_unicode=True)
    return text


def _write_pitch(folder: Path, spec: MatchSpec, pitch: PitchSpec) -> None:
    if spec.pitch == NO_PITCH:
        expected = "a pitch file's name, or nothing, where a pitch is given"
        todo = "Give no pitch, or take `pitch: none` out."
        raise InputError("match.yaml: pitch", expected, repr(NO_PITCH), todo)
    path = folder / (spec.pitch or "pitch.json")
    path.parent.mkdir(parents=True, exist_ok=True)
    path.write_text(pitch.model_dump_json(indent=2) + "\n", encoding="utf-8")


def write_offsets(folder: Path, offsets: Mapping[str, ClockOffset]) -> None:
    """Write `offset_frames` [frame] of cameras into match.yaml; InputError if one is unknown."""
    file = folder / "match.yaml"
    text = file.read_text(encoding="utf-8")
    root = yaml.compose(text, Loader=yaml.SafeLoader)
    assert root is not None  # a match was read from this file
    entries = {key.value: value for key, value in root.value}
    edits = []
    missing = dict(offsets)
    for camera in entries["cameras"].value:
        keys = {key.value: value for key, value in camera.value}
        name = keys["id"].value
        if name not in missing:
            continue
        offset = missing.pop(name)
        number = str([list(each) for each in offset] if isinstance(offset, tuple) else offset)
        if "offset_frames" in keys:
            old = keys["offset_frames"]
            edits.append((old.start_mark.index, old.end_mark.index, number))
            continue
        at = keys["id"].end_mark.index
        column = camera.value[0][0].start_mark.column
        before = ", " if camera.flow_style else "\n" + " " * column
        edits.append((at, at, f"{before}offset_frames: {number}"))
    if missing:
        todo = "Correct the names."
        raise InputError(str(file), f"the cameras {', '.join(missing)}", "others", todo)
    for start, stop, number in sorted(edits, reverse=True):
        text = text[:start] + number + text[stop:]
    validate_record(MatchSpec, yaml.safe_load(text), str(file))
    with whole_file(file) as draft:
        draft.write_text(text, encoding="utf-8")


def import_boxes(boxes: Path, folder: Path, notes: list[str] | None = None) -> dict[str, int]:
    """Copy boxes of people into a match folder with videos; return the number by camera or clip.

    `boxes` has `<camera>.txt` or `<clip>.txt` (`read_boxes`), and `notes` receive sentences about
    boxes that are left out or changed. InputError if a camera has no video, or has 2D poses or
    boxes already; nothing is written then.
    """
    match = read_match(folder, whose=None)
    open_to = {name for name in match.videos if name not in match.detections}
    asked = [known_id(file.stem, match.videos) for file in _box_files(boxes)]
    known = sorted({*asked} & match.boxes.keys())
    if known:
        expected = f"no boxes of {known[0]} yet"
        todo = "Remove it first."
        raise InputError(str(folder / "boxes" / f"{known[0]}.txt"), expected, "a file", todo)
    indices = {name: index_video(match.videos[name]) for name in asked if name in open_to}
    return copy_boxes(boxes, {name: indices.get(name) for name in open_to}, folder, notes)


def _box_files(boxes: Path) -> list[Path]:
    return [file for file in sorted(boxes.glob("[!.]*")) if file.suffix.lower() == ".txt"]


def copy_boxes(
    boxes: Path,
    indices: Mapping[str, FrameIndex | None],
    folder: Path,
    notes: list[str] | None = None,
) -> dict[str, int]:
    """Check all files of boxes against the videos, then copy them; return their numbers.

    `boxes` has a file for some of the cameras, and `indices` has the frames of the video of those
    that may have one; `notes` are as in `import_boxes`. InputError also for no files.
    """
    files = _box_files(boxes)
    names = [known_id(file.stem, indices) for file in files]
    given = list(zip(names, files, strict=True))
    other = [file.name for name, file in given if not indices.get(name) or names.count(name) > 1]
    if not files or other:
        raise InputError(
            str(boxes),
            expected="<camera>.txt of cameras with a video and without 2D poses: "
            + (", ".join(sorted(indices)) or "(none)"),
            found=", ".join(other) or "no .txt file",
            todo="Rename the files as the cameras.",
        )
    counts = {}
    for name, file in given:
        index = indices[name]
        assert index is not None
        read = read_boxes(file, index.size, len(index))
        counts[name] = len(read.frame)
        if notes is not None:
            notes += [f"{file.name}: {change}" for change in read.changes]
    (folder / "boxes").mkdir(exist_ok=True)
    for name, file in given:
        with whole_file(folder / "boxes" / f"{name}.txt") as draft:
            shutil.copyfile(file, draft)
    return counts
