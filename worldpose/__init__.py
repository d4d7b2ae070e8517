"""The method and the library: metric 3D poses of every player from many cameras.

`open_run` gives a run's results as labelled arrays.
"""

from __future__ import annotations

from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from worldpose.store.store import open_run as open_run

__all__ = ["open_run"]


def __getattr__(name: str) -> object:
    # Lazy import: most of the library needs neither the store nor xarray.
    if name == "open_run":
        from worldpose.store.store import open_run

        return open_run
    raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
