"""Streaming reader for the entries of a long JSON list, with the memory of one entry.

Python objects take up to thirty times the memory of their text; a file of a gigabyte, parsed whole,
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
"""Bytes per read."""
ENTRY_LENGTH: Final = 1 << 20
"""Maximum characters of one entry; a person's keypoints have under a thousand."""

_SPACE: Final = " \t\n\r"
_DECODER: Final = json.JSONDecoder()


class JsonItems:
    """Entries of a JSON file: of its list, or of the list under a key of its mapping.

    Iterate once. NaN and Infinity are valid.

    Attributes:
        is_mapping: whether the file is a mapping; set when iteration begins.
        other: value in place of the list, None if there is no value or the list.
        has_list: whether the file has the list; set when iteration ends.
    """

    def __init__(self, path: Path, key: str, limit: int) -> None:
        """Prepare reading.

        Args:
            path: the file.
            key: of the list if the file is a mapping.
            limit: maximum size of the file [byte].

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
        """Yield the entries.

        Raises:
            InputError: the file is unreadable, is not JSON, or has an entry that is too long.
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
        except ValueError as error:  # a number with more digits than Python converts
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
    """Buffered text of a file, at most one entry and one chunk at a time."""

    def __init__(self, file: IO[bytes]) -> None:
        self._file = file
        self._decode = codecs.getincrementaldecoder("utf-8-sig")().decode
        self._buffer, self._place, self._before = "", 0, 0
        self._is_whole = False

    def ahead(self) -> str:
        """Return the next character that is no space; empty at the end."""
        while True:
            while self._place < len(self._buffer):
                if self._buffer[self._place] not in _SPACE:
                    return self._buffer[self._place]
                self._place += 1
            if self._is_whole:
                return ""
            self._fill()

    def take(self, wanted: str) -> None:
        """Consume a required character."""
        if self.ahead() != wanted:
            raise self.error(f"Expecting {wanted!r}")
        self._place += 1

    def value(self) -> Any:  # noqa: ANN401
        """Return the next value."""
        self.ahead()
        while True:
            try:
                value, end = _DECODER.raw_decode(self._buffer, self._place)
            except json.JSONDecodeError as error:
                if self._is_whole:
                    raise self.error(error.msg, error.pos) from None
            else:
                # A prefix of a number may be a number too.
                if self._is_whole or self._buffer[end : end + 1] in (*_SPACE, *",:]}"):
                    self._place = end
                    return value
            if len(self._buffer) - self._place > ENTRY_LENGTH:
                raise self.error(f"an entry that is wrong or longer than {ENTRY_LENGTH} characters")
            self._fill()

    def error(self, message: str, place: int | None = None) -> json.JSONDecodeError:
        """Return the error with its position in the file."""
        error = json.JSONDecodeError(message, self._buffer, self._place if place is None else place)
        error.pos += self._before
        return error

    def _fill(self) -> None:
        data = self._file.read(CHUNK)
        self._is_whole = not data
        self._before += self._place
        self._buffer = self._buffer[self._place :] + self._decode(data, not data)
        self._place = 0
