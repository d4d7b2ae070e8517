"""Arrays too long for memory, written to disk in chunks of frames."""

from __future__ import annotations

import shutil
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from worldpose.store.store import Store


class Spool:
    """Arrays by name in a scratch folder, extended by every added chunk."""

    def __init__(self, folder: Path) -> None:
        self._folder = folder
        self._form: dict[str, tuple[np.dtype[Any], tuple[int, ...]]] = {}

    def add(self, arrays: Mapping[str, NDArray[Any]]) -> None:
        """Append a chunk; frames are the first dimension."""
        for name, values in arrays.items():
            frames = self._form[name][1][0] if name in self._form else 0
            with (self._folder / name).open("ab") as file:
                np.ascontiguousarray(values).tofile(file)
            self._form[name] = (values.dtype, (frames + len(values), *values.shape[1:]))

    def arrays(self) -> dict[str, NDArray[Any]]:
        """Return all added data, read from disk on access."""
        return {
            name: np.memmap(self._folder / name, dtype, "r", shape=shape)
            if np.prod(shape)
            else np.empty(shape, dtype)
            for name, (dtype, shape) in self._form.items()
        }


@contextmanager
def open_spool(store: Store) -> Iterator[Spool]:
    """Yield a temporary spool next to the results in progress, where disk space is sufficient."""
    folder = store.blobs.create_staging()
    try:
        yield Spool(folder)
    finally:
        shutil.rmtree(folder, ignore_errors=True)
