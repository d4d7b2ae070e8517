"""Prefect's API for one run: `python -m flows.embedded_server SOCKET`, ends with standard input.

Prefect's own temporary server outlives a parent that is killed; this one does not.
"""

from __future__ import annotations

import gc
import os
import socket
import sys
import threading


def main() -> None:
    """Serve on the inherited socket until standard input is closed."""
    threading.Thread(target=_end_with_parent, daemon=True).start()
    # Collecting garbage takes a fifth of the seconds in which modules are imported that all stay.
    gc.disable()
    import uvicorn
    from prefect.server.api.server import create_app

    app = create_app(ephemeral=True, final=True)
    gc.freeze()
    gc.enable()
    server = uvicorn.Server(uvicorn.Config(app, log_level="error", lifespan="on"))
    server.run(sockets=[socket.socket(fileno=int(sys.argv[1]))])


def _end_with_parent() -> None:
    sys.stdin.buffer.read()
    os._exit(0)


if __name__ == "__main__":
    main()
