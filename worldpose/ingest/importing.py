"""Import of other tools' calibrations with 2D poses or videos, and of lenses."""

from __future__ import annotations

import re
import tempfile
from collections.abc import Callable, Collection, Mapping, Sequence
from pathlib import Path
from types import MappingProxyType
from typing import Final, TypeAlias

import numpy as np

from data_contracts.cameras import CameraCalibration, LensCalibration
from data_contracts.keypoints import KeypointDetections
from data_contracts.match import MatchSpec
from worldpose.errors import InputError
from worldpose.formats.calibration_files import LeftOut, camera_id, known_id
from worldpose.formats.calibration_forms import is_of_sensor, read_calibration
from worldpose.formats.detection_files import json_files
from worldpose.formats.files import whole_file
from worldpose.formats.keypoint_files import on_frames, read_people, seen_frames
from worldpose.formats.keypoint_sets import PeopleFile
from worldpose.formats.lens_files import read_lens_toml, read_lenses, write_lens_toml
from worldpose.ingest.camera_videos import (
    copy_videos,
    describe_unused,
    describe_videos,
    find_videos,
    fit_to_video,
    require_cameras,
    shared_length,
    video_name,
    without_strays,
)
from worldpose.ingest.match_folder import LENS_FILE, image_sizes, read_spec
from worldpose.ingest.registration import file_state, require_settled
from worldpose.ingest.validation import validate_record
from worldpose.ingest.writing import copy_boxes, write_match
from worldpose.video.folder import index_video
from worldpose.video.names import VIDEO_SUFFIXES, is_video
from worldpose.video.pictures import FrameIndex

Placing: TypeAlias = Callable[
    [Path, Mapping[str, CameraCalibration], Mapping[str, KeypointDetections], float],
    tuple[dict[str, CameraCalibration], list[str]],
]
"""Brings the cameras of a calibration to metres with z up, by their 2D poses (none = unknown) and
the frame rate [1/s]; returns them with sentences about what it changed."""


def import_match(
    calibration: Path,
    detections: Path,
    fps: float,
    out: Path,
    match_id: str | None = None,
    place: Placing | None = None,
) -> tuple[MatchSpec, list[str]]:
    """Write a match folder with the cameras of a calibration and their detections.

    The only clip, `clip`, spans the first to the last frame with a person; frames keep their
    numbers from the files. The function validates all 2D poses and stores them as npz: they are
    `<camera>.json` or `.npz` for each camera of the calibration, or a folder of OpenPose's files
    for each. The match's id is by default the name of `out`, which is absent or empty. The pitch is
    "none". `place` brings the cameras to metres with z up; None = they are. Returned are the
    content of match.yaml, and sentences about what was found and changed.
    InputError if a file is invalid, names do not match, there are no people, or `out` is not empty;
    nothing is written then.
    """
    left_out = LeftOut()
    cameras = read_calibration(calibration, left_out=left_out, any_unit=place is not None)
    files = detections_by_camera(detections, list(cameras), calibration, left_out)
    cameras = {name: cameras[name] for name in files}
    read = {name: read_people(file) for name, file in files.items()}
    people = {name: found.people for name, found in read.items()}
    first, stop = find_people(detections, people)
    for name, file in files.items():
        people[name] = on_frames(file, people[name], [(first, stop - first)])
    notes: list[str] = []
    if place is not None:
        cameras, notes = place(calibration, cameras, people, fps)
    sizes = {name: camera.image_size for name, camera in cameras.items()}
    notes += describe_outside(people, sizes)
    spec = build_spec(out, match_id, fps, sizes, (first, stop))
    write_match(out, spec, calibrations=cameras, observations=people)
    return spec, notes + describe_left_out(left_out) + describe_people(read)


def describe_left_out(left_out: LeftOut) -> list[str]:
    """Return sentences about cameras that are left out for each reason, and about the others."""
    notes = list(left_out.notes)
    for why in dict.fromkeys(left_out.values()):
        names = [name for name, reason in left_out.items() if reason == why]
        if len(names) == 1:
            notes.append(f"camera {names[0]} is left out: {why}")
        else:
            more = f" and {len(names) - 20} more" if len(names) > 20 else ""
            notes.append(f"cameras {', '.join(names[:20])}{more} are left out: {why}")
    return notes


def as_cameras(
    folder: Path, found: Mapping[str, Path], cameras: Collection[str]
) -> dict[str, Path]:
    """Return a folder's files by their cameras (`known_id`); InputError for two of one camera."""
    named: dict[str, Path] = {}
    for name, file in found.items():
        whole = file.stem if file.is_file() else file.name.removesuffix("_json")
        if (camera := known_id(whole if whole in cameras else name, cameras)) in named:
            two = f"{named[camera].name} and {file.name}"
            raise InputError(str(folder), f"one file of {camera}", two, "Keep one of them.")
        named[camera] = file
    return named


def camera_of(place: Path) -> str:
    """Return the camera of a video, of a file of 2D poses, or of a folder `<camera>_json`."""
    name = place.stem if place.is_file() else place.name
    name = name.removesuffix("_json")
    return camera_id(Path(name).stem if is_video(name) else name)


_CHANGES: Final = {
    "clamped": "confidences above 1, which count as 1",
    "nobody": "entries without a known joint, which count as no person",
    "pointless": "annotations without keypoints, such as of the ball, which count as no person",
    "foreign": "annotations of another category, which count as no person",
    "empty": "empty files, which count as frames without people",
}


def describe_people(read: Mapping[str, PeopleFile]) -> list[str]:
    """Return sentences about the points of cameras' 2D poses, and what was changed in them."""
    notes = []
    for kind in sorted({found.kind for found in read.values() if found.kind} - {"COCO-17"}):
        which = [name for name, found in read.items() if found.kind == kind]
        people = read[which[0]].people
        has_face = np.isfinite(people.confidence[..., :5]).any()
        kept = "the 17 keypoints of COCO" if has_face else "COCO's 12 of the body, not of the face"
        kept += " and heels and toes" if people.points else ""
        whose = "" if len(which) == len(read) else f" of {', '.join(which)}"
        notes.append(f"2D poses{whose}: {kind}; kept are {kept}; the others are left out")
    return notes + describe_changes(read)


def describe_outside(
    people: Mapping[str, KeypointDetections], sizes: Mapping[str, tuple[int, int]]
) -> list[str]:
    """Return a sentence about cameras many of whose keypoints are outside of their images."""
    most = 0.02  # share of keypoints that detectors guess beyond the border [1]
    shares = {}
    for name, found in people.items():
        known = found.keypoints[np.isfinite(found.confidence)]
        off = (known < -0.5) | (known > np.array(sizes[name]) - 0.5)
        shares[name] = float(off.any(axis=-1).mean()) if len(known) else 0.0
    said = [f"{share:.0%} of {name}" for name, share in shares.items() if share > most]
    if not said:
        return []
    return [
        f"warning: keypoints are outside of the images of the calibration: {', '.join(said)}; are "
        "they of images of another size, or of another camera?"
    ]


def describe_changes(read: Mapping[str, PeopleFile]) -> list[str]:
    """Return sentences about what was changed in cameras' 2D poses to read them."""
    notes = []
    for key, what in _CHANGES.items():
        counts = {name: getattr(found.changes, key) for name, found in read.items()}
        if total := sum(counts.values()):
            notes.append(f"{what}: {total} ({', '.join(name for name in counts if counts[name])})")
    lacking = {
        name: int((boxed & ~np.isfinite(found.people.confidence).any(axis=-1)).sum())
        for name, found in read.items()
        for boxed in [np.isfinite(found.people.boxes).all(axis=-1)]
    }
    if any(lacking.values()):
        listed = ", ".join(f"{count} of {name}" for name, count in lacking.items() if count)
        notes.append(f"warning: people have a box but no keypoint: {listed}")
    steps = {name: int(np.gcd.reduce(np.diff(found.people.frame))) for name, found in read.items()}
    if sparse := [f"{name}: one in {step}" for name, step in steps.items() if step > 1]:
        notes.append(f"2D poses are of some frames alone, by their numbers ({', '.join(sparse)})")
    spans = {name: seen for name, one in read.items() if (seen := seen_frames(one.people))}
    if nowhere := [name for name in read if name not in spans and spans]:
        notes.append(f"warning: the 2D poses of {', '.join(nowhere)} have nobody in any frame")
    for name, (first, last) in spans.items():
        others = [span for other, span in spans.items() if other != name]
        if others and not any(start <= last and first <= stop for start, stop in others):
            said = f"{name} has people in frames {first} to {last}, where no other camera has any"
            notes.append(f"warning: {said}")
    return notes


def detections_by_camera(
    folder: Path, cameras: Sequence[str], calibration: Path, left_out: LeftOut
) -> dict[str, Path]:
    """Return each camera's file of 2D poses, or its folder, as `pick_cameras`."""
    suffixes = (".json", ".npz")
    there = [each for each in sorted(folder.glob("[!.]*")) if each.suffix.lower() in suffixes]
    found: dict[str, Path] = {}
    for place in [*(each for each in there if each.is_file()), *pose_folders(folder)]:
        first = found.setdefault(camera_of(place), place)
        if first != place:
            left_out.notes.append(f"{place.name}: {first.name} is of the same camera; left out")
    found = as_cameras(folder, found, {*cameras, *left_out})
    endings = (*suffixes, "or a folder of .json")
    return pick_cameras(folder, found, cameras, calibration, endings, left_out)


def pose_folders(folder: Path) -> list[Path]:
    """Return the folders in a folder that hold 2D poses: JSON, or names `<camera>_json`."""
    there = [place for place in sorted(folder.glob("[!.]*")) if place.is_dir()]
    return [each for each in there if each.name.endswith("_json") or json_files(each)]


def import_lenses(
    files: Sequence[Path], folder: Path, camera: str | None = None
) -> dict[str, LensCalibration]:
    """Write lenses without a pose into a match folder's lenses.toml, and return them.

    Static calibration takes them as prior of focal length, principal point and distortion; the pose
    comes from clicks. `camera` is the static one of a file for `read_lenses` that names none.
    InputError if a camera is unknown, or has a lens or a calibration already.
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
            todo = "Remove it there first."
            raise InputError(f"{folder / place}: {name}", "no lens of this camera yet", "one", todo)
    with whole_file(target) as draft:
        write_lens_toml(draft, {**known, **lenses})
    return lenses


def pick_cameras(
    folder: Path,
    found: Mapping[str, Path],
    cameras: Sequence[str],
    calibration: Path,
    suffixes: Collection[str],
    left_out: LeftOut,
) -> dict[str, Path]:
    """Return the file of each camera that has one.

    `found` are the folder's files by name of a camera. `left_out` has cameras whose files are
    ignored; cameras without a file are added to it, and a sentence about files without a camera.
    InputError names folder, calibration and suffixes if fewer than two cameras, or fewer than all
    of one, remain.
    """
    files = {name: file for name, file in found.items() if name not in left_out}
    both = [name for name in cameras if name in files]
    if len(both) < max(1, min(2, len(cameras))):
        there = files.values() or sorted(folder.glob("[!.]*"))
        expected = f"one file ({', '.join(suffixes)}) for each camera in {calibration.name}: "
        found_names = ", ".join(f.name + "/" * f.is_dir() for f in there) or "no such file"
        todo = "Name them as the cameras, with a folder's files directly in it."
        raise InputError(str(folder), expected + ", ".join(cameras), found_names, todo)
    left_out.update({name: f"{folder} has no file of it" for name in cameras if name not in files})
    if others := [file.name for name, file in files.items() if name not in both]:
        left_out.notes.append(
            f"{', '.join(others)}: {calibration.name} has no camera of this name; left out"
        )
    return {name: files[name] for name in both}


def build_spec(
    out: Path,
    match_id: str | None,
    fps: float,
    sizes: Mapping[str, tuple[int, int]],
    frames: tuple[int, int],
    *,
    videos: Mapping[str, Path] = MappingProxyType({}),
    offsets: Mapping[str, int] = MappingProxyType({}),
) -> MatchSpec:
    """Return match.yaml of a match with the one clip `clip`.

    The name of `out` is the match's id if `match_id` is None; `fps` [1/s] is that of all cameras,
    and sizes are width and height [px]. `frames` are the clip's first one, and the one after its
    last. `videos` and `offsets` have files in `videos/` and `offset_frames` of the cameras with
    one.
    """
    content = {
        "match_id": match_id if match_id is not None else name_of(out),
        "fps": fps,
        "cameras": [
            {"id": name, "width": width, "height": height}
            | ({"video": f"videos/{video_name(name, videos[name])}"} if name in videos else {})
            | ({"offset_frames": offsets[name]} if offsets.get(name) else {})
            for name, (width, height) in sizes.items()
        ],
        "clips": [{"id": "clip", "first_frame": frames[0], "frame_count": frames[1] - frames[0]}],
        "pitch": "none",
    }
    return validate_record(MatchSpec, content, str(out / "match.yaml"))


def find_people(folder: Path, people: Mapping[str, KeypointDetections]) -> tuple[int, int]:
    """Return the first frame with a person in any camera, and the one after the last."""
    seen = [frames for frames in map(seen_frames, people.values()) if frames is not None]
    if not seen:
        raise InputError(str(folder), "people", "none in any frame", "Check the detector.")
    return min(first for first, _ in seen), max(last + 1 for _, last in seen)


def name_of(folder: Path) -> str:
    """Return the folder's name without characters that ids do not allow."""
    name = re.sub(r"[^A-Za-z0-9._-]+", "-", folder.resolve().name).strip("-._")[:64]
    return name or "match"


def import_videos(
    calibration: Path | None,
    videos: Path,
    out: Path,
    fps: float | None = None,
    match_id: str | None = None,
    boxes: Path | None = None,
    place: Placing | None = None,
    join: bool = False,
) -> tuple[MatchSpec, list[str]]:
    """Write a match folder with the cameras of a calibration and copies of their videos.

    Without a calibration each video is a camera, to be located by clicks or by people. A camera
    that was calibrated in larger or smaller images of the same shape is scaled to its video.

    The only clip, `clip`, ends with the last frame that two videos show; `offset_frames` can shift
    videos later. Cameras without a video are left out, and videos without a camera.

    `videos` has a video, or a folder of numbered images, for each camera, called as the camera;
    `boxes` has `<camera>.txt` of people's boxes (`read_boxes`), in which only poses are estimated,
    for some of the cameras or all. `fps` is by default that of the videos; images have none. With
    `join`, chapters of one recording, as GoPro names them, become one video. Id, `out`, `place`
    and the result are as in `import_match`.
    InputError if a file is invalid, names or rates do not match, or `out` is not empty; nothing is
    written then.
    """
    with tempfile.TemporaryDirectory(prefix="worldpose-") as joined:
        # A calibration may name its cameras after files that are named as chapters.
        is_named = calibration is not None and not join
        found = find_videos(videos, Path(joined) if join else None, named=is_named)
        if calibration is None:
            found = without_strays(videos, found, ())
            require_cameras(videos, found)
        states = {file: file_state(file) for file in found.values()}
        by_file = {file: index_video(file) for file in found.values()}
        indices = {name: by_file[file] for name, file in found.items()}
        cameras: dict[str, CameraCalibration] = {}
        notes: list[str] = []
        files = dict(found)
        if calibration is not None:
            left_out = LeftOut()
            shown = {name: index.size for name, index in indices.items()}
            cameras = read_calibration(calibration, shown, left_out, any_unit=place is not None)
            found = as_cameras(videos, found, {*cameras, *left_out})
            found = without_strays(videos, found, {*cameras, *left_out})
            is_joined = any(not file.is_relative_to(videos) for file in found.values())
            if found.keys() - left_out.keys() != cameras.keys() and not is_joined:
                find_videos(videos)  # raises for chapters
            endings = VIDEO_SUFFIXES
            files = pick_cameras(videos, found, list(cameras), calibration, endings, left_out)
            notes += describe_left_out(left_out)
            indices = {name: by_file[file] for name, file in files.items()}
            cameras = {name: cameras[name] for name in files}
            for name, file in files.items():
                cameras[name] = fit_to_video(
                    file, cameras[name], indices[name], notes, of_sensor=is_of_sensor(calibration)
                )
        rate = _first_rate(files, indices) if fps is None else fps
        clocks = {name: index.on_clock(rate, str(files[name])) for name, index in indices.items()}
        notes += describe_videos(files, indices, clocks)
        notes += describe_unused(videos, found.values())
        sizes = {name: index.size for name, index in indices.items()}
        count = shared_length(map(len, clocks.values()))
        spec = build_spec(out, match_id, rate, sizes, (0, count), videos=files)
        if place is not None:
            cameras, notes[:0] = place(calibration or videos, cameras, {}, rate)

        def copy(match: Path) -> None:
            copy_videos(files, match)
            require_settled({files[name]: states[files[name]] for name in files}, "import again")
            if boxes is not None:
                copy_boxes(boxes, indices, match, notes)

        write_match(out, spec, calibrations=cameras, observations={}, further=copy)
        return spec, notes


def _first_rate(files: Mapping[str, Path], indices: Mapping[str, FrameIndex]) -> float:
    """Return the rate of the first video that has one [1/s]; InputError if none has."""
    rates = [index.fps for index in indices.values() if np.isfinite(index.fps)]
    if not rates:
        expected = "frames per second, which images and a single frame do not tell"
        todo = "Add for example --fps 25."
        raise InputError(str(next(iter(files.values()))), expected, "none", todo)
    return round(rates[0], 3)
