"""Prefect as this project wants it: silent towards the network, its database with the project.

With PREFECT_API_URL set, runs go to that server and appear in its dashboard. Otherwise a run brings
a server of its own on loopback, for as long as the run lasts. This is the one module that reads and
sets the environment; it must be called before Prefect is imported.
"""

from __future__ import annotations

import os
import socket
import subprocess
import sys
import tempfile
import time
import urllib.request
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from functools import partial
from pathlib import Path

from worldpose.errors import WorldposeError

START_SECONDS = 120.0
"""A first start creates Prefect's database, which took 15 s on two busy cores."""


@contextmanager
def prefect_server(project: str) -> Iterator[Callable[[], None]]:
    """Environment and server for Prefect; gives a function that returns when its API answers.

    So Prefect can be imported, which takes seconds, while its server starts.

    Args:
        project: folder or URL of the store; a local one also keeps Prefect's database.
    """
    os.environ["DO_NOT_TRACK"] = "1"
    os.environ["PREFECT_SERVER_ANALYTICS_ENABLED"] = "false"
    # The server gets every line; the terminal has progress and failures of our own.
    os.environ.setdefault("PREFECT_LOGGING_EXTRA_LOGGERS", "worldpose")
    os.environ.setdefault("PREFECT_LOGGING_HANDLERS_CONSOLE_LEVEL", "CRITICAL")
    if os.environ.get("PREFECT_API_URL"):
        yield lambda: None
        return
    local = "://" not in project
    with tempfile.TemporaryDirectory(prefix="worldpose-prefect-") as scratch:
        home = Path(project).resolve() / "prefect" if local else Path(scratch)
        home.mkdir(parents=True, exist_ok=True)
        os.environ["PREFECT_HOME"] = str(home)
        with _embedded_server(home / "server.log") as (address, wait_until_ready):
            os.environ["PREFECT_API_URL"] = address
            try:
                yield wait_until_ready
            finally:
                del os.environ["PREFECT_API_URL"]


@contextmanager
def _embedded_server(log: Path) -> Iterator[tuple[str, Callable[[], None]]]:
    with socket.socket() as probe:
        probe.bind(("127.0.0.1", 0))
        port = probe.getsockname()[1]
    # The server ends when its standard input does, so a killed run leaves none behind.
    with log.open("wb") as output:
        server = subprocess.Popen(
            [sys.executable, "-m", "flows.embedded_server", str(port)],
            stdin=subprocess.PIPE,
            stdout=output,
            stderr=subprocess.STDOUT,
        )
    address = f"http://127.0.0.1:{port}/api"
    try:
        yield address, partial(_wait_until_healthy, server, address, log)
    finally:
        server.kill()
        server.wait()


def _wait_until_healthy(server: subprocess.Popen[bytes], address: str, log: Path) -> None:
    """Returns when the server answers.

    Raises:
        WorldposeError: it ended, or does not answer in time.
    """
    opener = urllib.request.build_opener(urllib.request.ProxyHandler({}))
    deadline = time.monotonic() + START_SECONDS
    while time.monotonic() < deadline:
        if server.poll() is not None:
            output = log.read_text(errors="replace")
            raise WorldposeError(f"Prefect's embedded server did not start:\n{output[-2000:]}")
        try:
            with opener.open(f"{address}/health", timeout=2) as answer:
                if answer.status == 200:
                    return
        except OSError:
            time.sleep(0.1)
    raise WorldposeError(
        f"Prefect's embedded server was not ready after {START_SECONDS:.0f} s: {log}"
    )
