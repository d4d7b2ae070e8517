"""The version of the code that computes a stage, read from its source without running it."""

from __future__ import annotations

import ast
import functools
import sys
from collections.abc import Iterator
from importlib.metadata import PackageNotFoundError, version
from pathlib import Path

from worldpose.errors import StoreError
from worldpose.store.canonical import digest

FOLLOWED = ("tasks", "worldpose", "data_contracts")
"""Packages whose imports decide a result."""
NOT_FOLLOWED = "worldpose.store"
"""How results are kept decides none of their numbers; `STORE_FORMAT` decides their bytes."""
STORE_FORMAT = "1"
"""Raised when the same arrays are written as other bytes."""
NUMERIC_LIBRARIES = ("numpy", "scipy", "numba", "opencv-python-headless", "av", "zarr", "numcodecs")

PARSING_ATTEMPTS = 10
"""Soon over where it is another trouble."""

_HOME = (Path(__file__).resolve().parents[2],)


@functools.cache
def code_version(root_module: str, roots: tuple[Path, ...] = _HOME) -> dict[str, str]:
    """Digest of each source module that `root_module` computes with, by module name.

    Follows imports, those inside functions too, into `tasks`, `worldpose` (not its store) and
    `data_contracts`. A package's `__init__` counts where an import takes a name from it, not
    merely because a module inside it is imported. A data file beside a module counts where the
    module names it. Comments, docstrings and formatting are left
    out, so that editing them recomputes nothing. Only literal import statements are seen. Read
    once per process: a process keeps the code it started with.

    Args:
        root_module: the module to start from, such as `tasks.tracking`.
        roots: folders that hold the packages.

    Raises:
        StoreError: a module's source is not found or cannot be parsed.
    """
    versions: dict[str, str] = {}
    waiting = [root_module]
    while waiting:
        name = waiting.pop()
        if name in versions:
            continue
        path = _source(name, roots)
        if path is None:
            raise StoreError(f"no source of module {name} below {', '.join(map(str, roots))}")
        try:
            tree = _parsed(path.read_bytes())
        except (OSError, SyntaxError, ValueError) as error:
            raise StoreError(f"{path}: cannot read module {name}: {error}") from error
        code = _WithoutText().visit(tree)
        versions[name] = digest(ast.unparse(code).encode())
        versions |= {f"{name}:{data.name}": digest(data.read_bytes()) for data in _data(code, path)}
        package = name if path.name == "__init__.py" else name.rpartition(".")[0]
        waiting.extend(found for found in _imported(tree, package, roots) if _is_followed(found))
    return dict(sorted(versions.items()))


@functools.cache
def libraries() -> dict[str, str]:
    """Versions of what else decides a result's bytes: Python, numeric libraries, store format."""
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


def _parsed(source: bytes) -> ast.Module:
    """The tree of a source, also where another thread parses at the same time.

    Python 3.11 counts how deep it is for all threads together, and gives up where the count is off
    in the end (python/cpython issue 106905).
    """
    for _ in range(PARSING_ATTEMPTS - 1):
        try:
            return ast.parse(source)
        except SystemError:
            continue
    return ast.parse(source)


def _is_followed(name: str) -> bool:
    inside_store = name == NOT_FOLLOWED or name.startswith(NOT_FOLLOWED + ".")
    return name.split(".")[0] in FOLLOWED and not inside_store


def _source(name: str, roots: tuple[Path, ...]) -> Path | None:
    for root in roots:
        base = root.joinpath(*name.split("."))
        for path in (base / "__init__.py", base.with_name(base.name + ".py")):
            if path.is_file():
                return path
    return None


def _data(code: ast.AST, path: Path) -> Iterator[Path]:
    """Files beside a module that a text in it names."""
    texts = {node.value for node in ast.walk(code) if isinstance(node, ast.Constant)}
    yield from (
        file
        for file in sorted(path.parent.iterdir())
        if file.suffix in (".npz", ".safetensors") and file.name in texts
    )


def _imported(tree: ast.AST, package: str, roots: tuple[Path, ...]) -> Iterator[str]:
    for node in ast.walk(tree):
        if isinstance(node, ast.Import):
            yield from (alias.name for alias in node.names)
        elif isinstance(node, ast.ImportFrom):
            base = node.module or ""
            if node.level:
                parents = package.split(".")
                parents = parents[: len(parents) - node.level + 1]
                base = ".".join([*parents, base] if base else parents)
            for alias in node.names:
                inner = f"{base}.{alias.name}"
                yield inner if _source(inner, roots) else base


class _WithoutText(ast.NodeTransformer):
    """Removes docstrings and field strings: text that stands alone as a statement."""

    def visit_Expr(self, node: ast.Expr) -> ast.AST | None:
        is_text = isinstance(node.value, ast.Constant) and isinstance(node.value.value, str)
        return None if is_text else node

    def generic_visit(self, node: ast.AST) -> ast.AST:
        super().generic_visit(node)
        if getattr(node, "body", None) == []:
            node.body = [ast.Pass()]  # type: ignore[attr-defined]
        return node
