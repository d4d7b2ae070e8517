"""Empty Prefect database, created once per Prefect version.

Prefect creates it with a hundred migrations, which takes as long as the rest of its start. All
empty databases are equal: the first is kept in the user's cache folder (XDG_CACHE_HOME, or
~/.cache), and new projects start with a copy.
"""

from __future__ import annotations

import os
import shutil
import sqlite3
from contextlib import closing, suppress
from importlib.metadata import version
from pathlib import Path

from worldpose.cache_folder import user_cache

DATABASE = "prefect.db"
"""Name of the database file in PREFECT_HOME."""


def begin_database(home: Path) -> bool:
    """Copy an empty database to `home`, PREFECT_HOME of a server that will be started.

    Its files are for this account alone: SQLite gives the rights of the database to its log.

    Returns:
        Whether the server must create the first one of its version there, to be kept then.

    Raises:
        StoreError: `home` is not writable.
    """
    # Imported here and below: with them, the server's process would import numba and scipy.
    from worldpose.formats.files import whole_file
    from worldpose.store.blobs import storage_errors

    kept, database = kept_database(), home / DATABASE
    if database.exists() and database.stat().st_size:
        for file in home.glob(f"{DATABASE}*"):
            file.chmod(0o600)
        return False
    with storage_errors(str(database)):
        home.mkdir(parents=True, exist_ok=True)
        if kept is None or not os.access(kept, os.R_OK):
            database.touch(0o600)
            return True
        with whole_file(database) as draft:
            draft.touch(0o600)
            try:
                shutil.copyfile(kept, draft)
            except OSError as error:  # a copy error names the source file first, whichever failed
                raise OSError(error.errno, error.strerror) from error
    return False


def keep_database(home: Path) -> None:
    """Keep a copy of the unused database that a server has created in `home`."""
    from worldpose.formats.files import whole_file

    kept, database = kept_database(), home / DATABASE
    if kept is None or not database.exists() or not database.stat().st_size:
        return  # no home, or the environment names another database
    # If the cache is not writable, every project creates its own.
    with (
        suppress(OSError, sqlite3.Error),
        whole_file(kept) as draft,
        closing(sqlite3.connect(database)) as made,
        closing(sqlite3.connect(draft)) as copy,
    ):
        made.backup(copy)


def kept_database() -> Path | None:
    """Return the path of the kept empty database of this Prefect version; None without a home."""
    cache = user_cache()
    return None if cache is None else cache / "worldpose" / f"prefect-{version('prefect')}.db"
