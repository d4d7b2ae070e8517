"""Folder of what one process computes and later ones read: machine code and parsed sources."""

from __future__ import annotations

import functools
import os
import stat
import tempfile
from contextlib import suppress
from pathlib import Path
from typing import NamedTuple

_PACKAGE = Path(__file__).resolve().parent


class CacheFolder(NamedTuple):
    """A folder that this process can write to; `path` is None if none is this user's alone.

    `is_lasting` is whether it stays when the machine or container ends.
    """

    path: Path | None
    is_lasting: bool


@functools.cache
def find_cache_folder() -> CacheFolder:
    """Return the first that can be written to of the package, the user's cache and /tmp."""
    home = user_cache()
    for root in (_PACKAGE, *([] if home is None else [home / "worldpose"])):
        folder = root / "__pycache__"
        with suppress(OSError):
            folder.mkdir(parents=True, exist_ok=True)
            if os.access(folder, os.W_OK | os.X_OK):
                return CacheFolder(folder, is_lasting=True)
    return CacheFolder(own_temporary_folder(), is_lasting=False)


def user_cache() -> Path | None:
    """Return the user's cache folder, which need not exist; None for a user without a home."""
    given = os.environ.get("XDG_CACHE_HOME", "")
    if Path(given).is_absolute():
        return Path(given)
    try:
        return Path.home() / ".cache"
    except RuntimeError:
        return None


def own_temporary_folder() -> Path | None:
    """Return the folder of this user among the temporary files; None if it is not the user's alone.

    Its name is known, so that all processes find it. Another user could have created it, to let
    this user run machine code from it.
    """
    folder = Path(tempfile.gettempdir()) / f"worldpose-{os.getuid()}"
    try:
        folder.mkdir(mode=0o700, exist_ok=True)
        found = folder.lstat()
    except OSError:
        return None
    is_own = stat.S_ISDIR(found.st_mode) and found.st_uid == os.getuid()
    return folder if is_own and stat.S_IMODE(found.st_mode) & 0o077 == 0 else None
