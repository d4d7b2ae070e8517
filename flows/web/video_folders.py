"""Videos in folders that the operator named: listed and opened read-only, never through links.

Names from a browser are opened one by one below the folder's descriptor, so none of them leads out.
"""

from __future__ import annotations

import os
import stat
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import Any, Final

from worldpose.errors import InputError
from worldpose.video.names import is_video

MAX_ENTRIES: Final = 2000
"""Folders and videos of one folder that a page lists."""


def list_videos(folders: Sequence[Path], number: int, path: str) -> dict[str, Any]:
    """Return the folders and videos inside a folder: names, and sizes of videos [byte].

    The path, with forward slashes, leads on from one of the folders that the operator named.
    InputError if there is no such folder, or the path is unsafe.
    """
    inside, videos = [], []
    with _open_below(folders, number, path, is_folder=True) as folder, os.scandir(folder) as found:
        for each in found:
            if each.name.startswith(".") or not each.name.isprintable():
                continue
            if each.is_dir(follow_symlinks=False):
                inside.append(each.name)
            elif each.is_file(follow_symlinks=False) and is_video(each.name):
                videos.append({"name": each.name, "size": each.stat().st_size})
            if len(inside) + len(videos) >= MAX_ENTRIES:
                break
    return {
        "folders": sorted(inside),
        "videos": sorted(videos, key=lambda video: str(video["name"])),
        "is_cut": len(inside) + len(videos) >= MAX_ENTRIES,
    }


@contextmanager
def open_video(folders: Sequence[Path], number: int, path: str) -> Iterator[int]:
    """Yield the descriptor of a video, open for reading.

    Raises:
        InputError: there is no such regular file, it has no suffix of a video, or its path is
            unsafe.
    """
    if not is_video(path):
        raise _refusal(path, "a video file", "another suffix")
    with _open_below(folders, number, path, is_folder=False) as descriptor:
        yield descriptor


@contextmanager
def _open_below(
    folders: Sequence[Path], number: int, path: str, *, is_folder: bool
) -> Iterator[int]:
    """Yield the descriptor of a file or folder below a named folder."""
    if not 0 <= number < len(folders):
        raise _refusal(f"folder {number}", "a folder that the operator named", "no such folder")
    parts = path.split("/") if path else []
    if any(part in ("", ".", "..") or "\0" in part for part in parts):
        raise _refusal(path, "a path inside the folder", "another one")
    descriptor = os.open(folders[number], os.O_RDONLY | os.O_DIRECTORY)
    try:
        for depth, part in enumerate(parts):
            is_inner = is_folder or depth < len(parts) - 1
            # A pipe would block; a link is not followed, wherever it leads.
            flags = os.O_RDONLY | os.O_NOFOLLOW | os.O_NONBLOCK
            flags |= os.O_DIRECTORY if is_inner else 0
            try:
                inner = os.open(part, flags, dir_fd=descriptor)
            except OSError as error:
                found = "a link, or no such folder or file"
                if isinstance(error, PermissionError):
                    found = error.strerror or "no permission"
                raise _refusal(path, "a file or folder that is no link", found) from error
            os.close(descriptor)
            descriptor = inner
        if not is_folder and not stat.S_ISREG(os.fstat(descriptor).st_mode):
            raise _refusal(path, "a video file", "something else")
        yield descriptor
    finally:
        os.close(descriptor)


def _refusal(where: str, expected: str, found: str) -> InputError:
    return InputError(where, expected=expected, found=found, todo="Choose from the list.")
