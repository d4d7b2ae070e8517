"""Import of other tools' calibration with 2D poses or videos into a match folder."""

from __future__ import annotations

import re
import shutil
from collections.abc import Sequence
from pathlib import Path
from typing import Literal

from data_contracts.cameras import LensCalibration
from data_contracts.match import MatchSpec
from worldpose.errors import InputError
from worldpose.formats.calibration_files import read_calibration
from worldpose.formats.files import whole_file
from worldpose.formats.keypoint_files import on_frames, read_observations, seen_frames
from worldpose.formats.lens_files import read_lens_toml, read_lenses, write_lens_toml
from worldpose.ingest.match_folder import LENS_FILE, image_sizes, read_spec
from worldpose.ingest.validation import validate_record
from worldpose.ingest.writing import write_match
from worldpose.video import index_frames


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
