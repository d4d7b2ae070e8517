"""Read-only Zarr store of a published result."""

from __future__ import annotations

import asyncio
from collections.abc import AsyncIterator, Iterable

from zarr.abc.store import (
    ByteRequest,
    OffsetByteRequest,
    RangeByteRequest,
    Store,
    SuffixByteRequest,
)
from zarr.core.buffer import Buffer, BufferPrototype

from data_contracts.run import ResultManifest
from worldpose.store.blobs import Blobs
from worldpose.store.paths import ResultId
from worldpose.store.published import read_published


class PublishedFiles(Store):
    """Read-only Zarr store that raises an error for a lost or changed file, never a fill value."""

    supports_writes = False
    supports_deletes = False
    supports_listing = True

    def __init__(self, blobs: Blobs, result: ResultId, manifest: ResultManifest) -> None:
        super().__init__(read_only=True)
        self._blobs, self._result = blobs, result
        self._files = {file.path: file for file in manifest.files}

    def __eq__(self, other: object) -> bool:
        return (
            isinstance(other, PublishedFiles)
            and (self._blobs.url, self._result) == (other._blobs.url, other._result)
            and self._files == other._files
        )

    def __repr__(self) -> str:
        return f"PublishedFiles({self._blobs.url}/{self._result.path})"

    async def get(
        self, key: str, prototype: BufferPrototype, byte_range: ByteRequest | None = None
    ) -> Buffer | None:
        """Return the file `key` or a range of it, None if the result has no such file."""
        file = self._files.get(key)
        if file is None:
            return None
        data = await asyncio.to_thread(read_published, self._blobs, self._result, file)
        match byte_range:
            case RangeByteRequest():
                data = data[byte_range.start : byte_range.end]
            case OffsetByteRequest():
                data = data[byte_range.offset :]
            case SuffixByteRequest():
                data = data[max(0, len(data) - byte_range.suffix) :]
        return prototype.buffer.from_bytes(data)

    async def get_partial_values(
        self,
        prototype: BufferPrototype,
        key_ranges: Iterable[tuple[str, ByteRequest | None]],
    ) -> list[Buffer | None]:
        """Return ranges of several files."""
        return [await self.get(key, prototype, part) for key, part in key_ranges]

    async def exists(self, key: str) -> bool:
        """Return whether the manifest names the file `key`."""
        return key in self._files

    async def set(self, key: str, value: Buffer) -> None:
        """Raise an error: a published result never changes."""
        self._check_writable()

    async def delete(self, key: str) -> None:
        """Raise an error: a published result never changes."""
        self._check_writable()

    async def list(self) -> AsyncIterator[str]:
        """Yield every file."""
        for key in self._files:
            yield key

    async def list_prefix(self, prefix: str) -> AsyncIterator[str]:
        """Yield every file whose path starts with `prefix`."""
        for key in self._files:
            if key.startswith(prefix):
                yield key

    async def list_dir(self, prefix: str) -> AsyncIterator[str]:
        """Yield names of files and folders directly inside the folder `prefix`."""
        base = f"{prefix.rstrip('/')}/" if prefix.strip("/") else ""
        inside = (key[len(base) :] for key in self._files if key.startswith(base))
        for name in dict.fromkeys(key.split("/")[0] for key in inside):
            yield name
