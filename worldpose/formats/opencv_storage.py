"""Reader of OpenCV's FileStorage in XML, YAML and JSON, without OpenCV's parser.

That parser ends the process at deep nesting, which the readers of `worldpose.formats.files` refuse.
"""

from __future__ import annotations

import base64
import re
from collections.abc import Sequence
from pathlib import Path
from typing import Any, Final
from xml.etree.ElementTree import Element

import numpy as np
from numpy.typing import NDArray

from worldpose.errors import say_failure
from worldpose.formats.calibration_files import calibration_error
from worldpose.formats.files import SETTINGS_BYTES, parse_json, parse_xml, parse_yaml, read_text

_QUOTE: Final = "\ue000"
_TOKEN: Final = re.compile(r'"[^"]*"|[^\s"]+')


def is_storage(file: Path) -> bool:
    """Return whether a YAML or JSON file is one of OpenCV's FileStorage."""
    return "opencv-matrix" in read_text(file, SETTINGS_BYTES)


def read_file_storage(file: Path) -> dict[str, Any]:
    """Return matrices, numbers and lists of text of OpenCV's FileStorage by name; or InputError."""
    where, text = str(file), read_text(file, SETTINGS_BYTES)
    begin = text.lstrip()[:1]
    words = {"Nan": "NaN", "Inf": "Infinity"}
    expected = "a file of OpenCV's FileStorage"
    if begin == "<":
        try:
            # OpenCV writes a quote within quotes so; read as one, it would end them.
            root = parse_xml(text.replace("&quot;", _QUOTE).encode())
        except ValueError as error:
            raise calibration_error(where, expected, say_failure(error)) from error
        content: Any = {each.tag: _read_element(each) for each in root}
    elif begin == "{":
        text = re.sub(r"(?<=\d\.)(?=[\s,\]}])", "0", text)  # OpenCV writes 1. and .Nan
        content = parse_json(where, re.sub(r"\.(Nan|Inf)\b", lambda it: words[it[1]], text))
    else:
        content = parse_yaml(where, text.replace("!!opencv-", "!!map #"))
    if not isinstance(content, dict):
        raise calibration_error(where, expected, type(content).__name__)
    found = {str(name): _read_value(f"{where}: {name}", each) for name, each in content.items()}
    found = {name: value for name, value in found.items() if value is not None}
    if not found:
        raise calibration_error(where, "matrices of OpenCV's FileStorage", "none")
    return found


def _read_element(element: Element) -> Any:  # noqa: ANN401
    """Return an XML element as JSON has it: a mapping, a list, a number or text."""
    if element.get("type_id") == "binary":
        return base64.b64decode(element.text or "")
    children = list(element)
    if any(child.tag != "_" for child in children):
        return {child.tag: _read_element(child) for child in children}
    if children:
        return [_read_element(child) for child in children]
    text = (element.text or "").strip()
    parts = [_scalar(token) for token in _TOKEN.findall(text)]
    is_text = '"' not in text and all(isinstance(part, str) for part in parts)
    return text if is_text else parts[0] if len(parts) == 1 else parts


def _scalar(token: str) -> float | str:
    if token.startswith('"'):
        return token[1:-1].replace(_QUOTE, '"')
    try:
        return _number(token)
    except ValueError:
        return token


def _number(value: Any) -> float:  # noqa: ANN401
    """Return a number; YAML leaves those without a point or a sign of the exponent as text."""
    text = value.replace(".Nan", "nan").replace(".Inf", "inf") if isinstance(value, str) else value
    return float(text)


def _read_value(where: str, value: Any) -> Any:  # noqa: ANN401
    """Return a matrix, number, text or list of texts; None for another mapping."""
    if isinstance(value, dict):
        return _read_matrix(where, value) if "data" in value else None
    plain = str | int | float
    if isinstance(value, list):
        given = [each for each in value if isinstance(each, plain)]
        return [each if isinstance(each, str) else f"{each:g}" for each in given]
    is_number = not isinstance(value, str) or re.fullmatch(r"[-+]?\d+[eE][-+]?\d+", value)
    return float(value) if is_number and isinstance(value, plain) else value


def _read_matrix(where: str, table: dict[str, Any]) -> NDArray[np.float64]:
    """Return a matrix (rows, columns), or (rows, columns, channels), or one of more dimensions."""
    types = {"u": "<u1", "c": "<i1", "w": "<u2", "s": "<i2", "i": "<i4", "f": "<f4", "d": "<f8"}
    header_bytes = 24  # before base64 data, which repeats the type [byte]
    try:
        kind = re.fullmatch(r"(\d{0,3})([ucwsifd])", str(table.get("dt", "d")))  # ROS has none
        if kind is None:
            raise ValueError(f"the type {table['dt']!r:.20}")
        sizes = table["sizes"] if "sizes" in table else [table["rows"], table["cols"]]
        shape = [int(_number(each)) for each in sizes]
        if min(shape, default=0) < 0:
            raise ValueError(f"the sizes {shape}")
        shape += [int(kind[1])] if kind[1] not in ("", "1") else []
        data = table["data"]
        if isinstance(data, str) and data.startswith("$base64$"):
            data = base64.b64decode(data.removeprefix("$base64$"))
        if isinstance(data, bytes):
            numbers = np.frombuffer(data[header_bytes:], types[kind[2]]).astype(np.float64)
        else:
            items = data if isinstance(data, Sequence) and not isinstance(data, str) else [data]
            numbers = np.array([_number(each) for each in items], np.float64)
        return numbers.reshape(shape)
    except (KeyError, TypeError, ValueError, OverflowError) as error:
        expected = "a matrix: rows, cols, dt and data"
        raise calibration_error(where, expected, say_failure(error)) from error
