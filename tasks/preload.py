"""What a Dask worker does around its work, for runs that start workers of their own.

Named first of what workers import when they start: until they have, no garbage is collected, which
takes a fifth of those seconds.
"""

from __future__ import annotations

import gc

from distributed import Worker

gc.disable()


def dask_setup(worker: Worker) -> None:
    """Collect garbage again, but for the modules that are imported by now."""
    gc.freeze()
    gc.enable()


def dask_teardown(worker: Worker) -> None:
    """Leave all there is to the end of the process: freeing it piece by piece takes a second."""
    gc.freeze()
