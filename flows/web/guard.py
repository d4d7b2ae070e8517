"""Refusal of requests to the pages, before their routes."""

from __future__ import annotations

import logging
from contextlib import suppress
from http.cookies import CookieError, SimpleCookie
from pathlib import Path
from typing import Final, TypeAlias

from starlette.datastructures import Headers, MutableHeaders
from starlette.responses import RedirectResponse, Response
from starlette.types import ASGIApp, Message, Receive, Scope, Send

from flows.patience import SilentDiskError, ask_disk
from flows.web.access import LOOPBACK, SESSION_SECONDS, Access
from flows.web.host_guard import host_name, refusal, refuse_foreign
from flows.web.proxy import Role, Visitor

LOG: Final = logging.getLogger("worldpose.pages")
OPEN: Final = frozenset(
    {"/api/health", "/api/login", "/login", "/login/page.js", "/login/page.css"}
)
"""Paths that answer without a session."""
BODY_BYTES: Final = 1 << 20
"""Maximum size of a request body [byte]."""
CHUNK_BYTES: Final = 1 << 23
"""Maximum size of one chunk of an upload [byte]."""
CHUNK_SUFFIX: Final = "/bytes"
"""Suffix of the paths that take chunks; all others take JSON."""
SAFE: Final = frozenset({"GET", "HEAD", "OPTIONS"})
HSTS_SECONDS: Final = 365 * 86400
"""Time for which browsers then reach this name by TLS alone."""
SILENT: Final = (
    "the disk of the project does not answer: its operator must look after it, or the network to it"
)
ASKING: Final = "/preview"
"""Suffix of paths that are posted to with every mouse move, and change nothing."""
POLICY: Final = (
    "default-src 'none'; script-src 'self'; style-src 'self'; img-src 'self' blob: data:; "
    "media-src 'self'; connect-src 'self'; base-uri 'none'; form-action 'self'; "
    "frame-ancestors 'none'"
)
"""Content that a page can load: scripts, styles, images, videos of this server; nothing inline."""


Identity: TypeAlias = tuple[str | None, Role | None, str | None, Visitor | None]


def identify(access: Access, scope: Scope, headers: Headers) -> Identity:
    """Return person, role and session of a request, and the visitor whom a proxy has logged in.

    The person is None without a valid session; the role is None if no group of a visitor has one.
    """
    try:
        found = SimpleCookie(headers.get("cookie", "")).get(access.cookie)
    except CookieError:
        found = None
    session = None if found is None else found.value
    visitor = None if access.proxy is None else access.proxy.visitor(scope, headers)
    if visitor is not None:
        is_own = access.person(session, by_proxy=True) == visitor.who
        return visitor.who, visitor.role, session if is_own else None, visitor
    who = access.person(session)
    return who, access.role(who), session, None


async def identify_in_time(
    access: Access, scope: Scope, headers: Headers, disk: Path | None = None
) -> Identity:
    """Do as `identify`; the files of the log-in form need no session.

    SilentDiskError if the disk of the project, or of ended sessions, does not answer.
    """
    is_open = scope["path"] in OPEN and scope.get("method") in SAFE
    if is_open and access.proxy is None:
        headers = Headers(raw=[each for each in headers.raw if each[0] != b"cookie"])
    sessions = access.ended if "cookie" in headers else None

    def look() -> Identity:
        if disk is not None and not is_open:
            with suppress(OSError):  # an error is an answer
                next(disk.iterdir(), None)
        return identify(access, scope, headers)

    place = sessions if is_open else disk or sessions
    return look() if place is None else await ask_disk(str(place), look)


def set_session(answer: Response, access: Access, session: str, secure: bool) -> None:
    """Set the cookie of a session, out of reach of scripts and other sites."""
    answer.set_cookie(
        access.cookie,
        session,
        max_age=SESSION_SECONDS,
        httponly=True,
        samesite="strict",
        secure=secure,
    )


class Guard:
    """Refuses requests that do not come from a page of this server with a valid session.

    Host: a foreign name that points here (DNS rebinding) is refused. Session: all but `OPEN` needs
        one; a person whom a trusted proxy names gets one. Changes: need the session's form secret,
        and this origin if the browser states one. Size: at most `BODY_BYTES`, or `CHUNK_BYTES` of
        a chunk of a file. Every login and every requested change is logged with person, request
        and response. Disk: while that of the project is silent, all but the form gets 503.
    """

    def __init__(self, app: ASGIApp, access: Access, disk: Path | None = None) -> None:
        self.app, self.access, self.disk = app, access, disk

    async def __call__(self, scope: Scope, receive: Receive, send: Send) -> None:
        """Send the refusal, or pass the request on with person, role and session in `state`."""
        if scope["type"] == "lifespan":
            await self.app(scope, receive, send)
            return
        if scope["type"] != "http":
            raise RuntimeError(f"nothing here speaks {scope['type']}")
        headers = Headers(scope=scope)
        access = self.access
        found: Identity = (None, None, None, None)
        refused: Response | None = None
        try:
            found = await identify_in_time(access, scope, headers, self.disk)
        except SilentDiskError:
            refused = refusal(503, SILENT)
        who, role, session, visitor = found
        begun = Response()  # a session that begins with this request
        if visitor is not None and session is None:
            session = access.session(visitor.who, by_proxy=True)
            set_session(begun, access, session, access.secure or visitor.secure)
        state = scope.setdefault("state", {})
        state |= {"who": who, "role": role, "session": session, "is_proxied": visitor is not None}

        is_gone = False

        async def receive_noted() -> Message:
            nonlocal is_gone
            message = await receive()
            is_gone = is_gone or message["type"] == "http.disconnect"
            return message

        async def send_sealed(message: Message) -> None:
            if message["type"] == "http.response.start":
                sealed = MutableHeaders(scope=message)
                _seal(sealed, scope["path"])
                # Not of localhost: a browser would ask all of its ports for TLS, Prefect's too.
                if access.secure and host_name(headers.get("host", "")) not in LOOPBACK:
                    sealed["strict-transport-security"] = f"max-age={HSTS_SECONDS}"
                if role is not None and "set-cookie" not in sealed:  # as logging out sets one
                    for cookie in begun.headers.getlist("set-cookie"):
                        sealed.append("set-cookie", cookie)
                is_frequent = scope["path"].endswith((ASKING, CHUNK_SUFFIX))
                asked = is_frequent and message["status"] < 400
                # A client that disconnected in the middle of its request requested nothing.
                if scope["method"] not in SAFE and not asked and not is_gone:
                    place = f"{scope['method']} {scope['path']}"
                    # After a login, log the new person.
                    LOG.info("%s: %r: %s", state["who"] or "nobody", place, message["status"])
            await send(message)

        refused = refused or self._refusal(scope, headers)
        if refused is not None:
            await refused(scope, receive_noted, send_sealed)
            return
        await self.app(scope, receive_noted, send_sealed)

    def _refusal(self, scope: Scope, headers: Headers) -> Response | None:
        foreign = refuse_foreign(scope, headers, self.access.hosts)
        if foreign is not None:
            return foreign
        path, method, state = scope["path"], scope["method"], scope["state"]
        who, role, session = state["who"], state["role"], state["session"]
        if role is None:
            return refusal(403, f"none of the groups of {who} has a role here")
        if state["is_proxied"] and path == "/login":
            return RedirectResponse("/", status_code=303)
        if path not in OPEN and who is None:
            if method == "GET" and path == "/":
                return RedirectResponse("/login", status_code=303)
            return refusal(401, "log in first")
        if method in SAFE:
            return None
        if path not in OPEN and not self.access.may_change(role, path):
            return refusal(403, f"the role of {who}, {role}, does not allow this")
        if headers.get("sec-fetch-site", "same-origin") != "same-origin":
            return refusal(403, "this comes from a page of another server")
        is_chunk = method == "PUT" and path.endswith(CHUNK_SUFFIX)
        kind = "application/octet-stream" if is_chunk else "application/json"
        if headers.get("content-type", "").partition(";")[0] != kind:
            return refusal(415, "only bytes are taken in" if is_chunk else "only JSON is taken in")
        if path not in OPEN and not self.access.has_form_secret(
            session or "", headers.get("x-form-secret", "")
        ):
            return refusal(403, "the page is of another session: load it again")
        length = headers.get("content-length", "")
        if not (length.isascii() and length.isdigit()):  # without a length, the size is unbounded
            return refusal(411, "state its length")
        limit = CHUNK_BYTES if is_chunk else BODY_BYTES
        if len(length) > 12 or int(length) > limit:
            return refusal(413, f"at most {limit} bytes are taken in")
        return None


def _seal(headers: MutableHeaders, path: str) -> None:
    headers.setdefault("content-security-policy", POLICY)
    headers["x-content-type-options"] = "nosniff"
    headers["x-frame-options"] = "DENY"
    headers["referrer-policy"] = "no-referrer"
    headers["cross-origin-opener-policy"] = "same-origin"
    headers["cross-origin-resource-policy"] = "same-origin"
    if "cache-control" not in headers:
        headers["cache-control"] = "no-store"
