"""Writing of match folders, whole or not at all, from records or from files of other tools."""

from __future__ import annotations

import os
import re
import shutil
import tempfile
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from types import MappingProxyType
from typing import Literal

import numpy as np
import yaml
from numpy.typing import NDArray

from data_contracts.broadcast_calibration import KeyFrames
from data_contracts.cameras import CameraCalibration, LensCalibration
from data_contracts.keypoints import KeypointDetections
from data_contracts.match import MatchSpec
from data_contracts.pitch import PitchSpec
from data_contracts.static_calibration import ClickedMarkings
from worldpose.errors import InputError
from worldpose.formats.calibration_files import read_calibration, write_calibration_toml
from worldpose.formats.files import whole_file
from worldpose.formats.keypoint_files import (
    on_frames,
    read_keypoint_arrays,
    read_observations,
    seen_frames,
    write_keypoint_arrays,
)
from worldpose.formats.lens_files import read_lens_toml, read_lenses, write_lens_toml
from worldpose.ingest.annotations import write_clicked_markings, write_key_frames
from worldpose.ingest.footage import write_still
from worldpose.ingest.match_folder import LENS_FILE, image_sizes, read_match, read_spec
from worldpose.ingest.pitch_file import NO_PITCH
from worldpose.ingest.validation import require_local, validate_record
from worldpose.video import index_frames


@dataclass(frozen=True)
class MatchAnnotations:
    """A match's clicked markings, written to `annotations/`."""

    clicked: Mapping[str, ClickedMarkings] = field(default_factory=dict)
    """Clicks in one image, by static camera id."""
    key_frames: Mapping[str, KeyFrames] = field(default_factory=dict)
    """Clicked key frames of the broadcast camera, by clip id."""


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
        observations: by id of a static camera or clip; `frame` is the camera's (or the broadcast
            clip's) own frame number, as in the files, not the match frame.
        pitch: written to the file named by `spec.pitch`, else to pitch.json.
        annotations: clicked markings of the cameras; None = no clicks.
        stills: images (height, width, 3), RGB, by camera id; written to the file named by the
            camera's `still`, else to stills/<camera>.png.
        further: called with the temporary match folder, to add videos and `reference/`.

    Raises:
        InputError: the folder exists and is not empty, or the arguments contradict each other.
    """
    annotations = annotations or MatchAnnotations()
    clicked, key_frames = annotations.clicked, annotations.key_frames
    _require_known(spec, [*calibrations, *observations, *clicked, *stills, *key_frames])
    require_local(spec.pitch or "pitch.json", "match.yaml: pitch")
    for camera_id in stills:
        require_local(_still_name(spec, camera_id), f"match.yaml: camera {camera_id}: still")
    _require_empty(folder)
    _make_parent(folder)
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
        write_clicked_markings(building, clicked)
        write_key_frames(building, key_frames)
        for camera_id, picture in stills.items():
            write_still(building / _still_name(spec, camera_id), picture)
        if further is not None:
            further(building)
        read_match(building)
        _sync(building)
        try:
            building.rename(folder)  # replaces an empty folder, fails on any other
        except OSError:
            _require_empty(folder)
            raise
    _sync_folder(folder.parent)


def _require_known(spec: MatchSpec, names: list[str]) -> None:
    known = [camera.id for camera in spec.cameras] + [clip.id for clip in spec.clips]
    for name in names:
        if name not in known:
            raise InputError(
                f"match {spec.match_id}",
                expected=f"data of its cameras and clips: {', '.join(known)}",
                found=repr(name),
                todo="Add the camera to the match, or leave its data out.",
            )


def _still_name(spec: MatchSpec, camera_id: str) -> str:
    return spec.camera(camera_id).still or f"stills/{camera_id}.png"


def _make_parent(folder: Path) -> None:
    try:
        folder.parent.mkdir(parents=True, exist_ok=True)
    except OSError as error:
        raise InputError(
            str(folder),
            expected="a place where a folder can be made",
            found=str(error),
            todo="Choose another place.",
        ) from error


def _require_empty(folder: Path) -> None:
    if folder.is_symlink() or (folder.exists() and not folder.is_dir()):
        found = "a link or file"
    elif folder.is_dir() and any(folder.iterdir()):
        found = "a folder with files in it"
    else:
        return
    raise InputError(
        str(folder),
        expected="nothing, or an empty folder",
        found=found,
        todo="Choose another name, or remove it first; it was left as it was.",
    )


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
        raise InputError(
            "match.yaml: pitch",
            expected="a pitch file's name, or nothing, where a pitch is given",
            found=repr(NO_PITCH),
            todo="Give no pitch, or take `pitch: none` out.",
        )
    path = folder / (spec.pitch or "pitch.json")
    path.parent.mkdir(parents=True, exist_ok=True)
    path.write_text(pitch.model_dump_json(indent=2) + "\n", encoding="utf-8")


def _sync(folder: Path) -> None:
    """Sync every file and folder of the tree to disk."""
    for parent, _, names in os.walk(folder):
        for name in names:
            with (Path(parent) / name).open("rb") as file:
                os.fsync(file.fileno())
        _sync_folder(Path(parent))


def _sync_folder(folder: Path) -> None:
    descriptor = os.open(folder, os.O_RDONLY)
    try:
        os.fsync(descriptor)
    finally:
        os.close(descriptor)


def import_match(
    calibration: Path,
    detections: Path,
    fps: float,
    out: Path,
    match_id: str | None = None,
    pitch: Literal["none"] | None = "none",
) -> MatchSpec:
    """Write a match folder with the cameras of a calibration and their detections.

    The only clip, `clip`, spans the first to the last frame with a person; frames keep their
    numbers from the files. The function validates all 2D poses and stores them as npz.

    Args:
        calibration: a file that `read_calibration` reads.
        detections: folder with `<camera>.json` or `.npz` for each camera of the calibration.
        fps: frame rate of all cameras [1/s].
        out: the match folder, absent or empty.
        match_id: id of the match; None = the name of `out`.
        pitch: "none", or None for the standard pitch, if the calibration's world is the pitch's.

    Returns:
        Content of match.yaml.

    Raises:
        InputError: a file is invalid, names do not match, there are no people, or `out` is not
            empty; nothing is written then.
    """
    cameras = read_calibration(calibration)
    files = files_by_camera(detections, list(cameras), calibration, (".json", ".npz"))
    people = {name: read_observations(file) for name, file in files.items()}
    seen = [frames for frames in map(seen_frames, people.values()) if frames is not None]
    if not seen:
        raise InputError(
            str(detections), expected="people", found="none in any file", todo="Check the detector."
        )
    first, last = min(frame for frame, _ in seen), max(frame for _, frame in seen)
    content = {
        "match_id": match_id if match_id is not None else name_of(out),
        "fps": fps,
        "cameras": [
            {"id": name, "width": camera.image_size[0], "height": camera.image_size[1]}
            for name, camera in cameras.items()
        ],
        "clips": [{"id": "clip", "first_frame": first, "frame_count": last - first + 1}],
        "pitch": pitch,
    }
    spec = validate_record(MatchSpec, content, str(out / "match.yaml"))
    for name, file in files.items():
        people[name] = on_frames(file, people[name], [(first, last - first + 1)])
    write_match(out, spec, calibrations=cameras, observations=people)
    return spec


def import_lenses(
    files: Sequence[Path], folder: Path, camera: str | None = None
) -> dict[str, LensCalibration]:
    """Write lenses without a pose into a match folder's lenses.toml, and return them.

    Static calibration takes them as prior of focal length, principal point and distortion; the
    pose comes from clicks.

    Args:
        files: what `read_lenses` reads.
        folder: the match folder, with match.yaml.
        camera: the static camera of a file that names none.

    Raises:
        InputError: a file is invalid, its camera is unknown or has a lens already, or calibration
            .toml gives it with its pose.
    """
    spec = read_spec(folder)
    sizes = image_sizes(spec)
    target = folder / LENS_FILE
    known = read_lens_toml(target, sizes) if target.exists() else {}
    lenses = read_lenses(files, camera, sizes)
    given = folder / "calibration.toml"
    posed = read_calibration(given) if given.exists() else {}
    for name in lenses:
        if name in known or name in posed:
            place = LENS_FILE if name in known else given.name
            raise InputError(
                f"{folder / place}: {name}",
                expected="no lens of this camera yet",
                found="one",
                todo="Remove it there first.",
            )
    with whole_file(target) as draft:
        write_lens_toml(draft, {**known, **lenses})
    return lenses


def files_by_camera(
    folder: Path, cameras: list[str], calibration: Path, suffixes: tuple[str, ...]
) -> dict[str, Path]:
    """Return the file of each camera in a folder, by the camera's name.

    Raises:
        InputError: a camera lacks its file, or a file its camera.
    """
    files = [
        file
        for file in (sorted(folder.iterdir()) if folder.is_dir() else ())
        if file.suffix in suffixes and not file.name.startswith(".")
    ]
    if sorted(file.stem for file in files) != sorted(cameras):
        raise InputError(
            str(folder),
            expected=f"one {' or '.join(suffixes)} file for each camera in {calibration.name}: "
            + ", ".join(cameras),
            found=", ".join(file.name for file in files) or "no such file",
            todo="Rename the files as the cameras, and leave neither over.",
        )
    by_name = {file.stem: file for file in files}
    return {name: by_name[name] for name in cameras}


def name_of(folder: Path) -> str:
    """Return the folder's name without characters that ids do not allow."""
    name = re.sub(r"[^A-Za-z0-9._-]+", "-", folder.resolve().name).strip("-._")[:64]
    return name or "match"


VIDEO_SUFFIXES = (".mp4", ".mov", ".mkv", ".avi")


def import_videos(
    calibration: Path,
    videos: Path,
    out: Path,
    fps: float | None = None,
    match_id: str | None = None,
) -> MatchSpec:
    """Write a match folder with the cameras of a calibration and copies of their videos.

    The only clip, `clip`, is as long as the shortest video. Videos begin together: `offset_frames`
    in match.yaml can shift them afterwards.

    Args:
        calibration: a file that `read_calibration` reads.
        videos: folder with `<camera>.mp4`, .mov, .mkv or .avi for each camera of the calibration.
        out: the match folder, absent or empty.
        fps: frame rate of all videos [1/s]; None = from the videos.
        match_id: id of the match; None = the name of `out`.

    Returns:
        Content of match.yaml.

    Raises:
        InputError: a file is invalid, names or rates do not match, or `out` is not empty; nothing
            is written then.
    """
    cameras = read_calibration(calibration)
    files = files_by_camera(videos, list(cameras), calibration, VIDEO_SUFFIXES)
    indices = {name: index_frames(file) for name, file in files.items()}
    rate = round(next(iter(indices.values())).fps, 3) if fps is None else fps
    counts = {name: len(index.on_clock(rate, str(files[name]))) for name, index in indices.items()}
    for name, index in indices.items():
        if index.size != cameras[name].image_size:
            raise InputError(
                str(files[name]),
                expected="{} x {} px, the size in the calibration".format(
                    *cameras[name].image_size
                ),
                found=f"{index.size[0]} x {index.size[1]}",
                todo="Give the video that was calibrated, in its size.",
            )
    content = {
        "match_id": match_id if match_id is not None else name_of(out),
        "fps": rate,
        "cameras": [
            {
                "id": name,
                "width": camera.image_size[0],
                "height": camera.image_size[1],
                "video": f"videos/{files[name].name}",
            }
            for name, camera in cameras.items()
        ],
        "clips": [{"id": "clip", "frame_count": min(counts.values())}],
        "pitch": "none",
    }
    spec = validate_record(MatchSpec, content, str(out / "match.yaml"))

    def copy(folder: Path) -> None:
        (folder / "videos").mkdir()
        for file in files.values():
            shutil.copyfile(file, folder / "videos" / file.name)

    write_match(out, spec, calibrations=cameras, observations={}, further=copy)
    return spec
