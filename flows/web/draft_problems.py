"""The folder of a match that a person is creating, and what is wrong with it or missing from it."""

from __future__ import annotations

import re
import shutil
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import suppress
from pathlib import Path, PurePosixPath
from typing import Any, Final, TypeAlias, get_args

import yaml
from pydantic import JsonValue

from data_contracts.keypoints import KeypointDetections
from data_contracts.match import MatchSpec, Side
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
from worldpose.formats.calibration_writer import write_calibration_toml
from worldpose.formats.keypoint_files import read_people
from worldpose.ingest.camera_videos import fit_to_video
from worldpose.ingest.clicks import import_clicks
from worldpose.ingest.footage import read_still, require_footage
from worldpose.ingest.importing import describe_left_out, describe_people, import_lenses
from worldpose.ingest.match_folder import MatchFolder, image_sizes, read_match, read_spec
from worldpose.ingest.registration import register_match
from worldpose.ingest.validation import list_problems
from worldpose.store.store import Store
from worldpose.video.folder import SUFFIXES as IMAGE_SUFFIXES
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


def is_footage(name: str) -> bool:
    """Return whether a file is a video or a still, which belongs to a camera."""
    return is_video(name) or PurePosixPath(name).suffix.lower() in IMAGE_SUFFIXES


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
            "broken": f"{title}: {file['problem']}",
        }.get(state)
        if said is None and is_footage(title) and file["name"] not in used:
            said = f"{title} belongs to no camera: choose it at its camera, or remove it"
        if said is not None:
            found.append({"place": f"file {file['id']}", "message": said})
    return found


def footage_problems(match: MatchFolder, indexes: Mapping[str, Index | None]) -> Iterator[Problem]:
    """Yield the problems of whole videos and stills, given their indexes by name."""
    views = match.spec.broadcast_views
    numbers = {camera.id: number for number, camera in enumerate(match.spec.cameras)}
    for unit, path in match.videos.items():
        index = indexes[path.relative_to(match.folder).as_posix()]
        assert isinstance(index, FrameIndex)  # all files are whole and read
        try:
            whole = unit in match.calibrated_views
            require_footage(match.spec, unit, path, index, whole=whole)
        except InputError as error:
            number = numbers[views[unit].camera.id if unit in views else unit]
            yield {**describe(error, match.folder), "place": f"cameras[{number}].video"}
    for camera, path in match.stills.items():
        size = (match.spec.camera(camera).width, match.spec.camera(camera).height)
        if indexes[path.relative_to(match.folder).as_posix()] == size:
            continue
        try:
            read_still(path, size)
        except InputError as error:
            place = f"cameras[{numbers[camera]}].still"
            yield {**describe(error, match.folder), "place": place}


def build(
    store: Store,
    content: Mapping[str, JsonValue],
    draft: Path,
    indexes: Mapping[str, Index | None],
) -> tuple[list[Problem], list[str]]:
    """Make the match folder again around its footage, with what all other files of a draft say.

    Args:
        store: its matches are not to be made again.
        content: match.yaml.
        draft: folder of the draft: `match` is the match folder with its footage, `own` has files
            of a match folder, and `given` those of other tools.
        indexes: frames of the videos and sizes of the stills, by path in the match folder.

    Returns:
        The errors that ingest finds, and sentences about what was taken from other tools' files.
    """
    folder, given, notes = draft / "match", draft / GIVEN, list[str]()
    for each in folder.iterdir():
        if each.is_file():
            each.unlink()
        elif each.name not in ("videos", "stills"):
            shutil.rmtree(each)
    for each in (draft / "own").glob("*"):
        shutil.copyfile(each, folder / each.name)
    text = yaml.safe_dump(dict(content), sort_keys=False, allow_unicode=True)
    (folder / "match.yaml").write_text(text, encoding="utf-8")
    try:
        taken = take_given(given, folder, indexes) if given.is_dir() else []
        # No paths of this machine, no options of commands.
        notes = [re.sub(r"; --\w+ states another", "", it.replace(f"{given}/", "")) for it in taken]
        match = read_match(folder)
    except InputError as error:
        return [describe(error, folder, given)], notes
    problems = list(footage_problems(match, indexes))
    if not problems and (same := registered_as(store, match)):
        said = (
            f"These videos are the match {same}: open it in the list of matches, and discard this."
        )
        problems.append({"place": "", "message": said})
    return problems, notes


def registered_as(store: Store, match: MatchFolder) -> str | None:
    """Return the registered match that has the content of a match folder; None if it is new."""
    files = {*match.videos.values(), *match.detections.values()}
    sizes = {str(file.relative_to(match.folder)): file.stat().st_size for file in files}
    for name in store.matches():
        if (known := store.registration(name)) is not None:
            is_like = sizes.items() <= {file.path: file.size for file in known.files}.items()
            if is_like and register_match(match, None).identity == known.identity:
                return name
    return None


def take_given(given: Path, folder: Path, indexes: Mapping[str, Index | None]) -> list[str]:
    """Write what other tools' files say into a match folder; return sentences about it.

    A calibration is told by its form. Any other file has 2D poses, clicks or a lens of the camera
    with whose id, or as the only one with whose first word, its name begins; its other words name
    no other camera. Clicks may also be in images that are named after cameras.

    Args:
        given: folder of the files.
        folder: the match folder, with match.yaml and the videos.
        indexes: frames of the videos, by path in the match folder.

    Raises:
        InputError: a file is none of these, or contradicts the match or another file.
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
                found = import_clicks(file, folder, owner)
            except InputError as error:
                if "--camera" not in error.todo:  # the images are named after no cameras
                    raise
                todo = (
                    "Rename the file, so that it begins with its camera's name, and add it again."
                )
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
            read = read_people(file)
            people[owner] = read.people
            (folder / "detections").mkdir(exist_ok=True)
            shutil.copyfile(file, folder / "detections" / f"{owner}{file.suffix.lower()}")
            notes += [f"{file.name}: 2D poses of {owner}", *describe_people({owner: read})]
    for owner, files in lenses.items():
        import_lenses(files, folder, owner)
        notes.append(f"{', '.join(file.name for file in files)}: lens of {owner}")
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
