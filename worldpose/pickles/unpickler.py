"""Python's own unpickler, with notes for names and without imports."""

from __future__ import annotations

import io
import pickle
import struct
from collections.abc import Callable, Mapping
from typing import Any, ClassVar, cast


def no_storage(_: object) -> object:
    """Refuse a persistent id if a file has no storages of its own.

    Raises:
        UnpicklingError: always.
    """
    raise pickle.UnpicklingError("an object kept outside the file")


class Unpickler(pickle._Unpickler):
    """Reads one pickle; a name that is not allowed raises an error.

    It extends the Python implementation, not the C one: that one allocates memory for as many
    memoized objects as a file of a few bytes claims.
    """

    def __init__(
        self,
        stream: io.BytesIO,
        names: Mapping[tuple[str, str], type[Any]],
        storage: Callable[[object], object] = no_storage,
    ) -> None:
        # Python 2 wrote the bytes of arrays as text.
        super().__init__(stream, encoding="latin1")
        self._names, self._storage = names, storage

    def find_class(self, module: str, name: str) -> Any:  # noqa: ANN401, D102
        if (module, name) not in self._names:
            raise pickle.UnpicklingError(f"the name {module}.{name}, which is not allowed")
        return self._names[module, name]

    def persistent_load(self, pid: Any) -> Any:  # noqa: ANN401, D102
        return self._storage(pid)

    def load_build(self) -> None:
        """Pass a state only to notes; on other objects it would set attributes."""
        instance = cast("list[object]", self.stack)[-2]  # type: ignore[attr-defined]
        if not hasattr(instance, "__setstate__") or isinstance(instance, type):
            raise pickle.UnpicklingError("a state for what has none")
        pickle._Unpickler.load_build(self)  # type: ignore[attr-defined]

    def load_bytearray8(self) -> None:
        """Read existing bytes; Python's own version allocates as many as the file claims."""
        (length,) = struct.unpack("<Q", self.read(8))  # type: ignore[attr-defined]
        content = self.read(length) if length < 1 << 62 else b""  # type: ignore[attr-defined]
        if len(content) != length:
            raise pickle.UnpicklingError(f"{len(content)} of {length} bytes")
        self.append(bytearray(content))  # type: ignore[attr-defined]

    dispatch: ClassVar[dict[int, Any]] = {
        **pickle._Unpickler.dispatch,
        pickle.BUILD[0]: load_build,
        pickle.BYTEARRAY8[0]: load_bytearray8,
    }
