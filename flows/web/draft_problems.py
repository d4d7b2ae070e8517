"""What is wrong with or missing from a match that a person is creating."""

from __future__ import annotations

import re
from collections.abc import Iterator, Mapping, Sequence
from pathlib import Path, PurePosixPath
from typing import Any, TypeAlias

from pydantic import JsonValue

from data_contracts.match import MatchSpec
from flows.web.browser_words import in_browser
from worldpose.errors import InputError
from worldpose.ingest.footage import read_still, require_footage
from worldpose.ingest.match_folder import MatchFolder
from worldpose.ingest.validation import list_problems
from worldpose.video.folder import SUFFIXES as IMAGE_SUFFIXES
from worldpose.video.names import is_video
from worldpose.video.pictures import FrameIndex

Problem: TypeAlias = dict[str, str]
"""Its `message`, and its `place` in match.yaml or a file's name."""
Index: TypeAlias = FrameIndex | tuple[int, int] | InputError
"""Frames of a video, size of a still, or why the file is neither."""


def is_footage(name: str) -> bool:
    """Return whether a file is a video or a still, which belongs to a camera."""
    return is_video(name) or PurePosixPath(name).suffix.lower() in IMAGE_SUFFIXES


def form_problems(
    content: Mapping[str, JsonValue], files: Sequence[Mapping[str, Any]]
) -> list[Problem]:
    """Return the problems of a form, and of files as the pages show them."""
    found = [describe(error) for error in list_problems(MatchSpec, dict(content), "match.yaml")]
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
            require_footage(match.spec, unit, path, index)
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


def describe(error: InputError, folder: Path | None = None) -> Problem:
    """Return an error's place in match.yaml, and its message without paths of this machine."""
    where = error.where
    message = f"expected {error.expected}, found {error.found}. {in_browser(error.todo)}"
    if folder is not None:
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
