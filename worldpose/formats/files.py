"""Atomic writing of files, and reading of untrusted YAML, JSON and TOML.

Hostile or broken files raise `InputError`. `JsonItems` streams the entries of a long JSON list with
the memory of one entry: Python objects take up to thirty times the memory of their text, so that a
parsed file of a gigabyte would end the process.
"""

from __future__ import annotations

import codecs
import errno
import hashlib
import json
import re
import tempfile
import tomllib
from collections.abc import Callable, Collection, Hashable, Iterator, Mapping
from contextlib import contextmanager
from pathlib import Path
from typing import IO, Any, Final
from xml.etree import ElementTree

import yaml

from worldpose.errors import InputError, say_failure
from worldpose.store.blobs import sync_path

ENTRY_LENGTH = 1 << 20
"""Maximum characters of one entry; a person's keypoints have under a thousand."""

CHUNK = 1 << 20
"""Bytes per read."""

EVENTS = 100_000
"""Maximum keys, values and brackets in a YAML file, two seconds' work; 1000 clips have 10 000."""


def by_last_number(named: Mapping[str, Any]) -> dict[str, Any]:
    """Return entries by the last numbers in their names; in their order if a name has none."""
    numbers = {name: re.findall(r"\d+", name) for name in named}
    key = (lambda name: int(numbers[name][-1])) if all(numbers.values()) else lambda _: 0
    return {name: named[name] for name in sorted(named, key=key)}


_READ = [0]


def bytes_read() -> int:
    """Return a number that grows while any thread of this process is in `sha256_of_file`."""
    return _READ[0]


def sha256_of_file(path: Path) -> str:
    """Return the SHA-256 of a file, or raise OSError; `bytes_read` tells its progress."""
    sha256 = hashlib.sha256()
    with path.open("rb", buffering=0) as file:
        while piece := file.read(CHUNK):
            sha256.update(piece)
            _READ[0] += len(piece)
    return sha256.hexdigest()


@contextmanager
def whole_file(path: Path) -> Iterator[Path]:
    """Yield a draft's path that becomes `path` in one step when the block succeeds.

    The draft is in the same folder and is synced to disk; a block that raises, or a killed process,
    leaves the previous content of `path`.
    """
    path.parent.mkdir(parents=True, exist_ok=True)
    with tempfile.TemporaryDirectory(prefix=f".{path.name}.", dir=path.parent) as workshop:
        # In a subfolder: a temporary folder is private, but the file gets the usual permissions.
        draft = Path(workshop) / path.name
        yield draft
        sync_path(draft)
        draft.replace(path)
    sync_path(path.parent)


FULL: Final = (errno.ENOSPC, errno.EDQUOT, errno.EFBIG, errno.EROFS)
"""Errors of a disk to which nothing more can be written."""

SETTINGS_BYTES: Final = 1 << 21
"""Maximum size of match.yaml, calibration.toml or pitch.json [byte].

A full match has 0.1 MB; 5,000 calibrated cameras, as in the load test, take 2.0 MB.
"""

NESTING: Final = 32
"""Maximum levels of lists and mappings in YAML, of which match.yaml has four, and of elements in
XML, of which annotations and calibrations have five."""


def read_yaml(path: Path) -> Any:  # noqa: ANN401
    """Return the only document of a YAML file, dates as text, without aliases or repeated keys."""
    return parse_yaml(str(path), read_text(path, SETTINGS_BYTES))


def parse_yaml(where: str, text: str) -> Any:  # noqa: ANN401
    """Return the only document of a YAML text, as `read_yaml`; `where` names it in errors."""
    # ROS prints the mark of a next document after each one.
    return _parse(where, "YAML", _load_yaml, re.sub(r"\n---\s*\Z", "\n", text))


def read_json(path: Path, limit: int = SETTINGS_BYTES) -> Any:  # noqa: ANN401
    """Return a JSON file of at most `limit` bytes, including NaN and Infinity; or InputError."""
    return parse_json(str(path), read_text(path, limit))


def parse_json(where: str, text: str) -> Any:  # noqa: ANN401
    """Return the content of a JSON text; `where` names it in errors."""
    return _parse(where, "JSON", json.loads, text)


def read_toml(path: Path) -> dict[str, Any]:
    """Return the tables of a TOML file; InputError if it is none, too large, or has a long line."""
    # Maximum line length of a TOML file; the time for a key of n dotted parts grows as n
    # squared.
    toml_line = 4096
    text = read_text(path, SETTINGS_BYTES)
    longest = max(map(len, text.splitlines()), default=0)
    if longest > toml_line:
        expected = f"lines of at most {toml_line} characters"
        raise InputError(str(path), expected, f"one of {longest}", "Break the line.")
    tables: dict[str, Any] = _parse(str(path), "TOML", tomllib.loads, text)
    return tables


def require_file(path: Path, limit: int | None = None) -> int:
    """Return the size of a regular file [byte]; InputError if it is none, or above the limit."""
    try:
        if not path.is_file():
            found = "something else" if path.exists() else "nothing"
            raise InputError(str(path), "a file", found, "Put the file there, or correct the name.")
        size = path.stat().st_size
    except (OSError, ValueError) as error:
        todo = "Check its name and rights."
        raise InputError(str(path), "a readable file", say_failure(error), todo) from error
    if limit is not None and size > limit:
        todo = "Check that the path names the file that you mean."
        raise InputError(str(path), f"at most {limit} bytes", f"{size} bytes", todo)
    return size


def read_text(path: Path, limit: int) -> str:
    """Return the text of a UTF-8 file; InputError if it is none, or larger than `limit` bytes."""
    require_file(path, limit)
    try:
        return path.read_text(encoding="utf-8-sig")
    except (OSError, ValueError) as error:
        todo = "Save it as UTF-8."
        raise InputError(str(path), "readable UTF-8 text", say_failure(error), todo) from error


def _parse(where: str, form: str, parse: Callable[[str], Any], text: str) -> Any:  # noqa: ANN401
    try:
        if form == "JSON" and not text.strip():
            raise ValueError("an empty file")
        return parse(text)
    except RecursionError as error:
        raise InputError(where, form, "nesting without end", "Write the file again.") from error
    # ValueError: json and tomllib, and numbers or dates that Python's constructors reject.
    # The others: PyYAML, where a tag such as !!int or !!bool precedes text of another type.
    except (yaml.YAMLError, ValueError, OverflowError, LookupError, AttributeError) as error:
        found = " ".join(str(error).replace('"<unicode string>", ', "").split())
        raise InputError(where, form, found, "Correct the place that is named.") from error


class _Loader(yaml.SafeLoader):
    """Safe loader that rejects aliases and repeated keys, and reads dates as text."""

    yaml_implicit_resolvers = {
        first: [(tag, regexp) for tag, regexp in rules if not tag.endswith(":timestamp")]
        for first, rules in yaml.SafeLoader.yaml_implicit_resolvers.items()
    }

    def construct_mapping(self, node: yaml.MappingNode, deep: bool = False) -> dict[Hashable, Any]:
        seen = set()
        for key, _ in node.value:
            if not isinstance(key, yaml.ScalarNode):
                continue
            if key.value in seen:
                raise yaml.constructor.ConstructorError(
                    None, None, f"key {key.value!r} is given twice", key.start_mark
                )
            seen.add(key.value)
        return super().construct_mapping(node, deep)


def _load_yaml(text: str) -> Any:  # noqa: ANN401
    # The head of OpenCV's files, also of camchains, is none of YAML's.
    text = re.sub(r"\A%YAML[: ].*", "", text)
    try:
        return _parse_yaml(text)
    except yaml.scanner.ScannerError:
        # YAML allows tabs before a comment and at the end of a line; the parser does not.
        spaced = re.sub(r"(?<![ \t])[ \t]++(?=#|$)", " ", text, flags=re.MULTILINE)
        if "\t" not in text or spaced == text:
            raise
        return _parse_yaml(spaced)


def _parse_yaml(text: str) -> Any:  # noqa: ANN401
    # Events arrive one by one, so that the check rejects a bomb before construction.
    depth = 0
    for count, event in enumerate(yaml.parse(text, Loader=yaml.SafeLoader)):
        if isinstance(event, yaml.AliasEvent):
            raise yaml.YAMLError(f"an alias (*), which is not allowed {event.start_mark}")
        if isinstance(event, yaml.CollectionStartEvent):
            depth += 1
        elif isinstance(event, yaml.CollectionEndEvent):
            depth -= 1
        if count > EVENTS:
            raise yaml.YAMLError(f"more than {EVENTS} entries")
        if depth > NESTING:
            raise yaml.YAMLError(f"more than {NESTING} levels {event.start_mark}")
    return yaml.load(text, Loader=_Loader)


class _PlainTree(ElementTree.TreeBuilder):
    """Tree builder that rejects document types, whose entities can flood or hide files."""

    depth = 0

    def start(self, tag: Any, attrs: dict[Any, Any], /) -> ElementTree.Element:  # noqa: ANN401
        self.depth += 1
        if self.depth > NESTING:
            raise ValueError(f"elements nested more than {NESTING} deep")
        return super().start(tag, attrs)

    def end(self, tag: str, /) -> ElementTree.Element:
        self.depth -= 1
        return super().end(tag)

    def doctype(self, name: str, pubid: str, system: str) -> None:
        raise ValueError(f"a document type ({name}), which can hide other files and floods")


def parse_xml(content: bytes) -> ElementTree.Element:
    """Return the root of a document; ValueError if it is no XML, nested deeply, or has a type."""
    try:
        return ElementTree.fromstring(content, ElementTree.XMLParser(target=_PlainTree()))
    # ValueError and LookupError: also an encoding unknown to expat or Python.
    except (ElementTree.ParseError, ValueError, LookupError) as error:
        raise ValueError(f"no XML: {error}") from error


_SPACE: Final = " \t\n\r"
_DECODER: Final = json.JSONDecoder()


class JsonItems:
    """Entries of a JSON file: of its list, or of the list under a key of its mapping.

    Iterate once. NaN and Infinity are valid.

    Attributes:
        is_mapping: whether the file is a mapping; set when iteration begins.
        other: value in place of the list, None if there is no value or the list.
        has_list: whether the file has the list; set when iteration ends.
        kept: values of the other keys to keep; filled while iterating.
        seen: keys of the mapping; filled while iterating.
    """

    def __init__(
        self, path: Path, key: str, limit: int, keep: Collection[str] = (), other_key: str = ""
    ) -> None:
        """Prepare reading a file of at most `limit` bytes.

        In a mapping, `key` or `other_key` has the list, and the values of the keys `keep` are kept.
        """
        require_file(path, limit)
        self.path, self.keys = path, (key, other_key)
        self.is_mapping = False
        self.has_list = False
        self.other: Any = None
        self.keep = frozenset(keep)
        self.kept: dict[str, Any] = {}
        self.seen: list[str] = []

    def __iter__(self) -> Iterator[Any]:
        """Yield the entries; InputError if the file is no JSON, or an entry is too long."""
        try:
            with self.path.open("rb") as file:
                yield from self._entries(_Text(file))
        except RecursionError as error:
            raise self._wrong("nesting without end") from error
        except json.JSONDecodeError as error:
            raise self._wrong(f"{error.msg} (character {error.pos})") from error
        except UnicodeDecodeError as error:
            todo = "Save it as UTF-8."
            raise InputError(str(self.path), "UTF-8 text", say_failure(error), todo) from error
        except ValueError as error:  # a number with more digits than Python converts
            raise self._wrong(say_failure(error)) from error
        except OSError as error:
            raise self._wrong(say_failure(error)) from error

    def _entries(self, text: _Text) -> Iterator[Any]:
        if text.ahead() == "[":
            self.has_list = True
            yield from _read_list(text)
        elif text.ahead() == "{":
            self.is_mapping = True
            yield from self._read_mapping(text)
        elif text.ahead():
            self.other = text.value()
        else:
            raise text.error("an empty file")
        if text.ahead():
            raise text.error("something after the end of the list: several lists or mappings")

    def _read_mapping(self, text: _Text) -> Iterator[Any]:
        text.take("{")
        while text.ahead() != "}":
            name = text.value() if text.ahead() == '"' else None
            if name is None:
                raise text.error("Expecting property name enclosed in double quotes")
            text.take(":")
            self.seen.append(name)
            if name in self.keep:
                is_list = text.ahead() == "["
                self.kept[name] = list(_read_list(text)) if is_list else text.value()
            elif name not in self.keys:
                _skip(text)
            elif self.has_list or self.other is not None:
                raise text.error(f"{name!r} is given twice")
            elif text.ahead() == "[":
                self.has_list = True
                yield from _read_list(text)
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


def _read_list(text: _Text) -> Iterator[Any]:
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
        for _ in _read_list(text):
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
