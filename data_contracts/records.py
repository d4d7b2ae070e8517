"""The base of every record that crosses a stage border or reaches disk."""

from __future__ import annotations

from typing import Annotated, Final, Literal

from pydantic import BaseModel, ConfigDict, StringConstraints

CONTRACT_VERSION: Final[Literal[1]] = 1
"""Version of all contracts in this package; readers refuse any other (docs/conventions.md)."""

Name = Annotated[str, StringConstraints(pattern=r"^[A-Za-z0-9][A-Za-z0-9._-]{0,63}$")]
"""An id that is safe as a file and object name: cameras, clips, matches, units."""

Digest = Annotated[str, StringConstraints(pattern=r"^[0-9a-f]{64}$")]
"""SHA-256 in lower-case hexadecimal."""

Key = Annotated[str, StringConstraints(pattern=r"^[0-9a-f]{32}$")]
"""Name of a result: the first 128 bits of its recipe's SHA-256."""


class Record(BaseModel):
    """A frozen record that refuses unknown keys, NaN and infinity."""

    model_config = ConfigDict(
        frozen=True, extra="forbid", allow_inf_nan=False, use_attribute_docstrings=True
    )
