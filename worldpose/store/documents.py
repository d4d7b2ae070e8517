"""Canonical JSON and its digest, and sealed records: documents with their own checksum.

Equal values have equal canonical bytes, so they have equal digests. A sealed document is one line
of canonical JSON whose field `checksum` is the digest of the rest; `unseal` refuses any other
bytes, even a changed space. Files of results are verified against their manifest.
"""

from __future__ import annotations

import hashlib
import json
import re
from collections.abc import Iterable
from typing import Any, Final, TypeVar

from pydantic import ValidationError

from data_contracts.records import CONTRACT_VERSION, Record
from data_contracts.run import StoredFile
from worldpose.errors import CorruptionError, InputError
from worldpose.store.blobs import Blobs
from worldpose.store.paths import ResultId

_CONTAINERS: Final = (dict, list, tuple)


def canonical_json(value: object) -> bytes:
    """Return the JSON of `value`, sorted and in UTF-8; InputError if it has no exact JSON form."""
    try:
        text = json.dumps(
            value, sort_keys=True, separators=(",", ":"), ensure_ascii=False, allow_nan=False
        )
        _refuse_other_keys(value)
        return text.encode("utf-8")
    except (TypeError, ValueError, RecursionError) as error:
        raise InputError(
            "a value to be stored or hashed",
            expected=(
                "plain JSON: text, finite numbers, true, false, null, lists, and maps with keys of "
                "text"
            ),
            found=str(error),
            todo="Replace missing numbers by null and arrays by lists.",
        ) from error


def _refuse_other_keys(value: object) -> None:
    # json.dumps silently turns a key 1 into "1", and two values would share a digest. It has
    # already refused a value that contains itself, so this recursion ends.
    containers = [value] if isinstance(value, _CONTAINERS) else []
    for container in containers:
        inner: Iterable[object] = container
        if isinstance(container, dict):
            for key in container:
                if not isinstance(key, str):
                    raise TypeError(f"the key {key!r} of type {type(key).__name__}")
            inner = container.values()
        containers += [each for each in inner if isinstance(each, _CONTAINERS)]


def digest(data: bytes | memoryview) -> str:
    """Return the SHA-256 of `data` in lower-case hexadecimal."""
    return hashlib.sha256(data).hexdigest()


R = TypeVar("R", bound=Record)

_SEAL: Final = re.compile(rb'\{"checksum":"([0-9a-f]{64})",')
"""Start of a document with no key before `checksum`."""


def record_checksum(record: Record) -> str:
    """Return the digest that seals `record`: of all its fields but `checksum`."""
    return digest(canonical_json(_dump_fields(record)))


def seal(record: Record) -> bytes:
    """Return the document of `record`."""
    fields = _dump_fields(record)
    return canonical_json({**fields, "checksum": digest(canonical_json(fields))}) + b"\n"


def unseal(kind: type[R], data: bytes, where: str) -> R:
    """Return the record in `data`; CorruptionError if damaged, InputError of another version."""
    content = _content_after_seal(data)
    if content is not None:
        try:
            return kind.model_validate_json(data if "checksum" in kind.model_fields else content)
        except ValidationError:
            pass  # the checks below report the reason
    try:
        fields = json.loads(data)
        checksum = fields.pop("checksum")
        is_intact = digest(canonical_json(fields)) == checksum
        is_intact = is_intact and canonical_json({**fields, "checksum": checksum}) + b"\n" == data
    except (ValueError, TypeError, KeyError, AttributeError, RecursionError, InputError) as error:
        raise CorruptionError(
            f"{where} is damaged: it is not a sealed document ({error})"
        ) from error
    if not is_intact:
        raise CorruptionError(f"{where} is damaged: its checksum does not match its content")
    if fields.get("contract", CONTRACT_VERSION) != CONTRACT_VERSION:
        raise InputError(
            where,
            expected=f"contract {CONTRACT_VERSION}",
            found=f"contract {fields['contract']}",
            todo="Use the worldpose version that wrote it.",
        )
    if "checksum" in kind.model_fields:
        fields["checksum"] = checksum
    # pydantic's error types of records with other fields, and what they found.
    other_fields = {"extra_forbidden": "the unknown field", "missing": "no field"}
    try:
        return kind.model_validate_json(json.dumps(fields))
    except ValidationError as error:
        found = {
            f"{other_fields[each['type']]} {'.'.join(map(str, each['loc']))}"
            for each in error.errors()
            if each["type"] in other_fields
        }
        if len(found) == error.error_count():
            raise InputError(
                where,
                expected=f"the fields of {kind.__name__} in this version of worldpose",
                found=f"{', '.join(sorted(found))}: another version of worldpose wrote it",
                todo="Use that version, or run the match again in a new project: worldpose run "
                "FOLDER --project NEW.",
            ) from error
        raise CorruptionError(f"{where} is not a valid {kind.__name__}: {error}") from error


def read_checksum(data: bytes) -> str:
    """Return the checksum in the document `data`, which `unseal` has accepted."""
    found = _SEAL.match(data)
    return str(json.loads(data)["checksum"]) if found is None else found[1].decode()


def _content_after_seal(data: bytes) -> bytes | None:
    """Return the content of a document that begins with its checksum; None for any other.

    The function cuts the checksum out of the text; the remaining bytes must be those from which
    `seal` computed it. Parsing the JSON and writing it again would take ten times as long.
    """
    found = _SEAL.match(data)
    if found is None or not data.endswith(b"}\n"):
        return None
    content = b"{" + data[found.end() : -1]
    return content if digest(content) == found[1].decode() else None


def _dump_fields(record: Record) -> dict[str, Any]:
    return record.model_dump(mode="json", exclude={"checksum"})


def read_published(blobs: Blobs, result: ResultId, file: StoredFile) -> bytes:
    """Return the bytes of one file; CorruptionError unless they are the published ones."""
    path = f"{result.path}/{file.path}"
    data = blobs.read(path)
    there = None if data is None else (len(data), digest(data))
    _require_published(blobs, path, file, there)
    assert data is not None
    return data


def _require_published(
    blobs: Blobs, path: str, file: StoredFile, there: tuple[int, str] | None
) -> None:
    """Raise CorruptionError unless size and SHA-256 of the bytes there are the published ones."""
    if there is None:
        raise corruption_error(blobs, path, "the file is missing")
    size, sha256 = there
    if size != file.size:
        raise corruption_error(blobs, path, f"the file has {size} bytes, not {file.size}")
    if sha256 != file.sha256:
        raise corruption_error(blobs, path, "its SHA-256 differs from the one in the manifest")


def verify_published(blobs: Blobs, result: ResultId, file: StoredFile) -> None:
    """Verify as `read_published` the bytes of one file, without holding them in memory."""
    path = f"{result.path}/{file.path}"
    _require_published(blobs, path, file, blobs.digest(path))


def corruption_error(blobs: Blobs, path: str, found: str) -> CorruptionError:
    """Return the error of a published file that is not as it was."""
    return CorruptionError(
        f"{blobs.url}/{path} has changed since its publication: {found}.",
        "Run `worldpose verify --repair` to find and repair all damage.",
    )
