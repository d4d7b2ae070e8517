"""Reader of match folders, with checks for missing files and contradictions."""

from __future__ import annotations

import os
from collections.abc import Container, Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Final

from data_contracts.broadcast_calibration import KeyFrames
from data_contracts.cameras import CameraCalibration, LensCalibration
from data_contracts.match import ClipSpec, MatchSpec
from data_contracts.pitch import PitchSpec
from data_contracts.static_calibration import ClickedMarkings
from worldpose.errors import InputError
from worldpose.formats.calibration_files import read_calibration_toml
from worldpose.formats.calibration_unit import require_metres
from worldpose.formats.files import read_yaml
from worldpose.formats.lens_files import read_lens_toml
from worldpose.ingest.annotations import (
    BROADCAST_FILES,
    clicked_file,
    key_frames_file,
    read_clicked,
    read_key_frames,
)
from worldpose.ingest.pitch_file import pitch_file, read_pitch
from worldpose.ingest.validation import (
    existing_file,
    files_by_unit,
    find_file,
    reachable,
    validate_record,
)

CLICKS_NEEDED: Final = "at least four points of the pitch, better 8 to 12 all over the picture,"
"""Request in messages on cameras without calibration."""


@dataclass(frozen=True)
class MatchFolder:
    """Content of a match folder.

    Attributes:
        folder: path of the folder as given.
        spec: match.yaml.
        calibrations: given static cameras by id; may lack some.
        detections: given 2D poses, by id of the static camera or name of the broadcast view.
        pitch: the surveyed or standard pitch; None without a pitch.
        videos: video file or folder of images, by the same names.
        clicked: clicked markings, by id of a static camera; may lack some.
        stills: one image, by id of a static camera; may lack some.
        key_frames: clicked key frames, by name of a broadcast view; may lack some.
        lenses: given lenses without a pose, by id of a static camera; may lack some.
        estimates: monocular body estimates, by name of a broadcast view; may lack some.
        boxes: given boxes of people, by id or name of a video; may lack some. Those of a
            broadcast view in an npy file state who is who.
        camera_data: what a tracking system states about the camera, by name of a broadcast view;
            may lack some.
    """

    folder: Path
    spec: MatchSpec
    calibrations: Mapping[str, CameraCalibration]
    detections: Mapping[str, Path]
    pitch: PitchSpec | None
    videos: Mapping[str, Path]
    clicked: Mapping[str, ClickedMarkings]
    stills: Mapping[str, Path]
    key_frames: Mapping[str, KeyFrames]
    lenses: Mapping[str, LensCalibration] = field(default_factory=dict)
    estimates: Mapping[str, Path] = field(default_factory=dict)
    boxes: Mapping[str, Path] = field(default_factory=dict)
    camera_data: Mapping[str, Path] = field(default_factory=dict)

    def clip(self, clip_id: str | None = None) -> ClipSpec:
        """Return the clip with this id, or the first one; InputError if there is none."""
        for clip in self.spec.clips:
            if clip_id in (None, clip.id):
                return clip
        expected = f"one of the clips {', '.join(clip.id for clip in self.spec.clips)}"
        todo = "Correct the name."
        raise InputError(str(self.folder / "match.yaml"), expected, f"{clip_id!r}", todo)

    @property
    def to_click(self) -> tuple[str, ...]:
        """Static cameras without calibration and clicks that cannot be proposed either.

        A proposal needs the camera's image, the pitch, and a static camera with a stated side.
        """
        known = {*self.calibrations, *self.clicked}
        is_stated = any(each.side is not None for each in self.spec.static_cameras)
        if self.pitch is not None and is_stated:
            known |= {*self.stills, *self.videos}
        return tuple(each.id for each in self.spec.static_cameras if each.id not in known)

    @property
    def proposed_views(self) -> tuple[str, ...]:
        """Broadcast views without key frames whose key frames are proposed from their video.

        A proposal needs the view's video, the pitch, and a stated side of the camera or of a static
        camera, whose people then tell the side of the other.
        """
        if self.pitch is None:
            return ()
        told = any(each.side is not None for each in self.spec.static_cameras)
        views = self.spec.broadcast_views.items()
        filmed = {name: view for name, view in views if name in self.videos}
        return tuple(
            name
            for name, view in filmed.items()
            if name not in self.key_frames and (told or view.camera.side is not None)
        )

    @property
    def calibrated_views(self) -> tuple[str, ...]:
        """Broadcast views with a video whose key frames are clicked, proposed or given."""
        given = () if self.pitch is None else self.camera_data
        known = {*self.key_frames, *self.proposed_views, *given} & self.videos.keys()
        return tuple(name for name in self.spec.broadcast_views if name in known)


def read_match(
    folder: str | os.PathLike[str],
    known: Container[str] = (),
    pitch: PitchSpec | None = None,
    whose: str | None = "the pitch",
) -> MatchFolder:
    """Return the validated content of a match folder, without opening videos, stills, detections.

    Args:
        folder: contains match.yaml and the files that it names.
        known: paths in the folder of videos that may be gone, as their results are at hand.
        pitch: that of the settings, whose names clicks have; None = the folder's or the standard
            one. Of a venue of match.yaml without pitch.json, names are checked with `pitch` alone.
        whose: that pitch in words, for messages; None = the names of clicks are not checked.

    Raises:
        InputError: the folder is unreadable (its disk is not mounted, or this user has no
            permission); a file or key is missing, unknown, contradicts another or leads out of the
            folder; a static camera has neither video nor detections.
    """
    folder = Path(folder)
    with reachable(folder):
        return _read_match(folder, known, pitch, whose)


def read_spec(folder: Path) -> MatchSpec:
    """Return match.yaml of a match folder; InputError if it is missing or invalid."""
    with reachable(folder):
        file = folder / "match.yaml"
        if folder.is_dir() and not file.exists():
            todo = (
                "docs/reference/match_folder.md describes a match folder; worldpose import makes "
                "one from a calibration."
            )
            raise InputError(str(file), "a file", "nothing", todo)
        return validate_record(MatchSpec, read_yaml(file), str(file))


def spec_around(path: Path) -> tuple[Path, MatchSpec] | None:
    """Return the match folder that holds results, and its match.yaml; InputError if invalid."""
    whole = path.resolve()
    for folder in (whole, *whole.parents[:2]):
        if (folder / "match.yaml").is_file():
            return folder, read_spec(folder)
    return None


def _read_match(
    folder: Path, known: Container[str], clicked_on: PitchSpec | None, whose: str | None
) -> MatchFolder:
    spec = read_spec(folder)
    if not (spec.static_cameras or spec.broadcast_views):
        raise InputError(
            f"{folder / 'match.yaml'}: cameras",
            expected="a static camera, or a clip with a broadcast camera",
            found=f"{len(spec.cameras)} broadcast, which no clip names",
            todo=f"Add the static cameras, or `broadcast: {spec.cameras[0].id}` to a clip.",
        )
    units = [*(camera.id for camera in spec.static_cameras), *spec.broadcast_views]
    about = f"a static camera or {BROADCAST_FILES}"
    detections = files_by_unit(folder, "detections", (".json", ".npz"), units, about)
    videos = _videos(folder, spec, known)
    _require_one_view(folder, spec)
    _require_footage(folder, spec, detections, videos)
    pitch = read_pitch(folder, spec)
    if clicked_on is None and spec.venue is not None and pitch_file(folder, spec) is None:
        whose = None
    clicked_on = clicked_on or pitch
    calibrations = _calibrations(folder, spec)
    return MatchFolder(
        folder=folder,
        spec=spec,
        calibrations=calibrations,
        detections=detections,
        pitch=pitch,
        videos=videos,
        clicked=read_clicked(folder, spec, clicked_on, whose),
        stills=_stills(folder, spec),
        key_frames=read_key_frames(folder, spec, clicked_on, whose),
        lenses=_lenses(folder, spec, calibrations),
        estimates=_estimates(folder, spec, ".npz"),
        boxes=_boxes(folder, spec, videos, detections),
        camera_data=_estimates(folder, spec, CAMERA_DATA),
    )


def require_calibrated(match: MatchFolder) -> None:
    """Raise InputError, with missing cameras and files, if a static camera has to be clicked.

    A match without static cameras needs clicked key frames, in one clip at least.
    """
    if not match.spec.static_cameras:
        _require_key_frames(match)
    known = {**match.calibrations, **match.clicked}
    missing = match.to_click
    if missing:
        needed = f"Add the missing cameras to {match.folder / 'calibration.toml'}"
        if match.pitch is not None:
            needed = (
                f"Click {CLICKS_NEEDED} into {match.folder / clicked_file(missing[0])}, or click "
                f"on the pages: worldpose ingest {match.folder}, then worldpose review serve; or "
                "give one camera a side (near, far, left, right) in match.yaml, so that the images "
                "are calibrated without clicks; or add the camera to calibration.toml"
            )
        expected = "a given calibration or clicked markings of every static camera"
        found = f"missing camera {', '.join(missing)}; there: {_list_names(known)}"
        raise InputError(
            str(match.folder), expected, found, f"{needed}, or take it out of match.yaml."
        )


def unclicked_clips(match: MatchFolder) -> tuple[str, ...]:
    """Return the broadcast clips that need key frames; none if static cameras film the match."""
    views = match.spec.broadcast_views
    filmed = (name for name in views if name in match.videos and match.pitch is not None)
    unclicked = tuple(name for name in filmed if name not in match.calibrated_views)
    return () if match.spec.static_cameras else unclicked


def _require_key_frames(match: MatchFolder) -> None:
    """Raise InputError if no broadcast clip of a match without static cameras can be calibrated."""
    if match.pitch is not None and match.calibrated_views:
        return
    clip = next(iter(match.spec.broadcast_views))
    found, todo = "no clip with a video", f"Add broadcast/{clip}.mp4."
    if match.pitch is None:
        found, todo = "no pitch", "Take `pitch: none` out of match.yaml."
    elif match.videos:
        found = "no clicked key frame"
        todo = (
            f"Click {CLICKS_NEEDED} in a frame into {match.folder / key_frames_file(clip)}, or "
            f"click on the pages: worldpose ingest {match.folder}, then worldpose review serve; or "
            "give the broadcast camera a side (near, far, left, right) in match.yaml, so that key "
            "frames are proposed from its video."
        )
    expected = "a clip with clicked key frames and a video, as there are no static cameras"
    raise InputError(str(match.folder), expected, found, todo)


def _calibrations(folder: Path, spec: MatchSpec) -> dict[str, CameraCalibration]:
    if not (folder / "calibration.toml").exists():
        return {}
    file = existing_file(folder, "calibration.toml", str(folder))
    calibrations = read_calibration_toml(file)
    require_metres(file, calibrations)
    static = {camera.id: camera for camera in spec.static_cameras}
    extra = [name for name in calibrations if name not in static]
    if extra:
        expected = f"static cameras of match.yaml: {_list_names(static)}"
        todo = "Remove the further cameras, or correct their names."
        raise InputError(str(file), expected, f"also {', '.join(extra)}", todo)
    for name, calibration in calibrations.items():
        size = (static[name].width, static[name].height)
        if calibration.image_size != size:
            expected = f"{list(size)}, the width and height in match.yaml"
            todo = "Calibrate at the size of the video, or correct match.yaml."
            raise InputError(
                f"{file}: {name}.size", expected, str(list(calibration.image_size)), todo
            )
    return calibrations


LENS_FILE: Final = "lenses.toml"
"""File of given lenses without a pose, relative to the match folder."""


def _lenses(
    folder: Path, spec: MatchSpec, calibrations: Mapping[str, CameraCalibration]
) -> dict[str, LensCalibration]:
    if not (folder / LENS_FILE).exists():
        return {}
    file = existing_file(folder, LENS_FILE, str(folder))
    lenses = read_lens_toml(file, image_sizes(spec))
    both = [name for name in lenses if name in calibrations]
    if both:
        found = "cameras that calibration.toml gives with their pose"
        todo = "Remove them from one of the two files."
        raise InputError(
            f"{file}: {', '.join(both)}", "lenses of cameras without a given pose", found, todo
        )
    return lenses


def image_sizes(spec: MatchSpec) -> dict[str, tuple[int, int]]:
    """Return width and height [px] of each static camera's images."""
    return {camera.id: (camera.width, camera.height) for camera in spec.static_cameras}


def _stills(folder: Path, spec: MatchSpec) -> dict[str, Path]:
    stills = {}
    for index, camera in enumerate(spec.cameras):
        usual = f"stills/{camera.id}.png"
        if camera.still is not None:
            where = f"{folder / 'match.yaml'}: cameras[{index}].still"
            stills[camera.id] = existing_file(folder, camera.still, where)
        elif find_file(folder, usual).exists():
            stills[camera.id] = existing_file(folder, usual, str(folder))
    return stills


IDENTIFIED: Final = ".npy"
"""Ending of files of boxes of a broadcast view whose rows are the clip's people."""
CAMERA_DATA: Final = ".csv"
"""Ending of files of camera data in `estimates/`."""


def given_boxes_file(view: str) -> str:
    """Return the path of boxes with identities, relative to the match folder."""
    return f"boxes/{view}{IDENTIFIED}"


def camera_data_file(view: str) -> str:
    """Return the path of a broadcast view's camera data, relative to the match folder."""
    return f"estimates/{view}{CAMERA_DATA}"


def _estimates(folder: Path, spec: MatchSpec, suffix: str) -> dict[str, Path]:
    return files_by_unit(folder, "estimates", (suffix,), spec.broadcast_views, BROADCAST_FILES)


def _boxes(
    folder: Path, spec: MatchSpec, videos: Mapping[str, Path], detections: Mapping[str, Path]
) -> dict[str, Path]:
    known = [name for name in videos if name not in detections]
    units = "a camera or clip with a video and without 2D poses"
    boxes = files_by_unit(folder, "boxes", (".txt",), known, units)
    filmed = [name for name in spec.broadcast_views if name in videos]
    units = "a broadcast clip with a video"
    return boxes | files_by_unit(folder, "boxes", (IDENTIFIED,), filmed, units)


def _videos(folder: Path, spec: MatchSpec, known: Container[str]) -> dict[str, Path]:
    def is_there(usual: str) -> bool:
        return usual in known or find_file(folder, usual).exists()

    def path_of(name: str, where: str, *, folders: bool = False) -> Path:
        if name in known and not find_file(folder, name).exists():
            return folder / name
        return existing_file(folder, name, where, folders=folders)

    videos: dict[str, Path] = {}
    named: dict[str, Path] = {}
    for index, camera in enumerate(spec.cameras):
        if camera.video is not None:
            where = f"{folder / 'match.yaml'}: cameras[{index}].video"
            named[camera.id] = path_of(camera.video, where, folders=True)
    for camera in spec.static_cameras:
        usual = f"videos/{camera.id}.mp4"
        if camera.id in named:
            videos[camera.id] = named[camera.id]
        elif is_there(usual):
            videos[camera.id] = path_of(usual, str(folder))
    for name, view in spec.broadcast_views.items():
        usual = f"broadcast/{name}.mp4"
        shared = f"broadcast/{view.clip.id}.mp4"
        if name != view.clip.id and find_file(folder, shared).exists():
            expected = f"a video of each of the clip's broadcast cameras, as {usual}"
            todo = "Rename it after the camera that recorded it."
            raise InputError(f"{folder / shared}", expected, "one video of the clip", todo)
        if view.camera.id in named and not find_file(folder, usual).exists():
            videos[name] = named[view.camera.id]
        elif is_there(usual):
            videos[name] = path_of(usual, str(folder))
    return videos


def _require_one_view(folder: Path, spec: MatchSpec) -> None:
    """Raise InputError for several broadcast cameras in one clip without static cameras."""
    several = [clip for clip in spec.clips if len(clip.moving_cameras) > 1]
    if several and not spec.static_cameras:
        raise InputError(
            f"{folder / 'match.yaml'}: clip {several[0].id}: broadcast",
            expected="one broadcast camera, as there are no static cameras",
            found=", ".join(several[0].moving_cameras),
            todo="Static cameras tell who is who in several views. Without them, give each camera "
            "a clip of its own.",
        )


def _require_footage(
    folder: Path, spec: MatchSpec, detections: Mapping[str, Path], videos: Mapping[str, Path]
) -> None:
    there = {**videos, **detections}
    if absent := [each.id for each in spec.static_cameras if each.id not in there]:
        todo = f"Add videos/{absent[0]}.mp4 or detections/{absent[0]}.json (or .npz)"
        others = sorted((folder / "videos").glob(f"{absent[0]}.*"))  # of an unusual suffix
        if named := [file.name for file in others if file.stem == absent[0]]:
            todo += f", or name it in match.yaml: `video: videos/{named[0]}`"
        todo += ", and so for each camera that is missing." if len(absent) > 1 else "."
        expected = "footage of every static camera of match.yaml"
        found = f"missing camera {', '.join(absent)}; there: {_list_names(there)}"
        raise InputError(str(folder), expected, found, todo)
    views = [(name, view) for name, view in spec.broadcast_views.items() if name not in there]
    if views:
        named = [f"broadcast camera {it.camera.id} for clip {it.clip.id}" for _, it in views]
        todo = (
            f"Add broadcast/{views[0][0]}.mp4 or detections/{views[0][0]}.json (or .npz), or "
            "take the camera out of `broadcast` of the clip."
        )
        raise InputError(str(folder), f"footage of {', '.join(named)}", "none", todo)


def _list_names(names: Mapping[str, object]) -> str:
    return ", ".join(names) or "none"
