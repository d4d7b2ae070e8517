"""Digests and imports of source modules: read from a file that earlier processes wrote, or parsed.

Parsing all sources takes two seconds, and every command and worker needs them.
"""

from __future__ import annotations

import ast
import functools
import json
import os
import platform
import tempfile
from pathlib import Path
from typing import NamedTuple

from worldpose.store.documents import canonical_json, digest

PARSING_ATTEMPTS = 10
"""Attempts to parse a source while other threads parse, too; see `_parse`."""
DATA_SUFFIXES = (".npz", ".safetensors")

_PACKAGE = Path(__file__).resolve().parents[1]


class Import(NamedTuple):
    """One imported module, or names imported from one.

    Attributes:
        module: as written; empty in `from . import name`.
        level: number of leading dots.
        names: what is imported from it; empty in `import module`.
    """

    module: str
    level: int
    names: list[str]


class ParsedSource(NamedTuple):
    """Properties of a source, which depend on its bytes and on Python alone.

    Attributes:
        code: digest of the code without comments, docstrings and formatting.
        imports: all import statements, also inside functions.
        data: strings in the code that may name a data file, sorted.
    """

    code: str
    imports: list[Import]
    data: list[str]


class SourceCache:
    """Parsed sources by module name, in memory and in a file of the user.

    Processes that write at once replace each other's whole file, and the next ones parse what is
    missing. A file that cannot be read or written, is damaged, or was written by other code or
    another Python, costs time only.
    """

    def __init__(self, path: Path | None) -> None:
        self.path = path
        self._modules = {} if path is None else _load(path)
        self._is_changed = False

    def parse(self, name: str, source: bytes) -> ParsedSource:
        """Return the properties of module `name` with this source.

        Raises:
            SyntaxError: it is no Python.
            ValueError: the same, because of a zero byte.
        """
        identity = digest(source)
        kept = self._modules.get(name)
        if kept is None or kept[0] != identity:
            kept = identity, parse_source(source)
            self._modules[name] = kept
            self._is_changed = True
        return kept[1]

    def save(self) -> None:
        """Write the file if something was parsed since; a failure is ignored."""
        if self.path is None or not self._is_changed:
            return
        self._is_changed = False
        content = canonical_json(dict(self._modules))
        try:
            self.path.parent.mkdir(parents=True, exist_ok=True)
            with tempfile.NamedTemporaryFile(dir=self.path.parent, delete=False) as file:
                temporary = Path(file.name)
                try:
                    file.write(_seal(content) + content)
                    file.flush()
                    temporary.replace(self.path)
                except BaseException:
                    temporary.unlink(missing_ok=True)
                    raise
        except OSError:
            return


def own_cache_file() -> Path | None:
    """Return the file for the sources of this installation; None for a user without a home."""
    name = f"sources-{digest(str(_PACKAGE).encode())[:16]}.json"
    try:
        root = _PACKAGE if os.access(_PACKAGE, os.W_OK) else Path.home() / ".cache" / "worldpose"
    except RuntimeError:
        return None
    return root / "__pycache__" / name


def _load(path: Path) -> dict[str, tuple[str, ParsedSource]]:
    try:
        seal, content = path.read_bytes().split(b"\n", 1)
    except (OSError, ValueError):
        return {}
    if seal + b"\n" != _seal(content):
        return {}
    return {
        name: (identity, ParsedSource(code, [Import._make(each) for each in imports], data))
        for name, (identity, (code, imports, data)) in json.loads(content).items()
    }


def _seal(content: bytes) -> bytes:
    """Return a line that fits this content, this module's code and this Python alone."""
    return digest(_parser_version() + content).encode() + b"\n"


@functools.cache
def _parser_version() -> bytes:
    return platform.python_version().encode() + Path(__file__).read_bytes()


def parse_source(source: bytes) -> ParsedSource:
    """Return the properties of a source.

    Raises:
        SyntaxError: it is no Python.
        ValueError: the same, because of a zero byte.
    """
    tree = _parse(source)
    nodes = _drop_text(tree)
    texts = {node.value for node in nodes if isinstance(node, ast.Constant)}
    data = [text for text in texts if isinstance(text, str) and text.endswith(DATA_SUFFIXES)]
    return ParsedSource(digest(ast.unparse(tree).encode()), _imports(nodes), sorted(data))


def _parse(source: bytes) -> ast.Module:
    """Parse a source, also while another thread parses.

    Python 3.11 shares its recursion depth counter between threads, and raises an error if the count
    is wrong at the end (python/cpython issue 106905).
    """
    for _ in range(PARSING_ATTEMPTS - 1):
        try:
            return ast.parse(source)
        except SystemError:
            continue
    return ast.parse(source)


def _imports(nodes: list[ast.AST]) -> list[Import]:
    found = []
    for node in nodes:
        if isinstance(node, ast.Import):
            found += [Import(alias.name, 0, []) for alias in node.names]
        elif isinstance(node, ast.ImportFrom):
            names = [alias.name for alias in node.names]
            found.append(Import(node.module or "", node.level, names))
    return found


def _drop_text(tree: ast.Module) -> list[ast.AST]:
    """Return all nodes of a tree, after removing string statements from it.

    These are docstrings and field docstrings.
    """
    nodes: list[ast.AST] = [tree]
    for node in nodes:  # the list grows during the loop
        for name, value in ast.iter_fields(node):
            if isinstance(value, ast.AST):
                nodes.append(value)
            elif isinstance(value, list):
                kept = [each for each in value if not _is_text(each)]
                if name == "body" and not kept:
                    kept = [ast.Pass()]
                value[:] = kept
                nodes.extend(each for each in kept if isinstance(each, ast.AST))
    return nodes


def _is_text(node: object) -> bool:
    """Return whether this is a statement that contains only a string."""
    if not isinstance(node, ast.Expr) or not isinstance(node.value, ast.Constant):
        return False
    return isinstance(node.value.value, str)
