"""Import of other tools' calibration with 2D poses or videos, or of a project of Pose2Sim."""

from __future__ import annotations

import re
import shutil
from collections.abc import Collection, Mapping, Sequence
from pathlib import Path
from typing import Any, Final, Literal

import numpy as np
from numpy.typing import NDArray

from data_contracts.arrays import Image
from data_contracts.cameras import CameraCalibration, LensCalibration
from data_contracts.keypoints import KeypointDetections
from data_contracts.match import MatchSpec
from worldpose.errors import InputError
from worldpose.formats.calibration_files import camera_id
from worldpose.formats.calibration_forms import (
    TOML,
    calibrations_in,
    find_calibration,
    read_calibration,
)
from worldpose.formats.detection_files import OpenPoseFolder, read_openpose_folder
from worldpose.formats.files import read_toml, whole_file
from worldpose.formats.keypoint_files import on_frames, read_observations, seen_frames
from worldpose.formats.lens_files import read_lens_toml, read_lenses, write_lens_toml
from worldpose.ingest.match_folder import LENS_FILE, image_sizes, read_spec
from worldpose.ingest.validation import validate_record
from worldpose.ingest.writing import copy_boxes, write_match
from worldpose.video.files import VideoReader, index_frames
from worldpose.video.names import VIDEO_SUFFIXES, is_video
from worldpose.video.pictures import FrameIndex

SAME_SHAPE: Final = 0.002
"""Largest relative difference of two shapes of one picture [1]: sides are whole pixels."""
MAX_BLACK: Final = 16.0
"""Largest mean brightness of a black bar [1, of 255]: the black of limited-range video."""


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
        calibration: a file or folder that `read_calibration` reads.
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
    first, stop = _find_people(detections, people)
    content = {
        "match_id": match_id if match_id is not None else name_of(out),
        "fps": fps,
        "cameras": [
            {"id": name, "width": camera.image_size[0], "height": camera.image_size[1]}
            for name, camera in cameras.items()
        ],
        "clips": [{"id": "clip", "first_frame": first, "frame_count": stop - first}],
        "pitch": pitch,
    }
    spec = validate_record(MatchSpec, content, str(out / "match.yaml"))
    for name, file in files.items():
        people[name] = on_frames(file, people[name], [(first, stop - first)])
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
    folder: Path, cameras: Sequence[str], calibration: Path, suffixes: Collection[str]
) -> dict[str, Path]:
    """Return the file of each camera in a folder, by the camera's name.

    Raises:
        InputError: a camera lacks its file, or a file its camera.
    """
    there = sorted(folder.glob("[!.]*"))
    files = [file for file in there if file.suffix.lower() in suffixes]
    if sorted(camera_id(file.stem) for file in files) != sorted(cameras):
        raise InputError(
            str(folder),
            expected=f"one file ({', '.join(suffixes)}) for each camera in {calibration.name}: "
            + ", ".join(cameras),
            found=", ".join(file.name for file in files or there) or "no such file",
            todo="Rename the files as the cameras, and leave neither over.",
        )
    by_name = {camera_id(file.stem): file for file in files}
    return {name: by_name[name] for name in cameras}


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
) -> MatchSpec:
    """Write a match folder with the cameras of a calibration and copies of their videos.

    Without a calibration each video is a camera, to be located by clicks or by people.

    The only clip, `clip`, is as long as the shortest video. Videos begin together: `offset_frames`
    in match.yaml can shift them afterwards.

    Args:
        calibration: a file or folder that `read_calibration` reads; None = not known.
        videos: folder with a video for each camera of the calibration, called as the camera.
        out: the match folder, absent or empty.
        fps: frame rate of all videos [1/s]; None = from the videos.
        match_id: id of the match; None = the name of `out`.
        boxes: folder with `<camera>.txt` of people's boxes (`read_boxes`), in which only poses are
            estimated, for some of the cameras or all; None = people are detected.

    Returns:
        Content of match.yaml.

    Raises:
        InputError: a file is invalid, names or rates do not match, or `out` is not empty; nothing
            is written then.
    """
    cameras: dict[str, CameraCalibration] = {}
    if calibration is None:
        files = {camera_id(file.stem): file for file in _films(videos)}
        indices = {name: index_frames(file) for name, file in files.items()}
    else:
        cameras = read_calibration(calibration)
        files = files_by_camera(videos, list(cameras), calibration, VIDEO_SUFFIXES)
        indices = {name: _index_video(file, cameras[name]) for name, file in files.items()}
    rate = round(next(iter(indices.values())).fps, 3) if fps is None else fps
    counts = {name: len(index.on_clock(rate, str(files[name]))) for name, index in indices.items()}
    content = {
        "match_id": match_id if match_id is not None else name_of(out),
        "fps": rate,
        "cameras": [
            {
                "id": name,
                "width": index.size[0],
                "height": index.size[1],
                "video": f"videos/{files[name].name}",
            }
            for name, index in indices.items()
        ],
        "clips": [{"id": "clip", "frame_count": min(counts.values())}],
        "pitch": "none",
    }
    spec = validate_record(MatchSpec, content, str(out / "match.yaml"))

    def copy(folder: Path) -> None:
        (folder / "videos").mkdir()
        for file in files.values():
            shutil.copyfile(file, folder / "videos" / file.name)
        if boxes is not None:
            copy_boxes(boxes, indices, folder)

    write_match(out, spec, calibrations=cameras, observations={}, further=copy)
    return spec


def _films(folder: Path) -> list[Path]:
    """Return the videos of a folder, each of which is a camera.

    Raises:
        InputError: there are fewer than two, or two of one name.
    """
    there = sorted(folder.glob("[!.]*"))
    files = [file for file in there if is_video(file)]
    if len({camera_id(file.stem) for file in files}) != len(files) or len(files) < 2:
        raise InputError(
            str(folder),
            expected=f"a video for each of two cameras or more ({', '.join(VIDEO_SUFFIXES)})",
            found=", ".join(file.name for file in files or there) or "no video",
            todo="Name each video after its camera.",
        )
    return files


def _index_video(file: Path, camera: CameraCalibration) -> FrameIndex:
    """Return the frames of a camera's video, which has the size in the calibration."""
    index = index_frames(file)
    if index.size != camera.image_size:
        raise _wrong_size(file, camera, index)
    return index


def _wrong_size(file: Path, camera: CameraCalibration, index: FrameIndex) -> InputError:
    return InputError(
        str(file),
        expected="{} x {} px, the size in the calibration".format(*camera.image_size),
        found=f"{index.size[0]} x {index.size[1]}",
        todo="Give the video that was calibrated, in its size: a crop has another principal point.",
    )


def _fit_to_video(
    file: Path,
    camera: CameraCalibration,
    index: FrameIndex,
    notes: list[str],
    *,
    is_part: bool = False,
) -> CameraCalibration:
    """Return a camera in the pixels of its video, which may be resized, or have black bars.

    Args:
        file: the video.
        camera: the camera in the calibrated pixels.
        index: the video's frames.
        notes: sentences for the user, to which a change is added.
        is_part: whether a smaller video is the middle part of the image, as Vicon's video modes
            are of the sensor to which the calibration belongs.

    Raises:
        InputError: the video is neither what was calibrated nor the same picture resized.
    """
    if index.size == camera.image_size:
        return camera
    own, shown = np.array(camera.image_size), np.array(index.size)
    if is_part and np.all(shown <= own):
        corner = 0.5 * (own - shown)
        notes.append(f"{file.name}: the middle {index.size[0]} x {index.size[1]} px of the sensor")
        middle = np.array(camera.principal_point_px) - corner
        return camera.model_copy(
            update={"image_size": index.size, "principal_point_px": tuple(middle.tolist())}
        )
    scale = float((shown / own).min())
    bar = 0.5 * (shown - scale * own)
    if (shown / own).max() > (1.0 + SAME_SHAPE) * scale:
        with VideoReader(file, index) as video:
            if not _has_black_bars(video.frame(0), bar):
                raise _wrong_size(file, camera, index)
    # Pixel centres are whole numbers, so that the picture's corner is at -0.5.
    middle = (np.array(camera.principal_point_px) + 0.5) * scale - 0.5 + bar
    notes.append(
        f"{file.name}: {index.size[0]} x {index.size[1]} px, calibrated are {{}} x {{}}: ".format(
            *camera.image_size
        )
        + f"the calibration is scaled by {scale:.5f}"
        + (f", with black bars of {bar.max():.1f} px" if bar.max() > 1.0 else "")
    )
    return camera.model_copy(
        update={
            "image_size": index.size,
            "focal_px": tuple(scale * focal for focal in camera.focal_px),
            "principal_point_px": tuple(middle.tolist()),
        }
    )


def _has_black_bars(frame: Image, bar: NDArray[np.float64]) -> bool:
    """Return whether a frame has black bars of a width on both sides of one axis, and no wider.

    Args:
        frame: (height, width, channels).
        bar: their width along x and y [px], with a fraction.
    """
    axis = int(bar.argmax())
    width = int(bar[axis])
    lines = frame.mean(axis=(axis, 2)).astype(np.float64)
    black = np.concatenate([lines[:width], lines[len(lines) - width :]])
    # The line next to a bar with a fraction is a mixture.
    next_lines = [lines[width + 2], lines[-width - 3]]
    return width > 0 and bool(black.max() < MAX_BLACK and min(next_lines) > MAX_BLACK)


def import_pose2sim(
    project: Path, out: Path, fps: float | None = None, match_id: str | None = None
) -> tuple[MatchSpec, list[str]]:
    """Write a match folder with cameras, 2D poses and videos of a trial of Pose2Sim.

    The calibration is the one in `calibration/`, of the trial or of the folder above it, as in
    Pose2Sim's batches, in any form that `read_calibration` reads; without it each video is a
    camera. 2D poses are in `pose-sync/`, or else `pose/`, in a folder `<camera>_json` for each
    camera; without them people are detected in the videos of `videos/`. Poses and videos belong to
    the cameras of their names, or, as in Pose2Sim, in alphabetical order to the cameras in the
    calibration's order. `frame_rate` and `frame_range` of Config.toml hold. Where a video is
    smaller or larger than the calibrated images, with or without black bars, its camera is in the
    video's pixels, as the 2D poses are.

    Args:
        project: folder of a trial.
        out: the match folder, absent or empty.
        fps: frame rate of all cameras [1/s]; None = from Config.toml or the videos.
        match_id: id of the match; None = the name of `out`.

    Returns:
        Content of match.yaml, and sentences about what was found and what was left out.

    Raises:
        InputError: something is absent, invalid or contradicts the rest; nothing is written then,
            and the error names file and key.
    """
    settings, config = _read_pose2sim_settings(project)
    calibration = _find_pose2sim_calibration(project)
    cameras = {} if calibration is None else read_calibration(calibration)
    folder = project / "pose-sync" if (project / "pose-sync").is_dir() else project / "pose"
    places = [each for each in sorted(folder.glob("*")) if each.is_dir()]
    films = [file for file in sorted((project / "videos").glob("[!.]*")) if is_video(file)]
    if not places and not films:
        raise InputError(
            str(project),
            expected=f"{folder.name}/<camera>_json folders of 2D poses, or videos/<camera>.mp4",
            found="neither",
            todo="Run Pose2Sim.poseEstimation() first, or add the videos.",
        )
    if calibration is None:
        notes = [
            "no calibration: worldpose calibrate finds lenses, and worldpose locate-cameras the "
            "poses from people who walk"
        ]
        names = [camera_id(file.stem) for file in _films(project / "videos")]
        source = project / "videos"
    else:
        notes = [f"cameras: {calibration}"]
        names, source = list(cameras), calibration
    is_part = calibration is not None and calibration.suffix.lower() == ".xcp"
    poses = _assign(places, names, source, notes) if places else {}
    videos = _assign(films, names, source, notes) if films else {}
    indices = {name: index_frames(file) for name, file in videos.items()}
    for name, file in videos.items():
        if name in cameras:
            cameras[name] = _fit_to_video(
                file, cameras[name], indices[name], notes, is_part=is_part
            )
    sizes = {name: index.size for name, index in indices.items()}
    sizes |= {name: camera.image_size for name, camera in cameras.items()}
    rate = fps if fps is not None else settings.get("frame_rate")
    rate = _measure_rate(config, list(indices.values())) if rate is None else rate
    counts = [len(index.on_clock(rate, str(videos[name]))) for name, index in indices.items()]
    read = {name: read_openpose_folder(place) for name, place in poses.items()}
    people = {name: found.people for name, found in read.items()}
    first, stop = _find_people(folder, people) if people else (0, min(counts, default=0))
    first, stop = settings.get("frame_range", (first, stop))
    content = {
        "match_id": match_id if match_id is not None else name_of(out),
        "fps": rate,
        "cameras": [
            {"id": name, "width": sizes[name][0], "height": sizes[name][1]}
            | ({"video": f"videos/{videos[name].name}"} if name in videos else {})
            for name in names
        ],
        "clips": [{"id": "clip", "first_frame": first, "frame_count": stop - first}],
        "pitch": "none",
    }
    spec = validate_record(MatchSpec, content, str(out / "match.yaml"))
    for name, place in poses.items():
        people[name] = on_frames(place, people[name], [(first, stop - first)])

    def copy(building: Path) -> None:
        if videos:
            (building / "videos").mkdir()
        for file in videos.values():
            shutil.copyfile(file, building / "videos" / file.name)

    write_match(out, spec, calibrations=cameras, observations=people, further=copy)
    return spec, notes + _describe_poses(folder, read)


def _find_people(folder: Path, people: Mapping[str, KeypointDetections]) -> tuple[int, int]:
    """Return the first frame with a person in any camera, and the one after the last."""
    seen = [frames for frames in map(seen_frames, people.values()) if frames is not None]
    if not seen:
        raise InputError(
            str(folder), expected="people", found="none in any frame", todo="Check the detector."
        )
    return min(first for first, _ in seen), max(last + 1 for _, last in seen)


def _describe_poses(folder: Path, read: Mapping[str, OpenPoseFolder]) -> list[str]:
    """Return sentences about the 2D poses of cameras and what of them is kept."""
    if not read:
        return [
            f"no 2D poses in {folder}: the run detects people in the videos; the bundled detector "
            "is for people of 28 to 160 px, others need --set detection.detector=onnx:FILE"
        ]
    kinds = {found.kind: found.people.points for found in read.values() if found.kind}
    return [
        f"2D poses: {folder}, {kind}; kept are the 17 keypoints of COCO"
        + (" and heels and toes" if points else "")
        + ("" if kind == "COCO-17" else "; those of hands, face and trunk are left out")
        for kind, points in sorted(kinds.items())
    ]


def _measure_rate(config: Path, indices: Sequence[FrameIndex]) -> float:
    """Return the frame rate of the first video [1/s]; raise InputError without videos."""
    if not indices:
        raise InputError(
            f"{config}: project.frame_rate",
            expected="frames per second, as there are no videos to take them from",
            found="'auto'",
            todo="Write for example frame_rate = 60, or give --fps.",
        )
    return round(indices[0].fps, 3)


def _read_pose2sim_settings(project: Path) -> tuple[dict[str, Any], Path]:
    """Return `frame_rate` and `frame_range` where Config.toml sets them, and that file.

    As in Pose2Sim, the file of the folder above gives what the trial's file lacks.
    """
    if not project.is_dir():
        raise InputError(
            str(project),
            expected="the folder of a Pose2Sim trial",
            found="a file" if project.exists() else "nothing",
            todo="Give the folder that has videos/ or pose/, and Config.toml.",
        )
    files = [place / "Config.toml" for place in (project, project.resolve().parent)]
    given: dict[str, Any] = {}
    for file in reversed(files):
        table = read_toml(file).get("project", {}) if file.is_file() else {}
        if not isinstance(table, dict):
            raise InputError(
                f"{file}: project", expected="a table", found=f"{table!r:.40}", todo="Correct it."
            )
        given |= {key: (table[key], file) for key in ("frame_rate", "frame_range") if key in table}
    settings: dict[str, Any] = {}
    rate, place = given.get("frame_rate", ("auto", files[0]))
    if rate != "auto":
        if isinstance(rate, bool) or not isinstance(rate, int | float) or not rate > 0:
            raise InputError(
                f"{place}: project.frame_rate",
                expected="frames per second or 'auto'",
                found=f"{rate!r:.40}",
                todo="Write for example frame_rate = 60.",
            )
        settings["frame_rate"] = float(rate)
    span, place = given.get("frame_range", ("auto", files[0]))
    if span not in ("auto", "all", []):
        whole = isinstance(span, list) and [type(one) for one in span] == [int, int]
        if not whole or not 0 <= span[0] < span[1]:
            raise InputError(
                f"{place}: project.frame_range",
                expected="'auto', 'all', or the first frame and the one after the last",
                found=f"{span!r:.40}",
                todo="Write for example frame_range = [10, 300].",
            )
        settings["frame_range"] = tuple(span)
    return settings, files[0]


def _find_pose2sim_calibration(project: Path) -> Path | None:
    """Return the calibration of a trial, or else of the folder above it; TOML before others.

    Pose2Sim writes its TOML next to the file that it converts. None if there is no calibration but
    videos, whose cameras are then to be located.
    """
    folders = [
        folder
        for place in (project, project.resolve().parent)
        for folder in sorted(place.glob("*"))
        if folder.is_dir() and "calib" in folder.name.lower()
    ]
    for folder in folders:
        found = calibrations_in(folder)
        written = [files[0] for form, files in found if form is TOML]
        if len(written) > 1:
            raise InputError(
                str(folder),
                expected="one calibration *.toml",
                found=", ".join(file.name for file in written),
                todo="Move the others elsewhere.",
            )
        if written:
            return written[0]
        if found:
            _, files = find_calibration(folder)
            return files[0] if len(files) == 1 else folder
    if (project / "videos").is_dir():
        return None
    raise InputError(
        str(project),
        expected="calibration/Calib.toml or another form of calibration, or videos",
        found=", ".join(map(str, folders)) or "no folder called calibration",
        todo="Run Pose2Sim.calibration() first.",
    )


def _assign(
    places: list[Path], cameras: list[str], calibration: Path, notes: list[str]
) -> dict[str, Path]:
    """Return the folder or file of each camera: by name, or else by alphabetical order."""
    if len(places) != len(cameras):
        raise InputError(
            str(places[0].parent),
            expected=f"one for each camera in {calibration.name}: {', '.join(cameras)}",
            found=", ".join(place.name for place in places),
            todo="Add the missing ones, or take the camera out of the calibration.",
        )
    named = {camera_id(place.stem.removesuffix("_json")): place for place in places}
    if set(named) == set(cameras):
        return {camera: named[camera] for camera in cameras}
    pairs = dict(zip(cameras, places, strict=True))
    listed = ", ".join(f"{place.name} is {camera}" for camera, place in pairs.items())
    notes.append(f"{places[0].parent.name}: in alphabetical order, {listed}")
    return pairs
