"""Arrays of a clip that are read in chunks of frames."""

from __future__ import annotations

from typing import Any, Protocol

from numpy.typing import NDArray


class ClipArray(Protocol):
    """An array that can be sliced along frames, its first dimension; NumPy's arrays can."""

    @property
    def shape(self) -> tuple[int, ...]:
        """Shape, with frames first."""

    def __getitem__(self, frames: slice, /) -> NDArray[Any]:
        """Return the values of a chunk of frames."""
