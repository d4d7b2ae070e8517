"""The `worldpose` command.

Exit codes: 0 done, 1 failed, 2 usage, 3 waits for review, 4 partial.
"""

from __future__ import annotations

import gc
import json
import logging
import os
import sys
import tempfile
import traceback


def main() -> None:
    """Run the command line; a user error becomes one message and an exit code."""
    # Importing creates objects that stay: by the default of 700, searching them for garbage takes a
    # tenth of the time of a short command.
    gc.set_threshold(50_000)
    # Pydantic would search all installed packages for plugins, in each process of a run.
    os.environ.setdefault("PYDANTIC_DISABLE_PLUGINS", "__all__")
    # Imported here: every process of a run imports this module again, but needs no command.
    from flows.cli.app import app
    from flows.cli.console import errors, line
    from worldpose.errors import InternalError, UsageError, WorldposeError, require_memory

    # A log line that Prefect's server rejects (a full disk) is not output of the command.
    logging.raiseExceptions = False
    try:
        try:
            app()
        except (MemoryError, RuntimeError, OSError) as failure:
            require_memory(failure)
            raise
    except Exception as error:
        kind, message = type(error).__name__, str(error)
        if isinstance(error, OSError):
            message = f"{error.filename or 'a file'}: {error.strerror or error}"
        elif not isinstance(error, WorldposeError):
            kind = "InternalError"
            message = f"{InternalError.wrap('worldpose', error)} All of it: {_kept_trace()}"
        if "--json" in sys.argv:
            print(json.dumps({"error": kind, "message": message}))  # noqa: T201
        line(f"error: {message}", to=errors)
        sys.exit(2 if isinstance(error, UsageError) else 1)
    finally:
        gc.freeze()  # the process ends: freeing all its modules one by one takes half a second


def _kept_trace() -> str:
    """Write the traceback of the current exception to a file; return its path."""
    with tempfile.NamedTemporaryFile(
        "w", prefix="worldpose-error-", suffix=".txt", delete=False, encoding="utf-8"
    ) as file:
        traceback.print_exc(file=file)
    return file.name
