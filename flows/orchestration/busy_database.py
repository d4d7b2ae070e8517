"""Repetition of a browser's requests that Prefect refuses because its SQLite database is busy.

SQLite has one writer. A transaction that reads and then writes fails at once if another one wrote
in between, and Prefect then answers 503. Prefect's clients ask again; its dashboard only says that
something went wrong, and the run or schedule that a person submitted does not exist.
"""

from __future__ import annotations

import asyncio
from typing import TYPE_CHECKING, Final

from starlette.datastructures import Headers

from flows.web.host_guard import SAFE_METHODS

if TYPE_CHECKING:
    from starlette.types import ASGIApp, Message, Receive, Scope, Send

BUSY: Final = 503
REPETITIONS: Final = 8
"""Repetitions of a refused request; with the pauses below they last 4 s without their own time."""
PAUSE_SECONDS: Final = 0.5
"""Pause before each repetition [s]."""


class RepeatBusy:
    """ASGI middleware that repeats refused changes of browsers.

    Args:
        app: Prefect's server, which has undone all that a refused request had written.
        pause_s: pause before each repetition [s].
    """

    def __init__(self, app: ASGIApp, pause_s: float = PAUSE_SECONDS) -> None:
        self.app, self.pause_s = app, pause_s

    async def __call__(self, scope: Scope, receive: Receive, send: Send) -> None:
        """Answer a request; only browsers send `Sec-Fetch-Mode`."""
        is_change = scope["type"] == "http" and scope["method"] not in SAFE_METHODS
        if not is_change or "sec-fetch-mode" not in Headers(scope=scope):
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
