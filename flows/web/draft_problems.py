"""The folder of a match that a person is creating, and what is wrong with it or missing from it."""

from __future__ import annotations

import re
import shutil
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import suppress
from datetime import datetime
from functools import lru_cache
from pathlib import Path, PurePosixPath
from typing import Any, Final, Literal, TypeAlias, get_args

import numpy as np
from pydantic import Field, JsonValue

from data_contracts.keypoints import KeypointDetections
from data_contracts.match import MatchSpec, Side
from data_contracts.records import CONTRACT_VERSION, Count, Name, Record
from flows.layers import known_pitch
from flows.web.browser_words import in_browser
from worldpose.errors import InputError
from worldpose.formats.annotations.marked_images import read_marked_images
from worldpose.formats.calibration_files import LeftOut
from worldpose.formats.calibration_forms import (
    FORMS,
    calibrations_in,
    is_of_sensor,
    read_calibration,
)
from worldpose.formats.calibration_unit import doubt_middle
from worldpose.formats.calibration_writer import write_calibration_toml
from worldpose.formats.keypoint_files import read_people
from worldpose.ingest.camera_videos import fit_to_video
from worldpose.ingest.clicks import import_clicks
from worldpose.ingest.footage import read_still, require_footage
from worldpose.ingest.importing import describe_left_out, describe_people, import_lenses
from worldpose.ingest.match_folder import MatchFolder, image_sizes, read_spec
from worldpose.ingest.validation import list_problems
from worldpose.store.store import Store
from worldpose.video.folder import SUFFIXES as IMAGE_SUFFIXES
from worldpose.video.folder import declared_size
from worldpose.video.names import is_video
from worldpose.video.pictures import FrameIndex

Problem: TypeAlias = dict[str, str]
"""Its `message`, and its `place` in match.yaml or a file's name."""
Index: TypeAlias = FrameIndex | tuple[int, int] | InputError
"""Frames of a video, size of a still, or why the file is neither."""
GIVEN: Final = "given/"
"""Folder of other tools' files in a draft, in front of their names."""
GIVEN_ENDINGS: Final = tuple(
    sorted({".npz", ".npy", *(end for form in FORMS for end in form.endings if end[0] == ".")})
)
"""Endings of calibrations, clicks, 2D poses and lenses of other tools."""

MATCH_FILES: Final = frozenset({"calibration.toml", "lenses.toml", "pitch.json"})
"""Files that a person can add to videos and stills."""
_ON_PAGES: Final = {
    "--camera": "Rename the file, so that it begins with its camera's name, and add it again.",
    "--project": "Add the venue and its pitch to the settings, or add pitch.json.",
}
"""What to do on the pages, by the option that a command asks for."""


class DraftFile(Record):
    """A file of a draft: on its way, or whole."""

    id: Name = "new"
    name: str = ""
    """Path in the match folder, or in the draft for a file of another tool."""
    title: str
    """Its name where it comes from."""
    size: Count
    """[byte]"""
    modified_ms: int = Field(default=0, ge=0, le=1 << 53)
    """Time of its last change at its origin [ms]: tells whether a chosen file is the same."""
    folder: int | None = None
    """Index of the named folder that it is copied from; None if a browser sends it."""
    source: str = ""
    """Its path in that folder."""
    is_kept: bool = False
    """Whether it is of the match folder that the draft began with."""


class Draft(Record):
    """draft.json: a match that a person is creating."""

    contract: Literal[1] = CONTRACT_VERSION
    id: Name
    who: str
    created_at: datetime
    revision: Count = 0
    """Number of saved forms: tells whether another person saved in between."""
    content: dict[str, JsonValue]
    """match.yaml as filled in so far, valid or not."""
    files: tuple[DraftFile, ...] = ()
    match_id: Name | None = None
    """The registered match of which this is the next version."""
    replaces: str | None = None
    """Folder of the version before."""
    corrects: str | None = None
    """Folder of the refused arrival that it began with."""
    finished_as: str | None = None
    """Path in the inbox, written before the match folder moves there."""


def is_footage(name: str) -> bool:
    """Return whether a file is a video or a still, which belongs to a camera."""
    return is_video(name) or PurePosixPath(name).suffix.lower() in IMAGE_SUFFIXES


def choose_name(title: str, taken: set[str]) -> str:
    """Return a path in the match folder that is not taken, with safe characters only."""
    if title in MATCH_FILES:
        if title in taken:
            raise InputError(title, "one such file", "a second one", "Remove the first one.")
        return title
    stem, suffix = PurePosixPath(title).stem, PurePosixPath(title).suffix.lower()
    usual = "video" if is_video(title) else "still" if is_footage(title) else "file"
    folder = f"{usual}s" if is_footage(title) else GIVEN.strip("/")
    stem = re.sub(r"[^A-Za-z0-9._-]+", "_", stem).strip("._-")[:80] or usual
    names = (f"{folder}/{stem}{end}{suffix}" for end in ("", *(f"-{n}" for n in range(2, 999))))
    return next(name for name in names if name not in taken)


def still_size(path: Path) -> tuple[int, int]:
    """Return width and height [px] of a still."""
    size = declared_size(np.fromfile(path, dtype=np.uint8)) or (0, 0)
    read_still(path, size)
    return size


def camera_sizes(file: Path) -> dict[str, tuple[int, int]]:
    """Return width and height [px] of each camera of a calibration.toml; of none in other files."""
    with suppress(InputError):  # the check of the match folder says what is wrong with it
        if file.name == "calibration.toml":
            cameras = read_calibration(file, {}, LeftOut(), any_unit=True)
            return {name: camera.image_size for name, camera in cameras.items()}
    return {}


@lru_cache(maxsize=1000)
def calibrated_cameras(file: Path, changed_ns: int) -> list[str]:
    """Return the cameras of any tool's calibration; none of other files, or of unreadable ones."""
    with suppress(InputError):
        if file.stat().st_size < 1 << 20 and _kind_of(file) == "calibration":  # not hours of poses
            return list(read_calibration(file, {}, LeftOut(), any_unit=True))
    return []


def form_problems(
    content: Mapping[str, JsonValue], files: Sequence[Mapping[str, Any]]
) -> list[Problem]:
    """Return the problems of a form, and of files as the pages show them."""
    found = [describe(error) for error in list_problems(MatchSpec, dict(content), "match.yaml")]
    for problem in found:
        if problem["place"] in ("cameras", "clips") and not content.get(problem["place"]):
            problem["message"] = "none yet: add at least one"
    cameras = content.get("cameras")
    used = {
        str(camera.get(key))
        for camera in (cameras if isinstance(cameras, list) else [])
        if isinstance(camera, dict)
        for key in ("video", "still")
    }
    for file in files:
        title, state = str(file["title"]), file["state"]
        share = f"{100 * file['received'] // file['size']} % of it are there"
        said = {
            "uploading": f"{title}: {share}",
            "copying": f"{title}: {share}",
            "reading": f"{title} is being read",
            "broken": None if file["is_kept"] else f"{title}: {file['problem']}",
        }.get(state)
        is_spare = is_footage(title) and not file["is_kept"] and file["name"] not in used
        if said is None and is_spare:
            said = f"{title} belongs to no camera: choose it at its camera, or remove it"
        if said is not None:
            found.append({"place": f"file {file['id']}", "message": said})
    return found


def footage_problems(
    match: MatchFolder, indexes: Mapping[str, Index | None], *, is_next: bool
) -> Iterator[Problem]:
    """Yield the problems of whole videos and stills, given their indexes by name.

    Intake leaves out broken videos of static cameras if two cameras remain, and does not read
    those of a version before.
    """
    static, broken = {each.id for each in match.spec.static_cameras}, dict[str, InputError]()
    views = match.spec.broadcast_views
    numbers = {camera.id: number for number, camera in enumerate(match.spec.cameras)}
    for unit, path in match.videos.items():
        index = indexes.get(path.relative_to(match.folder).as_posix())
        whole = unit in match.calibrated_views
        if isinstance(index, InputError) and (whole or unit not in match.detections):
            broken[unit] = index
        if not isinstance(index, FrameIndex):
            continue
        try:
            require_footage(match.spec, unit, path, index, whole=whole)
        except InputError as error:
            number = numbers[views[unit].camera.id if unit in views else unit]
            yield {**describe(error, match.folder), "place": f"cameras[{number}].video"}
    for unit, refusal in () if is_next else broken.items():
        if unit not in static or len(static - broken.keys()) < 2:
            number = numbers[views[unit].camera.id if unit in views else unit]
            message = f"{match.videos[unit].name}: {describe_broken(refusal)}"
            yield {"place": f"cameras[{number}].video", "message": message}
    for camera, path in match.stills.items():
        size = (match.spec.camera(camera).width, match.spec.camera(camera).height)
        if indexes.get(path.relative_to(match.folder).as_posix()) == size:
            continue
        try:
            read_still(path, size)
        except InputError as error:
            place = f"cameras[{numbers[camera]}].still"
            yield {**describe(error, match.folder), "place": place}


def take_given(
    store: Store, given: Path, folder: Path, indexes: Mapping[str, Index | None]
) -> list[str]:
    """Write what other tools' files say into a match folder; return sentences about it.

    A calibration is told by its form. Any other file has 2D poses, clicks or a lens of the camera
    with whose id, or as the only one with whose first word, its name begins; its other words name
    no other camera. Clicks may also be in images that are named after cameras.

    Settings of the store can state the pitch. The match folder has match.yaml and videos, with
    frames `indexes` by path in it. InputError if a file is none of these, or contradicts the match
    or another file.
    """
    spec = read_spec(folder)
    owners = [*(camera.id for camera in spec.static_cameras), *spec.broadcast_views]
    posed = {file for _, files in calibrations_in(given) for file in files}
    people: dict[str, KeypointDetections] = {}
    lenses: dict[str, list[Path]] = {}
    notes: list[str] = []
    for file in sorted({*given.iterdir()} - posed):
        owner, kind = _owner_of(file.stem.lower(), owners), _kind_of(file)
        if kind == "calibration":
            posed.add(file)
        elif kind == "clicks":
            try:
                found = import_clicks(file, folder, owner, known_pitch(store, folder, spec))
            except InputError as error:
                todo = next((it for asks, it in _ON_PAGES.items() if asks in error.todo), None)
                if todo is None:
                    raise
                raise InputError(error.where, error.expected, error.found, todo) from error
            notes += [f"{file.name}: {n} clicks in {name}" for name, n in found.clicks.items()]
            notes += found.notes
        elif owner is None:
            raise InputError(
                str(file),
                expected="a calibration or clicks; or 2D poses or a lens, with a name that begins "
                f"with that of a camera: {', '.join(owners)}",
                found="none of them" if kind == "lens" else f"{kind} of an unknown camera",
                todo="Remove the file, or rename it and add it again.",
            )
        elif kind == "lens":
            lenses.setdefault(owner, []).append(file)
        else:
            if owner in people:
                raise InputError(
                    str(file),
                    expected=f"one file with 2D poses of {owner}",
                    found="a second one",
                    todo="Remove one of the two, or rename it after its own camera.",
                )
            (folder / "detections").mkdir(exist_ok=True)
            if there := [*(folder / "detections").glob(f"{owner}.*")]:
                raise InputError(
                    str(file),
                    expected=f"no 2D poses of {owner} yet",
                    found=f"detections/{there[0].name}",
                    todo="Remove one of the two.",
                )
            read = read_people(file)
            people[owner] = read.people
            shutil.copyfile(file, folder / "detections" / f"{owner}{file.suffix.lower()}")
            notes += [f"{file.name}: 2D poses of {owner}", *describe_people({owner: read})]
    for owner, files in lenses.items():
        lens = import_lenses(files, folder, owner)[owner]
        notes.append(f"{', '.join(file.name for file in files)}: lens of {owner}")
        notes += doubt_middle(owner, lens.principal_point_px, lens.image_size)
    if posed:
        where = posed.pop() if len(posed) == 1 else given
        notes += _take_calibration(where, folder, indexes, people)
    return notes


def _owner_of(stem: str, owners: Sequence[str]) -> str | None:
    """Return the camera that a file's name names; None if none or several can be meant."""
    # The name of another camera can begin in the same way: `cam10` and `cam1`.
    begun = [each for each in owners if stem.startswith(each.lower())]
    named = [each for each in begun if not stem[len(each) : len(each) + 1].isalnum()]
    if named:
        return max(named, key=len)
    words = re.split(r"[\W_]+", stem)
    alike = [each for each in owners if re.split(r"[\W_]+", each.lower())[0] == words[0]]
    if len(alike) != 1:
        return None
    own = re.split(r"[\W_]+", alike[0].lower())
    return None if any(map(_is_other, words, own)) else alike[0]


def _is_other(word: str, own: str) -> bool:
    """Return whether a word of a file's name stands for another camera than `own` at its place."""
    is_alike = re.sub(r"\d+", "", word) == re.sub(r"\d+", "", own)  # `cam2` and `cam1`
    return word != own and (is_alike or word.isdigit() or word in get_args(Side))


def _kind_of(file: Path) -> str:
    """Return what a file has: the first kind whose reader takes it, or else a lens."""
    readers: dict[str, Callable[[], object]] = {
        "clicks": lambda: read_marked_images(file),
        "calibration": lambda: read_calibration(file, {}, LeftOut(), any_unit=True),
    }
    if file.suffix.lower() in (".json", ".npz"):
        readers = {"2D poses": lambda: read_people(file), **readers}
    for kind, read in readers.items():
        with suppress(InputError):
            read()
            return kind
    return "lens"


def _take_calibration(
    source: Path,
    folder: Path,
    indexes: Mapping[str, Index | None],
    people: Mapping[str, KeypointDetections],
) -> list[str]:
    """Write the cameras of a calibration to calibration.toml, in the pixels of their videos."""
    from worldpose.triangulation.world import place_as_stated  # late: it loads the tracker

    spec, left_out = read_spec(folder), LeftOut()
    cameras = read_calibration(source, image_sizes(spec), left_out, any_unit=True)
    known = {camera.id: camera for camera in spec.static_cameras if camera.id in cameras}
    if not known:
        raise InputError(
            str(source),
            expected=f"cameras of the match: {', '.join(each.id for each in spec.static_cameras)}",
            found=", ".join(cameras) or "none",
            todo="Call the cameras of the form as the calibration does.",
        )
    left_out.update({name: "the match has no such camera" for name in cameras if name not in known})
    notes = [f"calibration of {', '.join(known)}", *describe_left_out(left_out)]
    for name, camera in known.items():
        index = indexes.get(camera.video or "")
        if isinstance(index, FrameIndex) and camera.video is not None:
            file, poses = folder / camera.video, bool(people)
            cameras[name] = fit_to_video(
                file, cameras[name], index, notes, of_sensor=is_of_sensor(source), has_poses=poses
            )
    placed, changes = place_as_stated(None, None)(
        source, {name: cameras[name] for name in known}, people, spec.fps
    )
    own = folder / "calibration.toml"
    if own.exists():
        raise InputError(
            str(source),
            expected="one calibration",
            found=f"this one besides {own.name}",
            todo="Remove one of the two.",
        )
    write_calibration_toml(own, placed)
    return notes + changes


def describe(error: InputError, *folders: Path) -> Problem:
    """Return an error's place in match.yaml, and its message without paths of this machine."""
    where = error.where
    message = f"expected {error.expected}, found {error.found}. {in_browser(error.todo)}"
    for folder in folders:
        where = where.replace(f"{folder}/", "").replace(str(folder), "the match")
        message = message.replace(f"{folder}/", "")
    file, _, place = where.partition(": ")
    if file != "match.yaml":
        return {"place": "", "message": f"{where}: {message}"}
    return {"place": place, "message": message}


def describe_broken(error: InputError) -> str:
    """Return why a file is broken, without its path."""
    found = re.sub(r"'?/[^ ']*/", "", error.found)
    return f"expected {error.expected}, found {found}. {error.todo}"
