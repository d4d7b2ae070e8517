"""Prefect's API and dashboard for a browser that has logged in to the pages."""

from __future__ import annotations

import asyncio
import json
import re
from contextlib import suppress
from typing import Final
from urllib.parse import quote

from starlette.datastructures import Headers
from starlette.responses import JSONResponse, RedirectResponse
from starlette.types import ASGIApp, Message, Receive, Scope, Send

from flows.orchestration.prefect_environment import authorization
from flows.patience import SilentDiskError
from flows.web.access import Access
from flows.web.guard import LOG, OPEN, SAFE, SILENT, identify_in_time
from flows.web.host_guard import refusal
from flows.web.sessions import login_app

FORM: Final = OPEN - {"/api/health"} | {"/api/session", "/api/logout"}
"""Paths of the log-in form; Prefect's own `/login` would ask for its password."""
BARE: Final = re.compile(
    r"/api/(health|ready)|(/v2)?/(assets|fonts|ico)/.*|(/v2)?/[\w-]+\.(ico|js|svg|txt)"
)
"""Paths that Prefect answers without its login, to browsers too; others are pages."""
READING: Final = re.compile(
    r"POST .*/(filter|paginate|history|lateness|next-runs|validate|counts?|count-[\w-]+|"
    r"events/count-by/[\w-]+)"
)
"""Requests that the dashboard makes all the time, and that change nothing."""
CHECK_SECONDS: Final = 1.0
"""Interval at which the session of an open WebSocket is checked [s]."""


class DashboardLogin:
    """ASGI middleware that gives Prefect's login to requests with the session of an approver.

    Prefect checks the login, USER:PASSWORD, as before. A session of the pages counts only for
    requests of this server's own pages, which the host guard around this one has told from foreign
    ones; a change must state its origin. Clients with the login pass unchanged. A browser without
    either gets the pages' form.
    """

    def __init__(self, app: ASGIApp, access: Access, login: str) -> None:
        self.app, self.access, self.login = app, access, login
        self.form = login_app(access)
        # Without users, a proxy logs people in, and Prefect's own form stays for everyone else.
        self.form_paths = frozenset[str]() if access.users == {} else FORM

    async def __call__(self, scope: Scope, receive: Receive, send: Send) -> None:
        """Answer a request."""
        if scope["type"] not in ("http", "websocket"):
            await self.app(scope, receive, send)
            return
        headers, method = Headers(scope=scope), scope.get("method", "")
        is_own = "origin" in headers or headers.get("sec-fetch-site") == "same-origin"
        is_page = method == "GET" and "text/html" in headers.get("accept", "")
        is_page = is_page and not BARE.fullmatch(scope["path"])
        try:
            who, role, _, _ = await identify_in_time(self.access, scope, headers)
        except SilentDiskError:
            if method:
                await refusal(503, SILENT)(scope, receive, send)
            else:
                await send({"type": "websocket.close", "code": 1013, "reason": SILENT[:100]})
            return
        if method and scope["path"] in self.form_paths:
            await self.form(scope, receive, send)
        elif who is not None and role == "approver" and (is_own or method in SAFE):
            if method:
                await self._ask(who, scope, receive, send)
            else:
                await self._stream(scope, receive, send)
        elif not is_page or "authorization" in headers or not (who or self.form_paths):
            await self.app(scope, receive, send)
        elif who is not None:
            said = f"the role of {who}, {role}, does not allow this: others log in at /login"
            refused = refusal(403, said)
            await refused(scope, receive, send)
        else:
            query = scope["query_string"]
            asked = quote(scope["raw_path"] + (b"?" + query if query else b""), safe="/")
            await RedirectResponse(f"/login?next={asked}", status_code=303)(scope, receive, send)

    async def _ask(self, who: str, scope: Scope, receive: Receive, send: Send) -> None:
        """Pass a request on with the login, and log each change with its person.

        The dashboard's settings then name no login.
        """
        place = f"{scope['method']} {scope['path']}"
        is_settings = place == "GET /ui-settings"
        dropped = (b"authorization", *[b"accept-encoding"] * is_settings)
        headers = [each for each in scope["headers"] if each[0] not in dropped]
        headers.append((b"authorization", authorization(self.login).encode()))
        status, body = 0, b""

        async def answered(message: Message) -> None:
            nonlocal status, body
            status = message.get("status", status)
            is_start = message["type"] == "http.response.start"
            if is_start and scope["method"] not in SAFE and not READING.fullmatch(place):
                LOG.info("%s: %r: %s", who, place, status)
            if not is_settings or status != 200:
                await send(message)
            else:
                body += message.get("body", b"")

        await self.app({**scope, "headers": headers}, receive, answered)
        if is_settings and status == 200:
            without = {**json.loads(body), "auth": None}  # the dashboard would ask for the login
            answer = JSONResponse(without, headers={"cache-control": "no-store"})
            await answer(scope, receive, send)

    async def _stream(self, scope: Scope, receive: Receive, send: Send) -> None:
        """Pass a WebSocket on, with the login in its first message, while the session lasts."""
        is_first, headers = True, Headers(scope=scope)

        async def read() -> Message:
            nonlocal is_first
            message = await receive()
            if message["type"] == "websocket.receive" and is_first:
                is_first = False
                try:
                    said = json.loads(message.get("text") or "null")
                except (ValueError, RecursionError):
                    why = "expected JSON in the first message, found other text"
                    await send({"type": "websocket.close", "code": 1007, "reason": why})
                    return {"type": "websocket.disconnect", "code": 1007}
                if isinstance(said, dict) and said.get("type") == "auth":
                    message = {**message, "text": json.dumps({**said, "token": self.login})}
            return message

        stream = asyncio.ensure_future(self.app(scope, read, send))
        try:
            while not (await asyncio.wait({stream}, timeout=CHECK_SECONDS))[0]:
                who, role = None, None  # also if nobody can say whether the session has ended
                with suppress(SilentDiskError):
                    who, role, _, _ = await identify_in_time(self.access, scope, headers)
                if who is None or role != "approver":
                    stream.cancel()
                    await asyncio.wait({stream})
                    await send({"type": "websocket.close", "code": 1008})
                    return
            await stream
        finally:
            stream.cancel()
