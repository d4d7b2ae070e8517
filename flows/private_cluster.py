"""Workers on this machine, and a scheduler that only they and their run can use.

Dask runs whatever code a client sends, and a scheduler listens to every user of its machine. This
one takes no connection without a certificate that exists in the memory of one run's processes.
"""

from __future__ import annotations

from typing import Any

import dask
from distributed import LocalCluster, Security


class PrivateCluster(LocalCluster):
    """A local cluster over TLS, for those that have its certificate; nothing of it speaks HTTP."""

    def __init__(self, preload: list[str] | None = None, **options: Any) -> None:  # noqa: ANN401
        # The servers for HTTP are closed as soon as they are started, and had nothing to tell.
        silent: dict[str, list[str]] = {
            f"distributed.{node}.http.routes": [] for node in ("scheduler", "worker")
        }
        with dask.config.set(silent):
            super().__init__(  # type: ignore[no-untyped-call]
                security=Security.temporary(),
                protocol="tls://",
                preload=["tasks.preload"] if preload is None else preload,
                **options,
            )

    async def _start(self) -> None:
        await super()._start()  # type: ignore[no-untyped-call]
        scheduler: Any = self.scheduler
        scheduler.http_server.stop()
