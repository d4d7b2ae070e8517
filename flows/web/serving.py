"""Serving the pages until interrupted."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

from flows.web.access import LOOPBACK, Access
from flows.web.app import create_app
from flows.web.http_server import serve_http
from flows.web.intake import Intake


def serve(
    project: str,
    access: Access,
    *,
    host: str,
    port: int,
    tls: tuple[Path, Path] | None,
    announce: Callable[[], None] = lambda: None,
    intake: Intake | None = None,
) -> None:
    """Serve a project's pages; return when interrupted.

    Args:
        project: folder or URL of the store.
        access: access control.
        host: address to listen at.
        port: 0 = any free one.
        tls: certificate and key files.
        announce: called when the port is ours.
        intake: where people put new matches; None: they create none here.

    Raises:
        InputError: there is no such project, or the port is taken.
    """
    certificate, key = (None, None) if tls is None else map(str, tls)
    serve_http(
        create_app(project, access, intake),
        host=host,
        port=port,
        announce=announce,
        server_header=False,
        ssl_certfile=certificate,
        ssl_keyfile=key,
        timeout_graceful_shutdown=2,
    )


def address(access: Access, host: str, port: int) -> str:
    """Return the pages' URL; the token is in the fragment, which browsers do not send."""
    name = host
    if host not in LOOPBACK:
        name = sorted(access.hosts - LOOPBACK)[0]
    name = f"[{name}]" if ":" in name else name
    return f"{'https' if access.secure else 'http'}://{name}:{port}/login#token={access.token}"
