"""Host and origin checks: a server accepts requests that name it, and none of other sites.

A web page in a user's browser can send requests to any port of the user's machine, and can point a
name of its own there (DNS rebinding). Both show in headers that a page cannot choose.
"""

from __future__ import annotations

import re
from collections.abc import Iterable
from typing import Final

from starlette.datastructures import Headers
from starlette.responses import JSONResponse, Response
from starlette.types import ASGIApp, Receive, Scope, Send

LOOPBACK: Final = frozenset({"127.0.0.1", "localhost", "::1"})
"""Names of this machine on loopback."""
SAFE_METHODS: Final = frozenset({"GET", "HEAD"})
_HOST: Final = re.compile(r"(?:(?P<name>[A-Za-z0-9.-]+)|\[(?P<ipv6>[0-9A-Fa-f:.]+)\])(?::\d{1,5})?")


def host_name(host: str) -> str:
    """Return the name in a Host header, without its port; empty if the header is malformed.

    The port is not compared: a tunnel can use another.
    """
    found = _HOST.fullmatch(host)
    return "" if found is None else (found["name"] or found["ipv6"]).lower()


def refuse_foreign(scope: Scope, headers: Headers, names: Iterable[str]) -> Response | None:
    """Refuse a request that names another server or comes from another site's page.

    The scope is that of an HTTP request or a WebSocket; this server has lower-case names. Return
    421 for another name in Host, 403 for a foreign Origin or Sec-Fetch-Site; None if the request is
    allowed. A link to one of our pages from another site is no attack.
    """
    hosts = headers.getlist("host")
    if len(hosts) != 1 or host_name(hosts[0]) not in names:
        return refusal(421, "this server has another name")
    origins = headers.getlist("origin")
    if any(origin.partition("://")[2] != hosts[0] for origin in origins):
        return refusal(403, "this comes from a page of another server")
    site = headers.get("sec-fetch-site", "same-origin")
    is_link = (
        scope["type"] == "http"
        and scope["method"] in SAFE_METHODS
        and headers.get("sec-fetch-mode") == "navigate"
        and headers.get("sec-fetch-dest") == "document"
    )
    if site not in ("same-origin", "none") and not is_link:
        return refusal(403, "this comes from a page of another server")
    return None


def refusal(status: int, why: str) -> JSONResponse:
    """Return a response that says why a request is refused."""
    return JSONResponse({"error": why}, status_code=status)


class HostGuard:
    """ASGI middleware that refuses what `refuse_foreign` refuses, over HTTP and WebSocket."""

    def __init__(self, app: ASGIApp, names: Iterable[str]) -> None:
        self.app = app
        self.names = LOOPBACK | {name.lower() for name in names}

    async def __call__(self, scope: Scope, receive: Receive, send: Send) -> None:
        """Send the refusal, or pass the request to the application."""
        if scope["type"] not in ("http", "websocket"):
            await self.app(scope, receive, send)
            return
        refused = refuse_foreign(scope, Headers(scope=scope), self.names)
        if refused is None:
            await self.app(scope, receive, send)
        elif scope["type"] == "http":
            await refused(scope, receive, send)
        else:
            await receive()  # the connect request; closing before accepting sends a 403
            await send({"type": "websocket.close", "code": 1008})
