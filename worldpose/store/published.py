"""Files of a published result, verified against its manifest on read."""

from __future__ import annotations

from data_contracts.run import StoredFile
from worldpose.errors import CorruptionError
from worldpose.store.blobs import Blobs
from worldpose.store.canonical import digest
from worldpose.store.paths import ResultId


def read_published(blobs: Blobs, result: ResultId, file: StoredFile) -> bytes:
    """Return the bytes of one file after verifying that they are the published ones.

    Raises:
        CorruptionError: the file is missing or its bytes have changed.
    """
    path = f"{result.path}/{file.path}"
    data = blobs.read(path)
    if data is None:
        found = "it is missing"
    elif len(data) != file.size:
        found = f"it has {len(data)} bytes, not {file.size}"
    elif digest(data) != file.sha256:
        found = "its SHA-256 is another"
    else:
        return data
    raise CorruptionError(
        f"{blobs.url}/{path} is not as published: {found}. Run `worldpose verify` to find all "
        "damage and repair it."
    )
