"""Command review serve: the review pages."""

from __future__ import annotations

import logging

from flows.cli.console import DEFAULT_PROJECT, ProjectOption, line
from flows.cli.page_server import (
    PAGES_PORT,
    CertificateOption,
    HostOption,
    KeyOption,
    NamesOption,
    PortOption,
    TokenOption,
    certificate_and_key,
)
from worldpose.store import Store


def serve(
    port: PortOption = PAGES_PORT,
    host: HostOption = "127.0.0.1",
    names: NamesOption = None,
    certificate: CertificateOption = None,
    key: KeyOption = None,
    token: TokenOption = None,
    project: ProjectOption = DEFAULT_PROJECT,
) -> None:
    """Serve the review pages to browsers until interrupted.

    Example: worldpose review serve --port 8571
    """
    # Imported here: the server takes half a second to import, and no other command needs it.
    from flows.web.access import access_for
    from flows.web.serving import address
    from flows.web.serving import serve as serve_pages

    tls = certificate_and_key(certificate, key)
    access = access_for(host, token=token, names=names or (), secure=tls is not None)
    logging.basicConfig(format="%(asctime)s  %(message)s", level=logging.WARNING)
    logging.getLogger("worldpose.pages").setLevel(logging.INFO)
    # A token chosen by the operator is not printed: the output can go to a log.
    where = address(access, host, port)
    shown = where if token is None else where.partition("#")[0]
    line(f"review pages of {Store.open(project).url}: {shown}")
    serve_pages(project, access, host=host, port=port, tls=tls)
