"""Command review serve: the pages for people in the loop."""

from __future__ import annotations

import logging
from pathlib import Path
from typing import Annotated

import typer

from flows.cli.console import DEFAULT_PROJECT, ProjectOption, line
from worldpose.errors import UsageError
from worldpose.store import Store


def serve(
    port: Annotated[int, typer.Option(min=1, max=65535, help="Port to listen at.")] = 8571,
    host: Annotated[str, typer.Option(help="Address to listen at; this machine alone.")] = (
        "127.0.0.1"
    ),
    names: Annotated[
        list[str] | None,
        typer.Option("--name", help="Name of this machine in browsers elsewhere; repeatable."),
    ] = None,
    certificate: Annotated[
        Path | None, typer.Option("--certificate", help="PEM file; with --key: serve with TLS.")
    ] = None,
    key: Annotated[Path | None, typer.Option("--key", help="PEM file of its private key.")] = None,
    token: Annotated[
        str | None,
        typer.Option(
            envvar="WORLDPOSE_REVIEW_TOKEN",
            show_envvar=True,
            help="What people log in with; a new one by default.",
        ),
    ] = None,
    project: ProjectOption = DEFAULT_PROJECT,
) -> None:
    """Serve the review pages to browsers until interrupted.

    Example: worldpose review serve --port 8571
    """
    # Late: the server takes half a second to import, which no other command needs.
    from flows.pages.access import access_for
    from flows.pages.serving import address
    from flows.pages.serving import serve as serve_pages

    if (certificate is None) != (key is None):
        raise UsageError(
            "--certificate and --key",
            expected="both or none",
            found="one of them",
            todo="Give the certificate's file and its private key's.",
        )
    tls = (certificate, key) if certificate is not None and key is not None else None
    access = access_for(host, token=token, names=names or (), secure=tls is not None)
    logging.basicConfig(format="%(asctime)s  %(message)s", level=logging.WARNING)
    logging.getLogger("worldpose.pages").setLevel(logging.INFO)
    line(f"review pages of {Store.open(project).url}: {address(access, host, port)}")
    serve_pages(project, access, host=host, port=port, tls=tls)
