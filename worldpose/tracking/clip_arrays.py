"""Arrays of a clip that are read a stretch of frames at a time."""

from __future__ import annotations

from typing import Any, Protocol

from numpy.typing import NDArray


class ClipArray(Protocol):
    """What slices like an array along frames, its first dimension; NumPy's arrays do."""

    @property
    def shape(self) -> tuple[int, ...]:
        """Frames first."""

    def __getitem__(self, frames: slice, /) -> NDArray[Any]:
        """The values of a stretch of frames."""
