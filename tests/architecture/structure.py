"""Measures the structure of the code: sizes, imports, cycles and signatures.

    python tests/architecture/structure.py [--list MEASURE]

prints one table for all packages; --list prints what a measure counted, for example
`one_importer`, `parameters`, `starred_calls`, `cycles`, `chain` or `long_files`. Everything is read
from the source text: nothing of the project is imported.
"""

from __future__ import annotations

import argparse
import ast
import statistics
import sys
from collections import defaultdict
from collections.abc import Iterator
from functools import cached_property
from graphlib import TopologicalSorter
from pathlib import Path

import numpy as np
from scipy.sparse import csr_array
from scipy.sparse.csgraph import connected_components

ROOT = Path(__file__).parents[2]
PACKAGES = ("data_contracts", "worldpose", "tasks", "flows")
MAX_PARAMETERS = 8
MAX_LINES = 600
MAX_ENGINE_FILES = 20
ANY_NUMBER = {"block_diag", "zip", "reshape", "Sequential"}
"""Functions that take any number of like arguments."""


class Structure:
    """The modules of the packages and how they import each other.

    Attributes:
        root: folder with the packages.
        files: source file by module name.
    """

    def __init__(self, root: Path = ROOT, packages: tuple[str, ...] = PACKAGES) -> None:
        self.root = root
        self.files = {
            module_name(path.relative_to(root)): path
            for package in packages
            for path in sorted((root / package).rglob("*.py"))
        }

    @cached_property
    def trees(self) -> dict[str, ast.Module]:
        """Syntax tree by module."""
        return {name: ast.parse(path.read_text()) for name, path in self.files.items()}

    @cached_property
    def lines(self) -> dict[str, int]:
        """Number of lines by module."""
        return {name: len(path.read_text().splitlines()) for name, path in self.files.items()}

    @cached_property
    def imports(self) -> dict[str, set[str]]:
        """Modules of the project that each module imports, at any depth of its code.

        A name taken from a package counts as an import of the module that defines it, because a
        package's `__init__` only passes it on.
        """
        return {
            name: {each for each in self._imported(name) if each != name} for name in self.files
        }

    def _imported(self, name: str) -> Iterator[str]:
        for node in ast.walk(self.trees[name]):
            if isinstance(node, ast.Import):
                yield from (alias.name for alias in node.names if alias.name in self.files)
            elif isinstance(node, ast.ImportFrom) and node.module in self.files:
                for alias in node.names:
                    yield self._definer(node.module, alias.name, name)

    def _definer(self, module: str, imported: str, importer: str) -> str:
        """Return the module in which a name imported from `module` is defined."""
        inner = f"{module}.{imported}"
        if inner in self.files:
            return inner
        if self.files[module].name != "__init__.py" or importer == module:
            return module
        for node in ast.walk(self.trees[module]):  # also below `if TYPE_CHECKING`
            if isinstance(node, ast.ImportFrom) and node.module in self.files:
                for alias in node.names:
                    if (alias.asname or alias.name) == imported:
                        return self._definer(node.module, alias.name, module)
        return module

    @cached_property
    def importers(self) -> dict[str, set[str]]:
        """Modules that import each module; packages that only pass names on do not count."""
        found: dict[str, set[str]] = defaultdict(set)
        for name, imported in self.imports.items():
            if self.files[name].name != "__init__.py":
                for each in imported:
                    found[each].add(name)
        return found

    def one_importer(self) -> list[str]:
        """Return the modules that exactly one module imports, from the same package."""
        found = []
        for name, importers in sorted(self.importers.items()):
            (only, *more) = importers
            if not more and package_of(only) == package_of(name):
                found.append(f"{name} ({self.lines[name]} lines) <- {only}")
        return found

    def cycles(self) -> list[str]:
        """Return the groups of modules that import each other in a circle."""
        names = list(self.imports)
        place = {name: index for index, name in enumerate(names)}
        edges = [(place[name], place[each]) for name in names for each in self.imports[name]]
        rows, columns = zip(*edges, strict=True) if edges else ((), ())
        graph = csr_array((np.ones(len(edges)), (rows, columns)), shape=(len(names), len(names)))
        _, group = connected_components(graph, connection="strong")
        members: dict[int, list[str]] = defaultdict(list)
        for name, number in zip(names, group.tolist(), strict=True):
            members[number].append(name)
        return [", ".join(sorted(each)) for each in members.values() if len(each) > 1]

    def chain(self) -> list[str]:
        """Return the longest chain of modules of which each imports the next.

        Raises:
            graphlib.CycleError: modules import each other in a circle.
        """
        longest: dict[str, list[str]] = {}
        for name in TopologicalSorter(self.imports).static_order():  # imported modules come first
            after = [longest[each] for each in sorted(self.imports[name])]
            longest[name] = [name, *max(after, key=len, default=[])]
        return max(longest.values(), key=len, default=[])

    def parameters(self) -> list[str]:
        """Return the functions with more than eight parameters; commands are excepted."""
        found = []
        for name, tree in self.trees.items():
            for node in ast.walk(tree):
                if isinstance(node, ast.FunctionDef | ast.AsyncFunctionDef):
                    given = node.args
                    every = [*given.posonlyargs, *given.args, *given.kwonlyargs]
                    count = len([each for each in every if each.arg not in ("self", "cls")])
                    if count > MAX_PARAMETERS and not name.startswith("flows.cli"):
                        found.append(f"{name}.{node.name}: {count}")
        return found

    def starred_calls(self) -> list[str]:
        """Return the calls that unpack a variable, so that names of arguments are hidden.

        A call that takes any number of like things, such as `zip`, hides no name.
        """
        return [
            f"{name}:{node.lineno}: {ast.unparse(node)[:80]}"
            for name, tree in self.trees.items()
            for node in ast.walk(tree)
            if isinstance(node, ast.Call)
            and ast.unparse(node.func).rpartition(".")[2] not in ANY_NUMBER
            and any(
                isinstance(each, ast.Starred) and isinstance(each.value, ast.Name)
                for each in node.args
            )
        ]

    def long_files(self) -> list[str]:
        """Return the files with more than 600 lines."""
        return [f"{name}: {count}" for name, count in self.lines.items() if count > MAX_LINES]


MEASURES = ("one_importer", "parameters", "starred_calls", "cycles", "chain", "long_files")


def module_name(path: Path) -> str:
    """Return the dotted name of a file below the root."""
    parts = path.with_suffix("").parts
    return ".".join(parts[:-1] if parts[-1] == "__init__" else parts)


def package_of(module: str) -> str:
    """Return the package that a module lies in."""
    return module.rpartition(".")[0]


def print_table(structure: Structure) -> None:
    """Print sizes per package and the measures of the whole."""
    print(f"{'package':42s} {'modules':>8s} {'lines':>7s} {'median':>7s} {'longest':>8s}")
    groups: dict[str, list[int]] = defaultdict(list)
    for name, count in structure.lines.items():
        parts = name.split(".")
        groups[parts[0]].append(count)
        is_package = structure.files[name].name == "__init__.py" and len(parts) > 1
        if len(parts) > 2 or is_package:
            groups[".".join(parts[:2])].append(count)
    for name in sorted(groups):
        counts = groups[name]
        print(
            f"{name:42s} {len(counts):8d} {sum(counts):7d} {statistics.median(counts):7.0f} "
            f"{max(counts):8d}"
        )
    engine = list((structure.root / "flows").glob("*.py"))
    print(f"files directly in flows/: {len(engine)}")
    for measure in MEASURES:
        print(f"{measure}: {len(getattr(structure, measure)())}")


def main() -> None:
    """Print the table, or what one measure counted."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--list", choices=MEASURES)
    options = parser.parse_args()
    structure = Structure()
    if options.list is None:
        print_table(structure)
    else:
        sys.stdout.write("".join(f"{line}\n" for line in getattr(structure, options.list)()))


if __name__ == "__main__":
    main()
