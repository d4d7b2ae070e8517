"""Prints the size of the code, so that a change can be held to a budget.

    python infra/code_size.py [--json] [--list MEASURE]

Counts lines by part, documentation, constants of worldpose, settings of stages, long functions and
long files. `--list` prints what a measure counted.
"""

from __future__ import annotations

import argparse
import ast
import json
import subprocess
from collections.abc import Iterator
from pathlib import Path

from pydantic import BaseModel

from flows.method import METHOD

ROOT = Path(__file__).parents[1]
PARTS = ("worldpose", "flows", "tasks", "data_contracts", "benchmarks", "infra", "tests")
MAX_FUNCTION_LINES = 60
MAX_FILE_LINES = 500


def list_files(*patterns: str) -> list[Path]:
    """Return the files of the repository that match, without those that git ignores."""
    command = ["git", "ls-files", "--cached", "--others", "--exclude-standard", "--", *patterns]
    names = subprocess.check_output(command, cwd=ROOT, text=True).split()
    return [path for path in map(ROOT.joinpath, sorted(set(names))) if path.exists()]


def list_constants(name: str, tree: ast.Module) -> Iterator[str]:
    """Yield the names in capitals that a module of worldpose assigns."""
    for node in tree.body if name.startswith("worldpose/") else []:
        if isinstance(node, ast.Assign | ast.AnnAssign):
            for target in node.targets if isinstance(node, ast.Assign) else [node.target]:
                ids = [each.id for each in ast.walk(target) if isinstance(each, ast.Name)]
                yield from (f"{name}:{node.lineno} {each}" for each in ids if each.isupper())


def list_long_functions(name: str, tree: ast.Module) -> Iterator[str]:
    """Yield the functions of more than 60 lines, with their length."""
    for node in ast.walk(tree):
        if isinstance(node, ast.FunctionDef | ast.AsyncFunctionDef):
            length = (node.end_lineno or node.lineno) - node.lineno + 1
            if length > MAX_FUNCTION_LINES:
                yield f"{name}:{node.lineno} {node.name}: {length}"


def list_settings() -> list[str]:
    """Return every setting of every stage; a group counts as its settings."""

    def fields(record: type[BaseModel], prefix: str) -> Iterator[str]:
        for name, field in record.model_fields.items():
            kind = field.annotation
            if isinstance(kind, type) and issubclass(kind, BaseModel):
                yield from fields(kind, f"{prefix}.{name}")
            else:
                yield f"{prefix}.{name}"

    return [each for stage in METHOD for each in fields(stage.settings, stage.name)]


def measure() -> tuple[dict[str, int | str], dict[str, list[str]]]:
    """Return every measure, and what the counts counted."""
    sources = {
        path.relative_to(ROOT).as_posix(): path.read_text(encoding="utf-8")
        for path in list_files("*.py")
    }
    lines = {name: text.count("\n") for name, text in sources.items()}
    product = {
        name: ast.parse(text)
        for name, text in sources.items()
        if not name.startswith(("tests/", "docs/", "examples/"))
    }
    counted = {
        "constants": [each for item in product.items() for each in list_constants(*item)],
        "settings": list_settings(),
        "long_functions": [each for item in product.items() for each in list_long_functions(*item)],
        "long_files": [f"{name}: {n}" for name, n in lines.items() if n > MAX_FILE_LINES],
    }
    longest = max(lines, key=lambda name: lines[name])
    texts = list_files("docs/*.md", "README.md", "CHANGELOG.md")
    sizes: dict[str, int | str] = {
        part: sum(n for name, n in lines.items() if name.startswith(f"{part}/")) for part in PARTS
    }
    sizes |= {
        "all Python": sum(lines.values()),
        "docs, README, CHANGELOG [KB]": round(sum(path.stat().st_size for path in texts) / 1000),
        "constants in worldpose": len(counted["constants"]),
        "settings of stages": len(counted["settings"]),
        f"functions over {MAX_FUNCTION_LINES} lines": len(counted["long_functions"]),
        f"files over {MAX_FILE_LINES} lines": len(counted["long_files"]),
        "longest file": f"{longest}: {lines[longest]}",
    }
    return sizes, counted


def main() -> None:
    """Print the table, or what one measure counted."""
    parser = argparse.ArgumentParser(description=(__doc__ or "").splitlines()[0])
    parser.add_argument("--json", action="store_true", help="print one JSON object")
    sizes, counted = measure()
    parser.add_argument("--list", choices=counted, help="print what a measure counted")
    options = parser.parse_args()
    if options.list:
        print("\n".join(counted[options.list]))
    elif options.json:
        print(json.dumps(sizes, indent=2))
    else:
        for name, value in sizes.items():
            print(f"{name:30s} {value:>8}")


if __name__ == "__main__":
    main()
