"""Prefect's empty database, made once for each of its versions.

Prefect makes one by a hundred migrations, which takes as long as starting does. All are the same
while they are empty: the first is kept beside the code, or in the home folder where that is
read-only, and new projects begin with a copy.
"""

from __future__ import annotations

import os
import shutil
import sqlite3
from contextlib import closing, suppress
from importlib.metadata import version
from pathlib import Path

from worldpose.release import whole_file

DATABASE = "prefect.db"
"""In PREFECT_HOME."""


def begin_database(home: Path) -> bool:
    """Put an empty database into `home`, PREFECT_HOME of a server that is about to start.

    Returns:
        Whether the server is to make the first of its version there, which is then to be kept.
    """
    kept = kept_database()
    if (home / DATABASE).exists():
        return False
    if not kept.exists():
        return True
    with whole_file(home / DATABASE) as draft:
        shutil.copyfile(kept, draft)
    return False


def keep_database(home: Path) -> None:
    """Keep a copy of what a server has made in `home`, and nobody has used yet."""
    if not (home / DATABASE).exists():
        return  # the environment names another database
    # Where there is no place for it, every project waits for its own.
    with (
        suppress(OSError, sqlite3.Error),
        whole_file(kept_database()) as draft,
        closing(sqlite3.connect(home / DATABASE)) as made,
        closing(sqlite3.connect(draft)) as copy,
    ):
        made.backup(copy)


def kept_database() -> Path:
    """Where the empty database of this Prefect is kept."""
    code = Path(__file__).parent
    root = code if os.access(code, os.W_OK) else Path.home() / ".cache" / "worldpose"
    return root / "__pycache__" / f"prefect-{version('prefect')}.db"
