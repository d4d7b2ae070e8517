"""Recipe of a result: its key, the versions of code and libraries, differences of two recipes.

The version of code is a digest of source modules. Parsing all sources takes two seconds, and every
command and worker needs them; so a file of the user keeps what earlier processes parsed.
"""

from __future__ import annotations

import ast
import functools
import json
import platform
import sys
import tempfile
from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from importlib.metadata import PackageNotFoundError, version
from pathlib import Path
from typing import Any, Literal, NamedTuple

from data_contracts.work import Recipe
from worldpose.cache_folder import find_cache_folder
from worldpose.errors import StoreError
from worldpose.parsing import parse_in_turn
from worldpose.store.documents import canonical_json, digest

DATA_SUFFIXES = (".npz", ".safetensors")

_PACKAGE = Path(__file__).resolve().parents[1]


class Import(NamedTuple):
    """One imported module, or names imported from one.

    Attributes:
        module: name as written; empty in `from . import name`.
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
            SyntaxError: the source is not valid Python.
            ValueError: the source contains a zero byte.
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
    """Return the file for the sources of this installation; None where none can be written."""
    folder = find_cache_folder().path
    name = f"sources-{digest(str(_PACKAGE).encode())[:16]}.json"
    return None if folder is None else folder / name


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
        SyntaxError: the source is not valid Python.
        ValueError: the source contains a zero byte.
    """
    tree = parse_in_turn(lambda: ast.parse(source))
    nodes = _drop_text(tree)
    texts = {node.value for node in nodes if isinstance(node, ast.Constant)}
    data = [text for text in texts if isinstance(text, str) and text.endswith(DATA_SUFFIXES)]
    return ParsedSource(digest(ast.unparse(tree).encode()), _imports(nodes), sorted(data))


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


FOLLOWED = ("tasks", "worldpose", "data_contracts")
"""Packages whose imports affect a result."""
NOT_FOLLOWED = "worldpose.store"
"""The storage code does not affect numbers of results; `STORE_FORMAT` covers their bytes."""
STORE_FORMAT = "2"
"""Increased when the same arrays are written as other bytes."""
NUMERIC_LIBRARIES = ("numpy", "scipy", "numba", "opencv-python-headless", "av", "zarr", "numcodecs")

_HOME = (Path(__file__).resolve().parents[2],)


@functools.cache
def code_version(root_module: str, roots: tuple[Path, ...] = _HOME) -> dict[str, str]:
    """Return the digest of each source module that `root_module` depends on, by module name.

    Follows imports, also inside functions, into `tasks`, `worldpose` (not its store) and
    `data_contracts`. A package's `__init__` counts if an import takes a name from it, not merely
    because a module inside it is imported. A data file next to a module counts if the module names
    it. Comments, docstrings and formatting are ignored, so that editing them recomputes nothing.
    Only literal import statements are detected. Computed once per process: a process keeps the code
    that it started with.

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
    return SourceCache(own_cache_file() if roots == _HOME else None)


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
    versions |= {
        f"{name}:{data.name}": digest(data.read_bytes()) for data in _data_files(parsed.data, path)
    }
    package = name if path.name == "__init__.py" else name.rpartition(".")[0]
    return versions, frozenset(
        filter(_is_followed, _imported_modules(parsed.imports, package, roots))
    )


@functools.cache
def libraries() -> dict[str, str]:
    """Return versions that affect a result's bytes: Python, numeric libraries, store format."""
    versions = {
        "python": f"{sys.version_info.major}.{sys.version_info.minor}",
        "store": STORE_FORMAT,
    }
    for name in NUMERIC_LIBRARIES:
        try:
            versions[name] = version(name)
        except PackageNotFoundError:
            versions[name] = "absent"
    return versions


def _is_followed(name: str) -> bool:
    inside_store = name == NOT_FOLLOWED or name.startswith(NOT_FOLLOWED + ".")
    return name.split(".")[0] in FOLLOWED and not inside_store


def _source_file(name: str, roots: tuple[Path, ...]) -> Path | None:
    for root in roots:
        base = root.joinpath(*name.split("."))
        for path in (base / "__init__.py", base.with_name(base.name + ".py")):
            if path.is_file():
                return path
    return None


def _data_files(names: list[str], path: Path) -> Iterator[Path]:
    """Yield the files of these names next to a module."""
    yield from (
        file
        for file in sorted(path.parent.iterdir())
        if file.suffix in DATA_SUFFIXES and file.name in names
    )


def _imported_modules(
    imports: list[Import], package: str, roots: tuple[Path, ...]
) -> Iterator[str]:
    for module, level, names in imports:
        base = module
        if level:
            parents = package.split(".")
            parents = parents[: len(parents) - level + 1]
            base = ".".join([*parents, base] if base else parents)
        if not names:
            yield base
        for name in names:
            inner = f"{base}.{name}"
            yield inner if _source_file(inner, roots) else base


KEY_LENGTH = 32


def recipe_key(recipe: Recipe) -> str:
    """Return the key of the result of `recipe`: the first 128 bits of the recipe's SHA-256."""
    return digest(canonical_json(dict(recipe)))[:KEY_LENGTH]


DifferenceKind = Literal[
    "contract", "match", "unit", "source", "input", "setting", "module", "library", "recipe"
]


@dataclass(frozen=True)
class RecipeDifference:
    """One difference between two recipes.

    Attributes:
        kind: part of the recipe.
        name: name within that part; empty if the part is a single value.
        before: value in the old recipe as short text, or `absent`.
        after: value in the new one.
    """

    kind: DifferenceKind
    name: str
    before: str
    after: str

    def __str__(self) -> str:
        return f"{self.kind} {self.name}".rstrip() + f": {self.before} -> {self.after}"


def recipe_differences(old: Recipe, new: Recipe) -> list[RecipeDifference]:
    """Return the differences between `old` and `new`; empty if equal."""
    found = [
        *_changes("contract", {"": old.contract}, {"": new.contract}),
        *_changes("match", {"": old.match_id}, {"": new.match_id}),
        *_changes("unit", {"": old.name}, {"": new.name}),
        *_changes("source", _flatten(old.sources), _flatten(new.sources)),
        *_changes("input", old.inputs, new.inputs),
        *_changes("setting", _flatten(old.settings), _flatten(new.settings)),
        *_changes("module", old.code, new.code),
        *_changes("library", old.libraries, new.libraries),
    ]
    # Digests with equal prefixes look equal when shortened; every difference must show.
    if not found and recipe_key(old) != recipe_key(new):
        found.append(RecipeDifference("recipe", "", recipe_key(old), recipe_key(new)))
    return found


def _changes(
    kind: DifferenceKind, old: Mapping[str, Any], new: Mapping[str, Any]
) -> Iterator[RecipeDifference]:
    for name in sorted(old.keys() | new.keys()):
        before, after = _format_value(old, name), _format_value(new, name)
        if before != after:
            yield RecipeDifference(kind, name, before, after)


def _format_value(values: Mapping[str, Any], name: str) -> str:
    if name not in values:
        return "absent"
    value = values[name]
    text = value if isinstance(value, str) else canonical_json(value).decode()
    is_digest = len(text) in (32, 64) and set(text) <= set("0123456789abcdef")
    return f"{text[:12]}..." if is_digest else text


def _flatten(values: Mapping[str, Any], prefix: str = "") -> dict[str, Any]:
    """Return every leaf by its path: `camera.focal_px[0]`."""
    flat: dict[str, Any] = {}
    for name, value in values.items():
        if isinstance(value, Mapping) and value:
            flat.update(_flatten(value, f"{prefix}{name}."))
        elif isinstance(value, list | tuple) and value:
            items = {f"{name}[{index}]": item for index, item in enumerate(value)}
            flat.update(_flatten(items, prefix))
        else:
            flat[prefix + name] = value
    return flat
