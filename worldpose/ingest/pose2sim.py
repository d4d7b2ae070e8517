"""Import of a trial of Pose2Sim: its calibration, 2D poses, videos and settings."""

from __future__ import annotations

import hashlib
from collections import Counter
from collections.abc import Mapping, Sequence
from dataclasses import replace
from functools import partial
from math import isfinite
from pathlib import Path
from typing import Any

from data_contracts.cameras import CameraCalibration
from data_contracts.keypoints import KeypointDetections
from data_contracts.match import MatchSpec
from worldpose.errors import InputError
from worldpose.formats.calibration_files import LeftOut
from worldpose.formats.calibration_forms import (
    TOML,
    calibrations_in,
    find_calibration,
    is_of_sensor,
    read_calibration,
)
from worldpose.formats.detection_files import frame_files, json_files, read_openpose_folder
from worldpose.formats.files import by_last_number, read_toml
from worldpose.formats.keypoint_files import on_frames
from worldpose.formats.keypoint_sets import PeopleFile
from worldpose.ingest.camera_videos import (
    copy_videos,
    describe_unused,
    describe_videos,
    find_videos,
    fit_to_video,
    require_cameras,
    shared_length,
    without_strays,
)
from worldpose.ingest.importing import (
    Placing,
    as_cameras,
    build_spec,
    camera_of,
    describe_left_out,
    describe_outside,
    describe_people,
    find_people,
    pose_folders,
)
from worldpose.ingest.writing import write_match
from worldpose.video.folder import index_video
from worldpose.video.pictures import FrameIndex


def import_pose2sim(
    project: Path,
    out: Path,
    fps: float | None = None,
    match_id: str | None = None,
    place: Placing | None = None,
) -> tuple[MatchSpec, list[str]]:
    """Write a match folder with cameras, 2D poses and videos of a trial of Pose2Sim.

    The calibration is the one in `calibration/`, of the trial or of the folder above it, as in
    Pose2Sim's batches, in any form that `read_calibration` reads; without it each video is a
    camera. 2D poses are in `pose-sync/`, or else `pose/`, in a folder `<camera>_json` for each
    camera; without them people are detected in the videos of `videos/`. Poses and videos belong to
    the cameras of their names, or, as in Pose2Sim, in the order of the last numbers in their names
    to the cameras in the calibration's order. The shift of `pose-sync/` against `pose/` is the
    clock of a camera's video. `frame_rate` and `frame_range` of Config.toml hold. Where a video is
    smaller or larger than the calibrated images, with or without black bars, its camera is in the
    video's pixels, as the 2D poses are.

    `fps` [1/s] None is that of Config.toml or the videos; `out`, `match_id`, `place`, the result
    and the errors are as of `import_match`.
    """
    settings, config = _read_pose2sim_settings(project)
    calibration = _find_pose2sim_calibration(project)
    folder = project / "pose-sync" if (project / "pose-sync").is_dir() else project / "pose"
    places = {camera_of(each): each for each in pose_folders(folder)}
    films_in = project / "videos"
    films = find_videos(films_in)
    if not places and not films:
        expected = f"{folder.name}/<camera>_json folders of 2D poses, or videos/<camera>.mp4"
        todo = "Run Pose2Sim.poseEstimation() first, or add the videos."
        raise InputError(str(project), expected, "neither", todo)
    known = {file: index_video(file) for file in films.values()}
    left_out = LeftOut()
    cameras: dict[str, CameraCalibration] = {}
    if calibration is not None:
        shown = {name: known[file].size for name, file in films.items()}
        cameras = read_calibration(calibration, shown, left_out, any_unit=place is not None)
        films = as_cameras(films_in, films, {*cameras, *left_out})
        places = as_cameras(folder, places, {*cameras, *left_out})
    films = without_strays(films_in, films, {*cameras, *left_out})
    used = set(films.values())
    if calibration is None:
        notes = [
            "no calibration: worldpose calibrate finds lenses, and worldpose locate-cameras the "
            "poses from people who walk"
        ]
        require_cameras(films_in, films)
        names, source = list(films), films_in
    else:
        notes = [f"cameras: {calibration}", *describe_left_out(left_out)]
        names, source = list(cameras), calibration
        places = {name: each for name, each in places.items() if name not in left_out}
        films = {name: each for name, each in films.items() if name not in left_out}
    of_sensor = calibration is not None and is_of_sensor(calibration)
    poses = _assign(folder, places, names, source, notes) if places else {}
    videos = _assign(films_in, films, names, source, notes) if films else {}
    names = [name for name in names if name in (poses or videos)]
    cameras = {name: camera for name, camera in cameras.items() if name in names}
    videos = {name: file for name, file in videos.items() if name in names}
    indices = {name: known[file] for name, file in videos.items()}
    for name, file in videos.items():
        if name in cameras:
            cameras[name] = fit_to_video(
                file,
                cameras[name],
                indices[name],
                notes,
                of_sensor=of_sensor,
                has_poses=bool(poses),
            )
    rate = fps if fps is not None else settings.get("frame_rate")
    rate = _measure_rate(config, list(indices.values())) if rate is None else rate
    clocks = {name: index.on_clock(rate, str(videos[name])) for name, index in indices.items()}
    if clocks:
        notes += describe_videos(videos, indices, clocks) + describe_unused(films_in, used)
    length = shared_length(map(len, clocks.values()))
    model = settings.get("pose_model")
    read = {name: read_openpose_folder(place, model) for name, place in poses.items()}
    people = {name: found.people for name, found in read.items()}
    offsets = _find_shifts(project / "pose", poses, notes) if videos else {}
    offsets = _from_zero(people, offsets, indices, notes)
    first, stop = find_people(folder, people) if people else (0, length)
    first, stop = settings.get("frame_range", (first, stop))
    for name, files in poses.items():
        people[name] = on_frames(files, people[name], [(first, stop - first)])
    if place is not None:
        cameras, notes[:0] = place(calibration or project, cameras, people, rate)
    _require_video_sizes(folder, cameras, indices)
    sizes = {
        name: (cameras[name].image_size if name in cameras else indices[name].size)
        for name in names
    }
    spec = build_spec(out, match_id, rate, sizes, (first, stop), videos=videos, offsets=offsets)
    for name, shift in offsets.items():
        people[name] = replace(people[name], frame=people[name].frame + shift)
    write_match(
        out, spec, calibrations=cameras, observations=people, further=partial(copy_videos, videos)
    )
    return spec, notes + describe_outside(people, sizes) + _describe_poses(folder, read)


def _from_zero(
    people: Mapping[str, KeypointDetections],
    offsets: dict[str, int],
    indices: Mapping[str, FrameIndex],
    notes: list[str],
) -> dict[str, int]:
    """Return the offsets of videos whose frame 0 has 2D poses of number 1, where the numbers tell.

    `pose/` is numbered from 1 if it has no 0 but a number as high as a video has frames.
    """
    frames = {n: people[n].frame + offsets.get(n, 0) for n in indices if n in people}
    beyond = max((frame[-1] - len(indices[n]) for n, frame in frames.items()), default=1)
    if beyond > 0 or min(frame[0] for frame in frames.values()) != 1:
        return offsets
    if beyond < 0:
        notes.append("warning: the 2D poses begin at 1, which is taken as the videos' second frame")
        return offsets
    notes.append("2D poses are numbered from 1 to the videos' lengths: 1 is the videos' frame 0")
    return {name: offsets.get(name, 0) - 1 for name in frames}


def _find_shifts(raw: Path, poses: Mapping[str, Path], notes: list[str]) -> dict[str, int]:
    """Return the frame of each camera's video that its frame 0 of synchronised poses shows.

    Pose2Sim copies the files of `pose/` to `pose-sync/` under shifted numbers: files that are equal
    tell the shift. Frames of one content, as those without people, tell none.
    """

    def once(folder: Path) -> dict[bytes, int]:
        there = frame_files(folder) if json_files(folder) else {}
        told = {frame: hashlib.sha256(file.read_bytes()).digest() for frame, file in there.items()}
        count = Counter(told.values())
        return {content: frame for frame, content in told.items() if count[content] == 1}

    steps: dict[str, set[int]] = {}
    for name, folder in poses.items():
        if folder.parent == raw:
            return {}
        before, after = once(raw / folder.name), once(folder)
        steps[name] = {before[same] - after[same] for same in before.keys() & after.keys()}
    shifts = {name: min(found) for name, found in steps.items() if len(found) == 1}
    if listed := ", ".join(f"{name} {shift}" for name, shift in shifts.items() if shift):
        notes.append(f"the videos follow pose-sync by offset_frames, from pose: {listed}")
    if unknown := ", ".join(name for name in steps if name not in shifts):
        notes.append(
            f"warning: how pose-sync was shifted against pose is not known of {unknown}: set "
            "offset_frames in match.yaml where a video shows other frames"
        )
    return shifts


def _require_video_sizes(
    folder: Path, cameras: Mapping[str, CameraCalibration], indices: Mapping[str, FrameIndex]
) -> None:
    """Raise InputError if the 2D poses in a folder make a camera another size than its video's."""
    for name, camera in cameras.items():
        if name in indices and camera.image_size != indices[name].size:
            (width, height), (own_width, own_height) = indices[name].size, camera.image_size
            expected = f"2D poses in the pixels of the videos, {width} x {height} in {name}"
            agreed = f"people on whom the cameras agree in images of {own_width} x {own_height} px"
            todo = "Give the videos in which the poses were estimated, or estimate them again."
            raise InputError(str(folder), expected, f"{agreed} alone", todo)


def _describe_poses(folder: Path, read: Mapping[str, PeopleFile]) -> list[str]:
    """Return sentences about the 2D poses of cameras and what of them is kept."""
    if not read:
        return [
            f"no 2D poses in {folder}: the run detects people in the videos; the bundled detector "
            "is for people of 28 to 160 px, others need --set detection.detector=onnx:FILE"
        ]
    kinds = sorted({found.kind for found in read.values() if found.kind})
    return [f"2D poses: {folder}, {' and '.join(kinds)}", *describe_people(read)]


def _measure_rate(config: Path, indices: Sequence[FrameIndex]) -> float:
    """Return the frame rate of the first video [1/s]; raise InputError if none tells it."""
    rates = [index.fps for index in indices if isfinite(index.fps)]
    if not rates:
        expected = "frames per second, as there are no videos to take them from"
        todo = "Write for example frame_rate = 60, or give --fps."
        raise InputError(f"{config}: project.frame_rate", expected, "'auto'", todo)
    return round(rates[0], 3)


def _read_pose2sim_settings(project: Path) -> tuple[dict[str, Any], Path]:
    """Return `frame_rate`, `frame_range`, `pose_model` where Config.toml sets them, and that file.

    As in Pose2Sim, the file of the folder above gives what the trial's file lacks.
    """
    if not project.is_dir():
        expected = "the folder of a Pose2Sim trial"
        todo = "Give the folder that has videos/ or pose/, and Config.toml."
        raise InputError(str(project), expected, "a file" if project.exists() else "nothing", todo)
    files = [place / "Config.toml" for place in (project, project.resolve().parent)]
    given: dict[str, Any] = {}
    # Entries of Config.toml that hold.
    held_entries = ("frame_rate", "frame_range", "pose_model")
    for file in reversed(files):
        content = read_toml(file) if file.is_file() else {}
        for name in ("project", "pose"):
            table = content.get(name, {})
            if not isinstance(table, dict):
                raise InputError(f"{file}: {name}", "a table", f"{table!r:.40}", "Correct it.")
            given |= {key: (table[key], file) for key in held_entries if key in table}
    model, _ = given.get("pose_model", (None, files[0]))
    settings: dict[str, Any] = {"pose_model": model} if isinstance(model, str) else {}
    rate, place = given.get("frame_rate", ("auto", files[0]))
    if rate != "auto":
        if isinstance(rate, bool) or not isinstance(rate, int | float) or not rate > 0:
            expected = "frames per second or 'auto'"
            todo = "Write for example frame_rate = 60."
            raise InputError(f"{place}: project.frame_rate", expected, f"{rate!r:.40}", todo)
        settings["frame_rate"] = float(rate)
    span, place = given.get("frame_range", ("auto", files[0]))
    if span not in ("auto", "all", []):
        whole = isinstance(span, list) and [type(one) for one in span] == [int, int]
        if not whole or not 0 <= span[0] < span[1]:
            expected = "'auto', 'all', or the first frame and the one after the last"
            todo = "Write for example frame_range = [10, 300]."
            raise InputError(f"{place}: project.frame_range", expected, f"{span!r:.40}", todo)
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
            expected = "one calibration *.toml"
            todo = "Move the others elsewhere."
            raise InputError(str(folder), expected, ", ".join(file.name for file in written), todo)
        if written:
            return written[0]
        if found:
            _, files = find_calibration(folder)
            return files[0] if len(files) == 1 else folder
    if (project / "videos").is_dir():
        return None
    expected = "calibration/Calib.toml or another form of calibration, or videos"
    todo = "Run Pose2Sim.calibration() first."
    raise InputError(
        str(project), expected, ", ".join(map(str, folders)) or "no folder called calibration", todo
    )


def _assign(
    folder: Path, named: dict[str, Path], cameras: list[str], calibration: Path, notes: list[str]
) -> dict[str, Path]:
    """Return the place in a folder of each camera: by name, or else by the last number in its name.

    Names without a number are in alphabetical order.
    """
    places = list(named.values())
    both = [camera for camera in cameras if camera in named]
    if len(both) > 1 or len(both) == len(cameras):
        if lacking := [camera for camera in cameras if camera not in named]:
            notes.append(f"{folder.name} lacks {', '.join(lacking)}")
        if others := [place.name for name, place in named.items() if name not in both]:
            notes.append(f"{calibration.name} lacks {', '.join(others)}")
        return {camera: named[camera] for camera in both}
    if len(named) != len(cameras):
        expected = f"one for each camera in {calibration.name}: {', '.join(cameras)}"
        found = ", ".join(place.name for place in places)
        raise InputError(str(folder), expected, found, "Name them after the cameras.")
    pairs = dict(zip(cameras, by_last_number(named).values(), strict=True))
    listed = ", ".join(f"{place.name} is {camera}" for camera, place in pairs.items())
    notes.append(f"{folder.name}: in the order of the names, {listed}")
    return pairs
