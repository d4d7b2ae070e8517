"""Rows of records of arrays: selection and concatenation."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import fields
from typing import Any, TypeVar, cast

import numpy as np
from numpy.typing import NDArray

from data_contracts.arrays import Flags

Record = TypeVar("Record")
Index = NDArray[np.integer] | Flags | slice


def take_rows(record: Record, index: Index, *shared: str) -> Record:
    """Return a record of arrays (n, ...) with some of their rows; `shared` fields stay."""
    return type(record)(
        *(
            getattr(record, name) if name in shared else getattr(record, name)[index]
            for name in _names(record)
        )
    )


def join_rows(parts: Sequence[Record], *shared: str) -> Record:
    """Return one record with the arrays of some, one after another, and their `shared` fields."""
    return type(parts[0])(
        *(
            getattr(parts[0], name)
            if name in shared
            else np.concatenate([getattr(part, name) for part in parts])
            for name in _names(parts[0])
        )
    )


def _names(record: object) -> Sequence[str]:
    named = getattr(record, "_fields", None)
    return named or [field.name for field in fields(cast(Any, record))]
