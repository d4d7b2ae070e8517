"""frame_rates.json: frames a second of the clips of an export, which no other of its files says."""

from __future__ import annotations

import json
from collections.abc import Mapping
from pathlib import Path
from typing import Final

from pydantic import PositiveFloat, TypeAdapter, ValidationError

from worldpose.errors import InputError
from worldpose.release.files import whole_file

FRAME_RATES: Final = "frame_rates.json"
_RATES = TypeAdapter(dict[str, PositiveFloat])


def write_frame_rates(folder: Path, rates: Mapping[str, float]) -> Path:
    """Add clips' frames a second [1/s] to those that the folder says already; returns the file.

    Raises:
        InputError: what is there is no such file.
    """
    known = {**read_frame_rates(folder), **rates}
    with whole_file(folder / FRAME_RATES) as draft:
        draft.write_text(json.dumps(known, indent=2, sort_keys=True) + "\n", encoding="utf-8")
    return folder / FRAME_RATES


def read_frame_rates(folder: Path) -> dict[str, float]:
    """Frames a second [1/s] by clip; empty where the folder does not say.

    Raises:
        InputError: the file is not clips and numbers.
    """
    path = folder / FRAME_RATES
    if not path.is_file():
        return {}
    try:
        return _RATES.validate_json(path.read_bytes())
    except ValidationError as error:
        raise InputError(
            str(path),
            expected="clips and their frames a second",
            found=str(error.errors()[0]["msg"]),
            todo="Export the data set again.",
        ) from error


def frame_rate_of(rates: Mapping[str, float], clip: str) -> float | None:
    """Frames a second of a clip; one that no file names (`joints.npz`) has the rate of all."""
    if clip in rates:
        return rates[clip]
    return next(iter(rates.values())) if len(set(rates.values())) == 1 else None
