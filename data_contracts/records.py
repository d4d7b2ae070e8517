"""The base of every record that crosses a stage border or reaches disk."""

from __future__ import annotations

import ast
import inspect
import textwrap
from itertools import pairwise
from typing import Annotated, Final, Literal

from pydantic import BaseModel, ConfigDict, Field, StringConstraints

CONTRACT_VERSION: Final[Literal[1]] = 1
"""Version of all contracts in this package; readers refuse any other.

See docs/reference/conventions.md.
"""

Name = Annotated[str, StringConstraints(pattern=r"^[A-Za-z0-9][A-Za-z0-9._-]{0,63}$")]
"""An id that is safe as a file and object name: cameras, clips, matches."""

Label = Annotated[str, StringConstraints(pattern=r"^[^\x00-\x1f\x7f]{1,64}$")]
"""A name that people gave, on one line."""

UnitName = Annotated[str, StringConstraints(pattern=r"^[A-Za-z0-9][A-Za-z0-9._-]{0,128}$")]
"""A unit of a stage: an id, or the ids of a camera and a clip with a dot between them."""

Digest = Annotated[str, StringConstraints(pattern=r"^[0-9a-f]{64}$")]
"""SHA-256 in lower-case hexadecimal."""

Key = Annotated[str, StringConstraints(pattern=r"^[0-9a-f]{32}$")]
"""Name of a result: the first 128 bits of its recipe's SHA-256."""


FRAME_LIMIT: Final = (1 << 31) - 1
"""Largest frame number, as that of many video formats: a year at 60 frames/s."""

Frame = Annotated[int, Field(ge=-FRAME_LIMIT, le=FRAME_LIMIT)]
"""A frame number; negative before match frame 0 [frame]."""

FrameOffset = Annotated[float, Field(ge=-FRAME_LIMIT, le=FRAME_LIMIT)]
"""An offset of two clocks [frame]."""

ImageLength = Annotated[int, Field(gt=0, le=1 << 16)]
"""Width or height of an image; most image libraries read no more [px]."""

FramesPerSecond = Annotated[float, Field(ge=1, le=1000)]
"""Frame rate, from time lapses to high-speed cameras [1/s]."""

PixelCoordinate = Annotated[float, Field(ge=-1e6, le=1e6)]
"""x or y; (0, 0) is the centre of the top-left pixel [px]."""

DetectionIndex = Annotated[int, Field(ge=0, le=100_000)]
"""Index among the detections of a camera in one frame."""

Count = Annotated[int, Field(ge=0, le=1 << 53)]
"""A count; readers of JSON round larger numbers."""

Amount = Annotated[float, Field(ge=0, le=1e15)]
"""A non-negative value, in the unit that the field's docstring names."""

Number = Annotated[float, Field(ge=-1e15, le=1e15)]
"""A signed value, in the unit that the field's docstring names."""

Positive = Annotated[float, Field(ge=1e-9, le=1e6)]
"""A size above 0, in the unit that the field's docstring names."""

Share = Annotated[float, Field(ge=0, le=1)]
"""A share of a whole [0..1]."""

ProcessId = Annotated[int, Field(ge=1, le=1 << 32)]
"""Process id of the operating system."""

PersonId = Annotated[int, Field(ge=0, le=FRAME_LIMIT)]
"""Id of a person's track, unique in its clip."""


class Record(BaseModel):
    """A frozen record that refuses unknown keys, NaN and infinity."""

    model_config = ConfigDict(frozen=True, extra="forbid", allow_inf_nan=False)


def field_docstrings(record: type[BaseModel]) -> dict[str, str]:
    """Return the docstring of each field that has one, by the field's name.

    Pydantic can read them too, but does so while each class is created: parsing the sources of all
    records took every process of a run 0.4 s of CPU time.
    """
    found: dict[str, str] = {}
    for base in reversed(record.__mro__):
        if not issubclass(base, Record):
            continue
        (node,) = ast.parse(textwrap.dedent(inspect.getsource(base))).body
        assert isinstance(node, ast.ClassDef)
        for field, after in pairwise(node.body):
            if (
                isinstance(field, ast.AnnAssign)
                and isinstance(field.target, ast.Name)
                and field.target.id in record.model_fields
                and isinstance(after, ast.Expr)
                and isinstance(after.value, ast.Constant)
                and isinstance(after.value.value, str)
            ):
                found[field.target.id] = inspect.cleandoc(after.value.value)
    return found
