"""Checks that every request must pass first."""

from __future__ import annotations

import logging
from http.cookies import CookieError, SimpleCookie
from typing import Final

from starlette.datastructures import Headers, MutableHeaders
from starlette.responses import RedirectResponse, Response
from starlette.types import ASGIApp, Message, Receive, Scope, Send

from flows.web.access import Access
from flows.web.host_guard import refusal, refuse_foreign

OPEN: Final = frozenset(
    {"/api/health", "/api/login", "/login", "/login/page.js", "/login/page.css"}
)
"""Paths that answer without a session."""
BODY_BYTES: Final = 1 << 20
"""Maximum size of a request body [byte]."""
SAFE: Final = frozenset({"GET", "HEAD", "OPTIONS"})
ASKING: Final = "/preview"
"""Suffix of paths that are posted to with every mouse move, and change nothing."""
POLICY: Final = (
    "default-src 'none'; script-src 'self'; style-src 'self'; img-src 'self' blob: data:; "
    "media-src 'self'; connect-src 'self'; base-uri 'none'; form-action 'self'; "
    "frame-ancestors 'none'"
)
"""Content that a page can load: scripts, styles, images, videos of this server; nothing inline."""

logger = logging.getLogger("worldpose.pages")


class Guard:
    """Refuses requests that do not come from a page of this server with a valid session.

    Host: a foreign name that points here (DNS rebinding) is refused. Session: all but `OPEN` needs
        one. Changes: need the session's form secret, and this origin if the browser states one.
        Size: at most `BODY_BYTES`. Every login and every requested change is logged with person,
        request and response.
    """

    def __init__(self, app: ASGIApp, access: Access) -> None:
        self.app, self.access = app, access

    async def __call__(self, scope: Scope, receive: Receive, send: Send) -> None:
        """Send the refusal, or pass the request on with `state.who` and `state.session`."""
        if scope["type"] == "lifespan":
            await self.app(scope, receive, send)
            return
        if scope["type"] != "http":
            raise RuntimeError(f"nothing here speaks {scope['type']}")
        headers = Headers(scope=scope)
        session = _cookie(headers, self.access.cookie)
        who = self.access.person(session)
        state = scope.setdefault("state", {})
        state["who"], state["session"] = who, session

        is_gone = False

        async def heard() -> Message:
            nonlocal is_gone
            message = await receive()
            is_gone = is_gone or message["type"] == "http.disconnect"
            return message

        async def sealed(message: Message) -> None:
            if message["type"] == "http.response.start":
                _seal(MutableHeaders(scope=message), scope["path"])
                asked = scope["path"].endswith(ASKING) and message["status"] < 400
                # A client that disconnected in the middle of its request requested nothing.
                if scope["method"] not in SAFE and not asked and not is_gone:
                    place = f"{scope['method']} {scope['path']}"
                    # After a login, log the new person.
                    logger.info("%s: %r: %s", state["who"] or "nobody", place, message["status"])
            await send(message)

        refusal = self._refusal(scope, headers, who, session)
        if refusal is not None:
            await refusal(scope, heard, sealed)
            return
        await self.app(scope, heard, sealed)

    def _refusal(
        self, scope: Scope, headers: Headers, who: str | None, session: str | None
    ) -> Response | None:
        foreign = refuse_foreign(scope, headers, self.access.hosts)
        if foreign is not None:
            return foreign
        path, method = scope["path"], scope["method"]
        if path not in OPEN and who is None:
            if method == "GET" and path == "/":
                return RedirectResponse("/login", status_code=303)
            return refusal(401, "log in first")
        if method in SAFE:
            return None
        if headers.get("sec-fetch-site", "same-origin") != "same-origin":
            return refusal(403, "this comes from a page of another server")
        if headers.get("content-type", "").partition(";")[0] != "application/json":
            return refusal(415, "only JSON is taken in")
        if path not in OPEN and not self.access.has_form_secret(
            session or "", headers.get("x-form-secret", "")
        ):
            return refusal(403, "the page is of another session: load it again")
        length = headers.get("content-length", "")
        if not (length.isascii() and length.isdigit()):  # without a length, the size is unbounded
            return refusal(411, "say how long it is")
        if len(length) > 12 or int(length) > BODY_BYTES:
            return refusal(413, f"at most {BODY_BYTES} bytes are taken in")
        return None


def _cookie(headers: Headers, name: str) -> str | None:
    try:
        found = SimpleCookie(headers.get("cookie", "")).get(name)
    except CookieError:
        return None
    return None if found is None else found.value


def _seal(headers: MutableHeaders, path: str) -> None:
    headers["content-security-policy"] = POLICY
    headers["x-content-type-options"] = "nosniff"
    headers["x-frame-options"] = "DENY"
    headers["referrer-policy"] = "no-referrer"
    headers["cross-origin-opener-policy"] = "same-origin"
    headers["cross-origin-resource-policy"] = "same-origin"
    if "cache-control" not in headers:
        headers["cache-control"] = "no-store"
