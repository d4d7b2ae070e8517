"""The entries of a long JSON list one by one: memory is that of one entry, whatever the file holds.

Python's objects take up to thirty times the room of their text; a file of a gigabyte, parsed whole,
would end the process.
"""

from __future__ import annotations

import codecs
import json
from collections.abc import Iterator
from pathlib import Path
from typing import IO, Any, Final

from worldpose.errors import InputError
from worldpose.ingest.text_files import require_file

CHUNK: Final = 1 << 20
"""Bytes that are read at a time."""
ENTRY_LENGTH: Final = 1 << 20
"""Characters that one entry may have; a person's keypoints have under a thousand."""

_SPACE: Final = " \t\n\r"
_DECODER: Final = json.JSONDecoder()


class JsonItems:
    """The entries of a JSON file: of its list, or of the list under a key of its mapping.

    Iterate once. NaN and Infinity are let through.

    Attributes:
        is_mapping: whether the file is a mapping; known once iteration has begun.
        other: what is there in place of the list, None where there is nothing or the list.
        has_list: whether a list was there; known when iteration has ended.
    """

    def __init__(self, path: Path, key: str, limit: int) -> None:
        """Prepare reading.

        Args:
            path: the file.
            key: of the list where the file is a mapping.
            limit: most bytes that the file may have.

        Raises:
            InputError: no such file, or too large.
        """
        size = require_file(path)
        if size > limit:
            raise InputError(
                str(path),
                expected=f"at most {limit} bytes",
                found=f"{size} bytes",
                todo="Check that it is the file that is meant.",
            )
        self.path, self.key = path, key
        self.is_mapping = False
        self.has_list = False
        self.other: Any = None

    def __iter__(self) -> Iterator[Any]:
        """The entries.

        Raises:
            InputError: the file cannot be read, is not JSON, or has an entry that is too long.
        """
        try:
            with self.path.open("rb") as file:
                yield from self._entries(_Text(file))
        except RecursionError as error:
            raise self._wrong("nesting without end") from error
        except json.JSONDecodeError as error:
            raise self._wrong(f"{error.msg} (character {error.pos})") from error
        except UnicodeDecodeError as error:
            raise InputError(
                str(self.path), expected="UTF-8 text", found=str(error), todo="Save it as UTF-8."
            ) from error
        except ValueError as error:  # a number of more digits than Python converts
            raise self._wrong(str(error)) from error
        except OSError as error:
            raise self._wrong(str(error)) from error

    def _entries(self, text: _Text) -> Iterator[Any]:
        if text.ahead() == "[":
            self.has_list = True
            yield from _listed(text)
        elif text.ahead() == "{":
            self.is_mapping = True
            yield from self._mapped(text)
        else:
            self.other = text.value()
        if text.ahead():
            raise text.error("Extra data")

    def _mapped(self, text: _Text) -> Iterator[Any]:
        text.take("{")
        while text.ahead() != "}":
            name = text.value() if text.ahead() == '"' else None
            if name is None:
                raise text.error("Expecting property name enclosed in double quotes")
            text.take(":")
            if name != self.key:
                _skip(text)
            elif self.has_list or self.other is not None:
                raise text.error(f"{self.key!r} is given twice")
            elif text.ahead() == "[":
                self.has_list = True
                yield from _listed(text)
            else:
                self.other = text.value()
            if text.ahead() != "}":
                text.take(",")
                if text.ahead() == "}":
                    raise text.error("Illegal trailing comma before end of object")
        text.take("}")

    def _wrong(self, found: str) -> InputError:
        todo = "Correct the place that is named."
        return InputError(str(self.path), expected="JSON", found=found, todo=todo)


def _listed(text: _Text) -> Iterator[Any]:
    text.take("[")
    while text.ahead() != "]":
        yield text.value()
        if text.ahead() != "]":
            text.take(",")
            if text.ahead() == "]":
                raise text.error("Illegal trailing comma before end of array")
    text.take("]")


def _skip(text: _Text) -> None:
    if text.ahead() == "[":
        for _ in _listed(text):
            pass
    else:
        text.value()


class _Text:
    """A file's text, of which no more is held than the entry that is read."""

    def __init__(self, file: IO[bytes]) -> None:
        self._file = file
        self._decode = codecs.getincrementaldecoder("utf-8-sig")().decode
        self._buffer, self._place, self._before = "", 0, 0
        self._is_whole = False

    def ahead(self) -> str:
        """The next character that is no space; empty at the end."""
        while True:
            while self._place < len(self._buffer):
                if self._buffer[self._place] not in _SPACE:
                    return self._buffer[self._place]
                self._place += 1
            if self._is_whole:
                return ""
            self._fill()

    def take(self, wanted: str) -> None:
        """Go past a character that has to be there."""
        if self.ahead() != wanted:
            raise self.error(f"Expecting {wanted!r}")
        self._place += 1

    def value(self) -> Any:  # noqa: ANN401
        """The next value."""
        self.ahead()
        while True:
            try:
                value, end = _DECODER.raw_decode(self._buffer, self._place)
            except json.JSONDecodeError as error:
                if self._is_whole:
                    raise self.error(error.msg, error.pos) from None
            else:
                # Of a number, a part may be one too.
                if self._is_whole or self._buffer[end : end + 1] in (*_SPACE, *",:]}"):
                    self._place = end
                    return value
            if len(self._buffer) - self._place > ENTRY_LENGTH:
                raise self.error(f"an entry that is wrong or longer than {ENTRY_LENGTH} characters")
            self._fill()

    def error(self, message: str, place: int | None = None) -> json.JSONDecodeError:
        """What is wrong, and at which character of the file."""
        error = json.JSONDecodeError(message, self._buffer, self._place if place is None else place)
        error.pos += self._before
        return error

    def _fill(self) -> None:
        data = self._file.read(CHUNK)
        self._is_whole = not data
        self._before += self._place
        self._buffer = self._buffer[self._place :] + self._decode(data, not data)
        self._place = 0
