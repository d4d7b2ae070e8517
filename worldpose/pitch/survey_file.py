"""Reader of a survey: a CSV file of named points."""

from __future__ import annotations

import csv
import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from difflib import get_close_matches
from pathlib import Path
from typing import Final

import numpy as np
from numpy.typing import NDArray

from worldpose.errors import InputError
from worldpose.pitch.laws import law_lines, law_points

SURVEY_BYTES: Final = 1 << 20
"""Largest size of a survey [byte]; all named points take 3 kB."""

COLUMNS: Final[Mapping[str, str]] = {
    "x": "x",
    "y": "y",
    "z": "z",
    "easting": "x",
    "northing": "y",
    "height": "z",
}
"""Axis of each column; a grid's easting and northing make a right-handed frame whatever their order
in the file."""


@dataclass(frozen=True, eq=False)
class Survey:
    """Surveyed positions of named points, in the surveyor's own frame.

    Attributes:
        where: the file, for messages.
        names: of the pitch template's points, each once.
        places: (n, 3) [m]; z is up, NaN without a height.
    """

    where: str
    names: tuple[str, ...]
    places: NDArray[np.float64]


def read_survey(path: Path) -> Survey:
    """Read the positions in a CSV file with the columns name, x, y and, if heights are known, z.

    A name is a point of the pitch template, or an end of a line as `<line>.start` or `<line>.end`.
    `easting`, `northing` and `height` may replace x, y and z. Separators are commas, semicolons or
    tabs.

    Raises:
        InputError: it names file and row: unreadable, a missing or unknown column, an unknown or
            repeated name, or text that is no number.
    """
    rows = _rows(path)
    if not rows:
        raise _wrong(str(path), "a header and one row for each point", "nothing")
    header = [title.strip().lower() for title in rows[0]]
    axes = [COLUMNS.get(title) for title in header if title != "name"]
    if header.count("name") != 1 or None in axes or sorted(map(str, axes)) not in _AXES:
        raise _wrong(
            f"{path}: row 1",
            "the columns name, x, y and, where there are heights, z (or easting, northing, height)",
            ", ".join(rows[0]),
        )
    ends = line_ends()
    known = [*law_points(105.0, 68.0), *ends]
    places: dict[str, list[float]] = {}
    for number, row in enumerate(rows[1:], start=2):
        where = f"{path}: row {number}"
        if len(row) != len(header):
            raise _wrong(where, f"{len(header)} columns", f"{len(row)}")
        values = {title: text.strip() for title, text in zip(header, row, strict=True)}
        given = values.pop("name")
        if given not in known:
            close = get_close_matches(given, known, n=1)
            todo = f"Did you mean {close[0]!r}?" if close else f"Known: {', '.join(known)}."
            raise _wrong(f"{where}: name", "a point, or an end of a line", repr(given), todo)
        name = ends.get(given, given)
        if name in places:
            raise _wrong(f"{where}: name", "every point once", f"{given!r}, which is {name} again")
        place = {COLUMNS[title]: _number(f"{where}: {title}", title, values) for title in values}
        places[name] = [place["x"], place["y"], place.get("z", math.nan)]
    return Survey(str(path), tuple(places), np.array(list(places.values())).reshape(-1, 3))


def line_ends() -> dict[str, str]:
    """Return the point for every `<line>.start` and `<line>.end`."""
    lines = law_lines()
    starts = {f"{name}.start": line.start for name, line in lines.items()}
    return starts | {f"{name}.end": line.end for name, line in lines.items()}


_AXES: Final[Sequence[list[str]]] = (["x", "y"], ["x", "y", "z"])


def _rows(path: Path) -> list[list[str]]:
    try:
        if not path.is_file():
            raise _wrong(str(path), "a CSV file", "nothing", "Check the path.")
        if path.stat().st_size > SURVEY_BYTES:
            raise _wrong(str(path), f"at most {SURVEY_BYTES} bytes", f"{path.stat().st_size}")
        text = path.read_text(encoding="utf-8-sig")
        first = text.partition("\n")[0]
        separator = max(",;\t", key=first.count)
        return [row for row in csv.reader(text.splitlines(), delimiter=separator) if any(row)]
    except (OSError, ValueError, csv.Error) as error:
        raise _wrong(str(path), "readable UTF-8 text in rows and columns", str(error)) from error


def _number(where: str, title: str, values: Mapping[str, str]) -> float:
    """Return a number; NaN for an empty height."""
    text = values[title]
    if COLUMNS[title] == "z" and not text:
        return math.nan
    try:
        value = float(text)
    except ValueError:
        value = math.nan
    if not math.isfinite(value):
        raise _wrong(where, "a number, with a point as decimal sign", repr(text))
    return value


def _wrong(
    where: str, expected: str, found: str, todo: str = "Correct the survey file."
) -> InputError:
    return InputError(where, expected=expected, found=found, todo=todo)
