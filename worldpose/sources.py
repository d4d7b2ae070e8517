"""Digests of the sources that a module depends on: in keys of results, and of compiled kernels.

Parsing all sources takes two seconds, and every command and worker needs them; so a file of the
user keeps what earlier processes parsed.
"""

from __future__ import annotations

import ast
import functools
import hashlib
import json
import platform
import tempfile
from pathlib import Path
from typing import Final, NamedTuple

from worldpose.cache_folder import find_cache_folder
from worldpose.errors import StoreError
from worldpose.parsing import parse_in_turn

_HOME: Final = (Path(__file__).resolve().parents[1],)


class ParsedSource(NamedTuple):
    """Properties of a source, which depend on its bytes and on Python alone.

    Attributes:
        code: digest of the code without comments, docstrings and formatting.
        imports: names of all import statements, also inside functions, such as
            `worldpose.geometry.rigid.Rigid`.
        data: strings in the code that may name a data file, sorted.
    """

    code: str
    imports: list[str]
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
        """Return the properties of module `name` with this source; errors as of `parse_source`."""
        identity = _digest(source)
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
        content = json.dumps(self._modules, sort_keys=True, separators=(",", ":")).encode()
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


def _load(path: Path) -> dict[str, tuple[str, ParsedSource]]:
    try:
        seal, content = path.read_bytes().split(b"\n", 1)
    except (OSError, ValueError):
        return {}
    if seal + b"\n" != _seal(content):
        return {}
    return {
        name: (identity, ParsedSource(*parsed))
        for name, (identity, parsed) in json.loads(content).items()
    }


def _seal(content: bytes) -> bytes:
    """Return a line that fits this content, this module's code and this Python alone."""
    return _digest(_parser_version() + content).encode() + b"\n"


@functools.cache
def _parser_version() -> bytes:
    return platform.python_version().encode() + Path(__file__).read_bytes()


def _digest(data: bytes) -> str:
    return hashlib.sha256(data).hexdigest()


def parse_source(source: bytes) -> ParsedSource:
    """Return the properties of a source; SyntaxError or ValueError if it is not Python."""
    tree = parse_in_turn(lambda: ast.parse(source))
    nodes = _drop_text(tree)
    texts = {node.value for node in nodes if isinstance(node, ast.Constant)}
    data_suffixes = (".npz", ".safetensors")
    data = [text for text in texts if isinstance(text, str) and text.endswith(data_suffixes)]
    imports = []
    for node in nodes:
        if isinstance(node, ast.Import):
            imports += [alias.name for alias in node.names]
        elif isinstance(node, ast.ImportFrom):
            imports += [f"{node.module}.{alias.name}" for alias in node.names]
    return ParsedSource(_digest(ast.unparse(tree).encode()), imports, sorted(data))


def _drop_text(tree: ast.Module) -> list[ast.AST]:
    """Return all nodes of a tree, after removing docstrings, also of fields, from it."""
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
    return (
        isinstance(node, ast.Expr)
        and isinstance(node.value, ast.Constant)
        and isinstance(node.value.value, str)
    )


@functools.cache
def code_version(root_module: str, roots: tuple[Path, ...] = _HOME) -> dict[str, str]:
    """Return the digest of each source module that `root_module` depends on, by module name.

    Follows imports, also inside functions, into `tasks`, `worldpose` (not its store) and
    `data_contracts`. A package's `__init__` counts if an import takes a name from it, not merely
    because a module inside it is imported. A data file next to a module counts if the module names
    it. Comments, docstrings and formatting are ignored, so that editing them recomputes nothing.
    Only absolute, literal import statements are detected. Computed once per process: a process
    keeps the code that it started with.

    Args:
        root_module: the module to start from, such as `tasks.tracking`.
        roots: folders that hold the packages.

    Raises:
        StoreError: a module's source is missing or cannot be parsed.
    """
    versions: dict[str, str] = {}
    seen = {root_module}
    waiting = [root_module]
    while waiting:
        of_module, imported = _read_module(waiting.pop(), roots)
        versions |= of_module
        waiting.extend(imported - seen)
        seen |= imported
    _source_cache(roots).save()
    return dict(sorted(versions.items()))


@functools.cache
def _source_cache(roots: tuple[Path, ...]) -> SourceCache:
    folder = find_cache_folder().path
    if roots != _HOME or folder is None:
        return SourceCache(None)
    return SourceCache(folder / f"sources-{_digest(str(_HOME[0]).encode())[:16]}.json")


@functools.cache
def _read_module(name: str, roots: tuple[Path, ...]) -> tuple[dict[str, str], frozenset[str]]:
    """Return digests of one module and of the data files that it names, and its imports."""
    path = _source_file(name, roots)
    if path is None:
        raise StoreError(
            f"found no source of module {name} below {', '.join(map(str, roots))}. Install "
            "worldpose with its sources, for example with `pip install -e .`."
        )
    try:
        parsed = _source_cache(roots).parse(name, path.read_bytes())
    except (OSError, SyntaxError, ValueError) as error:
        raise StoreError(f"{path}: cannot read module {name}: {error}") from error
    versions = {name: parsed.code}
    for data in sorted(path.parent.iterdir()) if parsed.data else ():
        if data.name in parsed.data:
            versions[f"{name}:{data.name}"] = _digest(data.read_bytes())
    # Packages whose imports affect a result.
    followed = ("tasks", "worldpose", "data_contracts")
    modules = {
        each if _source_file(each, roots) else each.rpartition(".")[0]
        for each in parsed.imports
        if each.partition(".")[0] in followed
    }
    # The storage code does not affect numbers of results; its `STORE_FORMAT` covers their bytes.
    not_followed = "worldpose.store"
    return versions, frozenset(
        each for each in modules if not f"{each}.".startswith(f"{not_followed}.")
    )


def _source_file(name: str, roots: tuple[Path, ...]) -> Path | None:
    for root in roots:
        base = root.joinpath(*name.split("."))
        for path in (base / "__init__.py", base.with_name(base.name + ".py")):
            if path.is_file():
                return path
    return None
