"""Serving the pages until somebody ends it."""

from __future__ import annotations

from pathlib import Path

from flows.web.access import LOOPBACK, Access
from flows.web.app import create_app
from flows.web.http_server import serve_http


def serve(
    project: str, access: Access, *, host: str, port: int, tls: tuple[Path, Path] | None
) -> None:
    """Serve a project's pages; returns when it is interrupted.

    Args:
        project: folder or URL of the store.
        access: who may use them.
        host: address to listen at.
        port: 0 = one that is free.
        tls: files of certificate and key.

    Raises:
        InputError: no such project.
        UsageError: the port is taken.
    """
    certificate, key = (None, None) if tls is None else map(str, tls)
    serve_http(
        create_app(project, access),
        host=host,
        port=port,
        server_header=False,
        ssl_certfile=certificate,
        ssl_keyfile=key,
        timeout_graceful_shutdown=2,
    )


def address(access: Access, host: str, port: int) -> str:
    """Where a person opens the pages; the token stands where browsers keep it to themselves."""
    name = host
    if host not in LOOPBACK:
        name = sorted(access.hosts - LOOPBACK)[0]
    name = f"[{name}]" if ":" in name else name
    return f"{'https' if access.secure else 'http'}://{name}:{port}/login#token={access.token}"
