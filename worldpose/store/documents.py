"""Sealed records: the JSON documents of a project, each with its own checksum.

A sealed document is one line of canonical JSON whose field `checksum` is the digest of the rest.
Any other bytes, even a changed space, are refused.
"""

from __future__ import annotations

import json
import re
from typing import Any, Final, TypeVar

from pydantic import ValidationError

from data_contracts.records import CONTRACT_VERSION, Record
from worldpose.errors import CorruptionError, InputError
from worldpose.store.canonical import canonical_json, digest

R = TypeVar("R", bound=Record)

_FURTHER = "extra_forbidden"
"""pydantic's error type for an unknown field."""
_SEAL: Final = re.compile(rb'\{"checksum":"([0-9a-f]{64})",')
"""Start of a document with no key before `checksum`."""


def checksum_of(record: Record) -> str:
    """Return the digest that seals `record`: of all its fields but `checksum`."""
    return digest(canonical_json(_fields(record)))


def seal(record: Record) -> bytes:
    """Return the document of `record`."""
    fields = _fields(record)
    return canonical_json({**fields, "checksum": digest(canonical_json(fields))}) + b"\n"


def unseal(kind: type[R], data: bytes, where: str) -> R:
    """Return the record in the document `data`.

    Args:
        kind: the record's class.
        data: the document.
        where: the document's path, for messages.

    Raises:
        CorruptionError: the bytes differ from the sealed ones.
        InputError: an intact document, but of an unsupported contract version, or with fields of a
            later version.
    """
    content = _content_after_seal(data)
    if content is not None:
        try:
            return kind.model_validate_json(data if "checksum" in kind.model_fields else content)
        except ValidationError:
            pass  # the checks below report the reason
    try:
        fields = json.loads(data)
        checksum = fields.pop("checksum")
        whole = digest(canonical_json(fields)) == checksum
        whole = whole and canonical_json({**fields, "checksum": checksum}) + b"\n" == data
    except (ValueError, TypeError, KeyError, AttributeError, RecursionError, InputError) as error:
        raise CorruptionError(f"{where} is damaged: not a sealed document ({error})") from error
    if not whole:
        raise CorruptionError(f"{where} is damaged: its checksum does not fit its content")
    if fields.get("contract", CONTRACT_VERSION) != CONTRACT_VERSION:
        raise InputError(
            where,
            expected=f"contract {CONTRACT_VERSION}",
            found=f"contract {fields['contract']}",
            todo="Use the worldpose version that wrote it.",
        )
    if "checksum" in kind.model_fields:
        fields["checksum"] = checksum
    try:
        return kind.model_validate_json(json.dumps(fields))
    except ValidationError as error:
        further = {str(each["loc"][0]) for each in error.errors() if each["type"] == _FURTHER}
        if len(further) == error.error_count():
            raise InputError(
                where,
                expected=f"a {kind.__name__} as this version of worldpose knows it",
                found=f"{', '.join(sorted(further))} beside, of a later version",
                todo="Use the worldpose version that wrote it, or a later one.",
            ) from error
        raise CorruptionError(f"{where} is not a {kind.__name__}: {error}") from error


def unseal_repairable(kind: type[R], data: bytes, where: str) -> R:
    """Unseal a record that `worldpose verify --repair` can set aside if it is damaged.

    Raises:
        CorruptionError, InputError: see `unseal`; the former says how to repair.
    """
    try:
        return unseal(kind, data, where)
    except CorruptionError as error:
        raise CorruptionError(
            f"{error}. Restore it from a copy, or let `worldpose verify --repair` set it aside."
        ) from error


def read_checksum(data: bytes) -> str:
    """Return the checksum in the document `data`, which `unseal` has accepted."""
    found = _SEAL.match(data)
    return str(json.loads(data)["checksum"]) if found is None else found[1].decode()


def _content_after_seal(data: bytes) -> bytes | None:
    """Return the bytes that the checksum at the start of a document seals.

    Parsing JSON, writing it again and comparing takes ten times as long. Instead the checksum is
    cut out, and the rest must be the bytes from which `seal` computed it.

    Returns:
        None if another key comes before the checksum, or the rest does not match the checksum.
    """
    found = _SEAL.match(data)
    if found is None or not data.endswith(b"}\n"):
        return None
    content = b"{" + data[found.end() : -1]
    return content if digest(content) == found[1].decode() else None


def _fields(record: Record) -> dict[str, Any]:
    return record.model_dump(mode="json", exclude={"checksum"})
