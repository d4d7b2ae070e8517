"""Prefect's server behind a guard.

    python -m flows.orchestration.prefect_server --host HOST --port PORT

Prefect's own program checks neither Host nor Origin, and requires a login only if
PREFECT_SERVER_API_AUTH_STRING is set. This one does not start without it.
"""

from __future__ import annotations

import argparse
import asyncio
import gc
import os
import resource
import socket
import sys
import threading
from collections.abc import Iterable
from contextlib import suppress
from importlib.util import find_spec
from pathlib import Path
from typing import TYPE_CHECKING, Final

from flows.orchestration.prefect_environment import RUN_HOME, SERVER_LOGIN
from flows.web.host_guard import SAFE_METHODS, HostGuard
from flows.web.http_server import serve_http
from worldpose.errors import UsageError

if TYPE_CHECKING:
    from starlette.types import ASGIApp, Message, Receive, Scope, Send

    from flows.web.access import Access

MAX_CONNECTIONS: Final = 1000
"""Maximum open connections: every run and every one of its workers has several."""
BUSY: Final = 503
REPETITIONS: Final = 8
"""Repetitions of a request that the busy database refused; with the pauses below they last 4 s
without their own time."""
PAUSE_SECONDS: Final = 0.5
"""Pause before each repetition [s]."""


def guarded_app(
    names: Iterable[str], access: Access | None = None, *, is_embedded: bool = False
) -> ASGIApp:
    """Create Prefect's API, and its dashboard unless embedded, for requests that name this server.

    An embedded one lasts as long as one run. Loopback's names need not be given. With `access`, a
    session of the pages opens it, too; UsageError if the environment has no login for it.
    """
    if not os.environ.get(SERVER_LOGIN):
        raise UsageError(
            SERVER_LOGIN,
            expected="the login of Prefect's API, as USER:PASSWORD",
            found="none: every user who reaches it could start runs",
            todo=f"Set the variable: export {SERVER_LOGIN}=worldpose:$(openssl rand -hex 16).",
        )
    if not is_embedded:
        _let_dashboard_be_written()
    # Garbage collection takes a fifth of the import time, although all modules stay.
    gc.disable()
    from prefect.server.api.server import create_app

    gc.freeze()  # Prefect collects while it creates the app
    app = create_app(ephemeral=is_embedded, final=True)
    gc.freeze()
    gc.enable()
    inner: ASGIApp = RepeatBusy(app)
    if access is not None:
        from flows.orchestration.dashboard_login import DashboardLogin

        inner = DashboardLogin(inner, access, os.environ[SERVER_LOGIN])
    return HostGuard(inner, names)


def _let_dashboard_be_written() -> None:
    """Give the dashboard's files a folder of this user where the package is another user's.

    Prefect writes them beside its own code at every start. In a container the code is root's, and
    Prefect then serves no dashboard.
    """
    found = find_spec("prefect")
    places = [] if found is None else found.submodule_search_locations or []
    if not all(os.access(Path(place) / "server", os.W_OK) for place in places):
        home = os.environ.get("PREFECT_HOME") or Path.home() / ".prefect"
        os.environ.setdefault("PREFECT_SERVER_UI_STATIC_DIRECTORY", str(Path(home) / "ui"))


def serve(host: str, port: int, names: Iterable[str], access: Access | None = None) -> None:
    """Serve API and dashboard until this process receives a signal to end."""
    _, most = resource.getrlimit(resource.RLIMIT_NOFILE)
    resource.setrlimit(resource.RLIMIT_NOFILE, (most, most))  # each client has several connections
    serve_http(
        guarded_app({*names, host} - {"0.0.0.0", "::"}, access),
        host=host,
        port=port,
        max_connections=MAX_CONNECTIONS,
        ws="auto",
        server_header=False,
        timeout_graceful_shutdown=2,
    )


class RepeatBusy:
    """ASGI middleware that repeats changes that Prefect refuses because its database is busy.

    SQLite has one writer. A transaction that reads and then writes fails at once if another one
    wrote in between, and Prefect then undoes it and answers 503. Its dashboard reports that as an
    error, and the run or schedule that a person submitted does not exist. `pause_s` is before each
    repetition [s].
    """

    def __init__(self, app: ASGIApp, pause_s: float = PAUSE_SECONDS) -> None:
        self.app, self.pause_s = app, pause_s

    async def __call__(self, scope: Scope, receive: Receive, send: Send) -> None:
        """Answer a request."""
        if scope["type"] != "http" or scope["method"] in SAFE_METHODS:
            await self.app(scope, receive, send)
            return
        body: list[Message] = []
        while not body or body[-1].get("more_body", False):
            message = await receive()
            if message["type"] == "http.disconnect":
                return
            body.append(message)
        for left in range(REPETITIONS, -1, -1):
            if not await self._is_refused(scope, body, receive, send, may_repeat=left > 0):
                return
            await asyncio.sleep(self.pause_s)

    async def _is_refused(
        self, scope: Scope, body: list[Message], receive: Receive, send: Send, *, may_repeat: bool
    ) -> bool:
        """Ask Prefect once; withhold an answer after which to repeat, and return True then."""
        unread = iter(body)
        is_refused = False

        async def read() -> Message:
            return next(unread, None) or await receive()

        async def answer(message: Message) -> None:
            nonlocal is_refused
            if message["type"] == "http.response.start":
                is_refused = may_repeat and message["status"] == BUSY
            if not is_refused:
                await send(message)

        try:
            await self.app(dict(scope), read, answer)
        except Exception:  # of the database, raised once more after it was answered
            if not is_refused:
                raise
        return is_refused


def main() -> None:
    """Serve as the arguments state.

    `--socket` is for `worldpose run`: serve the inherited socket until standard input closes.
    Prefect's own temporary server outlives a killed parent; this one does not.
    """
    parser = argparse.ArgumentParser(prog="python -m flows.orchestration.prefect_server")
    parser.add_argument("--host", default="127.0.0.1", help="address to listen at")
    parser.add_argument("--port", type=int, default=4200)
    parser.add_argument(
        "--host-name", action="append", default=[], help="name in clients; repeatable"
    )
    parser.add_argument("--socket", type=int, help=argparse.SUPPRESS)
    given = parser.parse_args()
    if given.socket is None:
        serve(given.host, given.port, given.host_name)
        return
    threading.Thread(target=_end_with_parent, daemon=True).start()
    import uvicorn

    app = guarded_app((), is_embedded=True)
    server = uvicorn.Server(uvicorn.Config(app, log_level="error", lifespan="on"))
    server.run(sockets=[socket.socket(fileno=given.socket)])


def _end_with_parent() -> None:
    """End when standard input closes, and remove the folder that a killed run leaves behind."""
    sys.stdin.buffer.read()
    home = os.environ.get("PREFECT_HOME", "")
    if Path(home).name.startswith(RUN_HOME):
        with suppress(OSError):  # there is no such program
            os.execvp("rm", ("rm", "-rf", home))  # ends all threads, which would write on
    os._exit(0)


if __name__ == "__main__":
    try:
        main()
    except UsageError as error:
        sys.exit(f"error: {error}")
