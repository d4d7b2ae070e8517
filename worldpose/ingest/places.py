"""Checks that files named in a match folder exist inside it."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path, PurePosixPath, PureWindowsPath

from worldpose.errors import InputError


def require_local(name: str, where: str) -> None:
    """Raise InputError for a name that is no path inside the match folder.

    Raises:
        InputError: an absolute path, one with `..`, or an empty one.
    """
    posix, windows = PurePosixPath(name), PureWindowsPath(name)
    if not posix.parts or posix.is_absolute() or windows.anchor or ".." in posix.parts:
        raise InputError(
            where,
            expected="a path inside the match folder, without ..",
            found=repr(name),
            todo="Move or copy the file into the match folder and name it from there.",
        )


@contextmanager
def reachable(folder: Path) -> Iterator[None]:
    """Convert OSError in a block that reads a match folder to InputError.

    Raises:
        InputError: the folder, or a file in it, is unreachable or unreadable.
    """
    try:
        yield
    except OSError as error:
        raise InputError(
            str(error.filename or folder),
            expected="a match folder that this user can read",
            found=error.strerror or str(error),
            todo="Mount its disk, or give this user permission to read it.",
        ) from error


def existing_file(folder: Path, name: str, where: str, *, folders: bool = False) -> Path:
    """Return the path of an existing file in the folder.

    Args:
        folder: the match folder.
        name: relative to the folder.
        where: source of the name, for messages.
        folders: also accept a folder that is not empty.

    Raises:
        InputError: there is no such file, or it is outside.
    """
    require_local(name, where)
    path = folder / name
    try:
        there = path.is_file() or (folders and path.is_dir() and any(path.iterdir()))
        inside = path.resolve().is_relative_to(folder.resolve())
    except PermissionError as error:
        raise InputError(
            where,
            expected="a file that this user can read",
            found=f"{name!r}: {error.strerror}",
            todo="Give this user permission to read it.",
        ) from error
    except (OSError, RuntimeError, ValueError):  # a loop of links, a NUL in the name
        there = False
    if not there:
        raise InputError(
            where,
            expected="a file, or a folder of images" if folders else "a file",
            found=f"no {name!r}",
            todo="Put it there, or correct the name.",
        )
    if not inside:
        raise InputError(
            where,
            expected="a file inside the match folder",
            found=f"{name!r}, a link that leads out of it",
            todo="Copy the file into the match folder.",
        )
    return path
