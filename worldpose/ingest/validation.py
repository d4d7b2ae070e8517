"""Validation of plain data as records, and of files that a match folder names.

Invalid data raises `InputError` with file and key.
"""

from __future__ import annotations

import json
import unicodedata
from collections.abc import Collection, Iterator
from contextlib import contextmanager
from difflib import get_close_matches
from pathlib import Path, PurePosixPath, PureWindowsPath
from typing import Any, TypeVar, get_args

from pydantic import ValidationError
from pydantic_core import ErrorDetails

from data_contracts.records import Record
from worldpose.errors import InputError, describe_value, say_failure

R = TypeVar("R", bound=Record)


def validate_record(model: type[R], data: object, file: str) -> R:
    """Return the record in `data` as a YAML or JSON reader of `file` returns it, unconverted.

    InputError for an invalid value, or an unknown or missing key; a misspelt key takes precedence
    over the key that is missing because of it.
    """
    try:
        text = json.dumps(data)
    except (TypeError, ValueError) as error:
        expected = "mappings, lists, text and numbers"
        raise InputError(file, expected, say_failure(error), "Write plain values.") from error
    try:
        # Through JSON, so that strict rules hold (no "25" for 25) yet a list is a tuple.
        return model.model_validate_json(text, strict=True)
    except ValidationError as error:
        causes = _causes(error)
    raise _input_error(model, causes[0], file, len(causes) - 1)


def list_problems(model: type[Record], data: object, file: str) -> list[InputError]:
    """Return every error in JSON data, the first one as `validate_record` raises it."""
    try:
        model.model_validate_json(json.dumps(data), strict=True)
    except ValidationError as error:
        return [_input_error(model, cause, file, 0) for cause in _causes(error)]
    return []


def _causes(error: ValidationError) -> list[ErrorDetails]:
    """Return the deepest errors, misspelt keys first: a failed entry leaves its list too short."""
    details = error.errors(include_url=False)
    within = {detail["loc"][:n] for detail in details for n in range(len(detail["loc"]))}
    details = [detail for detail in details if detail["loc"] not in within]
    return sorted(details, key=lambda detail: detail["type"] != "extra_forbidden")


def _input_error(model: type[Record], detail: ErrorDetails, file: str, others: int) -> InputError:
    kind, value, context = detail["type"], detail["input"], detail.get("ctx", {})
    place = _place(detail["loc"])
    expected = detail["msg"].removeprefix("Input should be ")
    found, todo = describe_value(value), "Correct this value."
    name_rule = "up to 64 letters, digits and . _ - with a letter or digit first"
    if kind == "extra_forbidden":
        key = str(detail["loc"][-1])
        known = _known_keys(model, detail["loc"][:-1])
        close = get_close_matches(key, known, n=1)
        expected, found = f"one of the keys {', '.join(known)}", f"the unknown key {key!r}"
        todo = f"Did you mean {close[0]!r}?" if close else "Remove it."
    elif kind == "model_type":
        expected = "a mapping"
    elif kind == "missing":
        expected, found, todo = "a value", "nothing", "Add this key."
    elif kind == "string_pattern_mismatch":
        expected, todo = name_rule, "Rename it."
    elif kind == "string_type" and isinstance(value, bool):
        found = f"{value}: YAML reads no, off, yes, on, true and false as truth values"
        word = "yes" if value else "no"
        todo = f"Put the word that you wrote in quotes, as in {detail['loc'][-1]}: '{word}'."
    elif kind == "string_type" and isinstance(value, int | float):
        todo = f"Put it in quotes: '{value}'."
    elif kind in ("too_short", "too_long"):
        bound = context.get("min_length", context.get("max_length"))
        expected = f"{'at least' if kind == 'too_short' else 'at most'} {bound} entries"
        found, todo = f"{context.get('actual_length')}", "Correct this list."
    elif kind == "value_error":
        expected, found = "entries that agree", str(context.get("error"))
        todo = "Correct the entries that are named."
    elif place.endswith("frame_count") and kind == "less_than_equal":
        todo = "Cut a longer recording into several clips."
    elif place == "contract":
        todo = "Use the version of worldpose that this file was written for."
    if others:
        todo += f" ({others} more to correct in this file.)"
    return InputError(f"{file}: {place}" if place else file, expected, found, todo)


def _place(loc: tuple[int | str, ...]) -> str:
    """Return a location in the notation `cameras[2].kind`."""
    return "".join(
        f"[{part}]" if isinstance(part, int) else f".{part}" for part in loc
    ).removeprefix(".")


def _known_keys(model: type[Record], loc: tuple[int | str, ...]) -> list[str]:
    """Return the keys of the record at `loc` inside `model`."""
    kind: Any = model
    for part in loc:
        if isinstance(kind, type) and issubclass(kind, Record):
            kind = kind.model_fields[str(part)].annotation
        else:  # tuple[Record, ...] or dict[Name, Record]
            kind = get_args(kind)[1 if isinstance(part, str) else 0]
    return list(kind.model_fields)


def require_local(name: str, where: str) -> None:
    """Raise InputError for a name that is no path in the match folder: absolute, empty, with .."""
    posix, windows = PurePosixPath(name), PureWindowsPath(name)
    if not posix.parts or posix.is_absolute() or windows.anchor or ".." in posix.parts:
        todo = "Move or copy the file into the match folder and name it from there."
        raise InputError(where, "a path inside the match folder, without ..", repr(name), todo)


@contextmanager
def reachable(folder: Path) -> Iterator[None]:
    """Convert OSError in a block that reads a match folder, or a file in it, to InputError."""
    try:
        yield
    except OSError as error:
        expected = "a match folder that this user can read"
        todo = "Mount its disk, or give this user permission to read it."
        raise InputError(
            str(error.filename or folder), expected, say_failure(error), todo
        ) from error


def find_file(folder: Path, name: str) -> Path:
    """Return the path of a folder's file, which need not exist; `same_name` compares its name."""
    path = folder
    for part in PurePosixPath(name).parts:
        if not (path / part).exists() and path.is_dir():
            same = [each for each in path.iterdir() if same_name(each.name) == same_name(part)]
            part = same[0].name if len(same) == 1 else part
        path = path / part
    return path


def same_name(name: str) -> str:
    """Return the form to compare file names in: cameras write capitals, macOS splits accents."""
    composed = PurePosixPath(unicodedata.normalize("NFC", name))
    return composed.stem + composed.suffix.lower()


def existing_file(folder: Path, name: str, where: str, *, folders: bool = False) -> Path:
    """Return the path of an existing file, or of `folders` that are not empty, in the match folder.

    InputError, with `where` its name is from, if it is absent or outside.
    """
    require_local(name, where)
    try:
        path = find_file(folder, name)
        there = path.is_file() or (folders and path.is_dir() and any(path.iterdir()))
        inside = path.resolve().is_relative_to(folder.resolve())
    except PermissionError as error:
        expected = "a file that this user can read"
        todo = "Give this user permission to read it."
        raise InputError(where, expected, f"{name!r}: {error.strerror}", todo) from error
    except (OSError, RuntimeError, ValueError):  # a loop of links, a NUL in the name
        there = False
    if not there:
        expected = "a file, or a folder of images" if folders else "a file"
        raise InputError(where, expected, f"no {name!r}", "Put it there, or correct the name.")
    if not inside:
        expected = "a file inside the match folder"
        todo = "Copy the file into the match folder."
        raise InputError(where, expected, f"{name!r}, a link that leads out of it", todo)
    return path


def files_by_unit(
    folder: Path,
    place: str,
    suffixes: Collection[str],
    known: Collection[str],
    units: str,
    *,
    alone: bool = False,
) -> dict[str, Path]:
    """Return the files of a subfolder `place`, which need not exist, by unit, without hidden ones.

    `suffixes` are in small letters; files with others are ignored, or refused if `alone`.
    InputError, which calls the `known` ones `units`, if a file belongs to none or leads out of the
    match folder, or two belong to one.
    """
    found: dict[str, Path] = {}
    for file in sorted((folder / place).glob("[!.]*")):
        is_of_kind = file.suffix.lower() in suffixes
        if not is_of_kind and not alone:
            continue
        if not is_of_kind or file.stem not in known:
            expected = f"{units}: {', '.join(known) or '(none)'}"
            todo = "Rename or remove the file, or correct match.yaml."
            raise InputError(str(file), expected, repr(file.name), todo)
        if file.stem in found:
            expected = f"one file for {file.stem}"
            todo = "Remove one of them."
            raise InputError(str(file), expected, f"{found[file.stem].name} and {file.name}", todo)
        found[file.stem] = existing_file(folder, f"{place}/{file.name}", str(folder))
    return found
