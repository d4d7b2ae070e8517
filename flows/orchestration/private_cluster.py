"""Local workers and a scheduler that only they and their run can use.

Dask runs any code that a client sends, and a scheduler is reachable for every user of its machine.
This one requires a certificate that exists only in the memory of one run's processes. For a cluster
over several machines, `python -m flows.orchestration.private_cluster FOLDER` writes a certificate.
"""

from __future__ import annotations

import os
import sys
from pathlib import Path
from typing import Any, Final

import dask
from distributed import LocalCluster, Security

HUGE_PAGES: Final = {"distributed.nanny.pre-spawn-environ.GLIBC_TUNABLES": "glibc.malloc.hugetlb=1"}
"""Let workers get large arrays in pages of 2 MiB, those of compiled kernels too: by pages of 4 KiB
the kernel of the operating system took a fifth of the CPU time of body fitting. A value that the
environment has is used instead; C libraries other than glibc ignore it."""


class PrivateCluster(LocalCluster):
    """Local cluster over TLS, for processes with its certificate; it has no HTTP servers."""

    def __init__(self, preload: list[str] | None = None, **options: Any) -> None:  # noqa: ANN401
        # The HTTP servers are closed right after their start, before they served anything.
        silent: dict[str, list[str]] = {
            f"distributed.{node}.http.routes": [] for node in ("scheduler", "worker")
        }
        dask.config.set(HUGE_PAGES)  # also read when a lost worker is replaced
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


def write_certificate(folder: Path) -> None:
    """Write `certificate.pem` and `key.pem`, valid for a year, for this user alone.

    Schedulers, workers and clients with both files trust only each other.
    """
    folder.mkdir(mode=0o700, parents=True, exist_ok=True)
    made = Security.temporary()
    for name, content in (
        ("certificate.pem", made.tls_worker_cert),
        ("key.pem", made.tls_worker_key),
    ):
        (folder / name).unlink(missing_ok=True)
        flags = os.O_WRONLY | os.O_CREAT | os.O_EXCL
        with os.fdopen(os.open(folder / name, flags, 0o600), "w") as file:
            file.write(content)


if __name__ == "__main__":
    if len(sys.argv) != 2:
        sys.exit("usage: python -m flows.orchestration.private_cluster FOLDER")
    write_certificate(Path(sys.argv[1]))
