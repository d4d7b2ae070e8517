"""Machine code for numerical kernels (Numba), and threads that run them at the same time."""

from __future__ import annotations

import functools
import hashlib
import os
import re
from collections import deque
from collections.abc import Callable, Iterable, Iterator
from concurrent.futures import Future, ThreadPoolExecutor
from contextvars import copy_context
from pathlib import Path
from typing import Final, TypeVar, cast

from numba import njit
from numba.core import config

Function = TypeVar("Function", bound=Callable[..., object])
Item = TypeVar("Item")
Result = TypeVar("Result")

THREADS: Final = 2
"""Threads of one unit: the only clip of a match uses two cores, and the units of many clips on a
large machine do not hinder each other."""

_PACKAGE = Path(__file__).resolve().parent
_IMPORT = re.compile(
    rb"^\s*(?:from|import) (worldpose\.\w+|data_contracts\.\w+)", flags=re.MULTILINE
)


def compile_kernel(function: Function) -> Function:
    """Return `function`, compiled to machine code on its first call and cached on disk.

    No fast-math and no parallel loops: the same input gives the same bits on any number of
    threads. The interpreter lock is released, and division by zero gives infinity as in numpy.
    """
    given = config.CACHE_DIR  # type: ignore[attr-defined]
    # Numba reads this setting while it decorates.
    config.CACHE_DIR = given or str(_cache_folder(_part_of(function)))  # type: ignore[attr-defined]
    try:
        return cast(Function, njit(cache=True, nogil=True, error_model="numpy")(function))
    finally:
        config.CACHE_DIR = given  # type: ignore[attr-defined]


def map_in_threads(function: Callable[[Item], Result], items: Iterable[Item]) -> Iterator[Result]:
    """Yield the result for each item, in order; `THREADS` of them are computed at the same time.

    Kernels and large numpy operations release the interpreter lock. Results are those of a loop:
    each item is computed by itself. At most `THREADS` results wait, so memory stays flat.
    """
    waiting: deque[Future[Result]] = deque()
    with ThreadPoolExecutor(min(THREADS, os.cpu_count() or 1)) as threads:
        for item in items:
            # With the caller's settings of numpy's warnings.
            waiting.append(threads.submit(copy_context().run, function, item))
            if len(waiting) > THREADS:
                yield waiting.popleft().result()
        while waiting:
            yield waiting.popleft().result()


def _part_of(function: Function) -> str:
    """Return the part of worldpose that defines a function, such as `worldpose.tracking`."""
    source = Path(function.__code__.co_filename).resolve()
    return f"worldpose.{source.relative_to(_PACKAGE).parts[0].removesuffix('.py')}"


@functools.cache
def _cache_folder(part: str) -> Path:
    """Return a cache folder that is unique to the sources on which kernels of `part` can depend.

    Numba recompiles a kernel when its own file changes, but not when a kernel or constant from
    another file changes: it would then run machine code of the old source. A part, a folder of
    worldpose or a module of data_contracts, depends on all parts that its sources import.
    """
    sources = {part: _sources(part)}
    waiting = [part]
    while waiting:
        for name in {each.decode() for each in _IMPORT.findall(sources[waiting.pop()])}:
            if name not in sources:
                sources[name] = _sources(name)
                waiting.append(name)
    digest = hashlib.sha256(b"".join(content for _, content in sorted(sources.items())))
    root = _PACKAGE if os.access(_PACKAGE, os.W_OK) else Path.home() / ".cache" / "worldpose"
    return root / "__pycache__" / f"kernels-{digest.hexdigest()[:16]}"


def _sources(part: str) -> bytes:
    folder = _PACKAGE.parent.joinpath(*part.split("."))
    files = [folder.with_suffix(".py"), *sorted(folder.rglob("*.py"))]
    return b"".join(file.read_bytes() for file in files if file.is_file())
