"""Machine code for numerical kernels (Numba), threads that run them, and reading in advance."""

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

from worldpose.cache_folder import find_cache_folder

Function = TypeVar("Function", bound=Callable[..., object])
Item = TypeVar("Item")
Result = TypeVar("Result")

THREADS: Final = 2
"""Threads of one unit: the only clip of a match uses two cores, and the units of many clips on a
large machine do not hinder each other."""

_PACKAGE = Path(__file__).resolve().parent
_IMPORT = re.compile(
    r"^[ \t]*(?:from[ \t]+([\w.]+)[ \t]+import[ \t]+(\([^)]*\)|[^\n]*)|import[ \t]+([\w.]+))",
    re.MULTILINE,
)
_OWN = ("worldpose", "data_contracts")


def compile_kernel(function: Function) -> Function:
    """Return `function`, compiled to machine code on its first call and cached on disk if possible.

    No fast-math and no parallel loops: the same input gives the same bits on any number of
    threads. The interpreter lock is released, and division by zero gives infinity as in numpy.
    """
    given = config.CACHE_DIR  # type: ignore[attr-defined]
    folder = given or _cache_folder(_module_of(function))
    # Numba reads this setting while it decorates.
    config.CACHE_DIR = str(folder or "")  # type: ignore[attr-defined]
    is_cached = folder is not None
    try:
        return cast(Function, njit(cache=is_cached, nogil=True, error_model="numpy")(function))
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


def read_ahead(items: Iterable[Item], count: int) -> Iterator[Item]:
    """Yield items in order; a thread of their own computes up to `count` of them in advance."""
    source, end = iter(items), object()

    def take() -> Item | object:
        return next(source, end)

    with ThreadPoolExecutor(1) as thread:
        # With the caller's settings of numpy's warnings.
        waiting = deque(thread.submit(copy_context().run, take) for _ in range(count))
        try:
            while (item := waiting.popleft().result()) is not end:
                waiting.append(thread.submit(copy_context().run, take))
                yield cast(Item, item)
        finally:
            thread.shutdown(cancel_futures=True)


def _module_of(function: Function) -> str:
    """Return the module that defines a function, such as `worldpose.tracking.person`."""
    source = Path(function.__code__.co_filename).resolve()
    return ".".join(("worldpose", *source.relative_to(_PACKAGE).with_suffix("").parts))


@functools.cache
def _cache_folder(module: str) -> Path | None:
    """Return a cache folder that is unique to the sources on which a module's kernels can depend.

    None where no folder can be written to.

    Numba recompiles a kernel when its own file changes, but not when a kernel or constant from
    another file changes: it would then run machine code of the old source. Kernels of a module can
    depend on all modules that it imports, and on those that these import.
    """
    root = find_cache_folder().path
    if root is None:
        return None
    sources, waiting = dict[str, str](), [module]
    while waiting:
        name = waiting.pop()
        if name not in sources:
            sources[name] = _source(name) or ""
            waiting.extend(_imports(name))
    digest = hashlib.sha256("\0".join(text for _, text in sorted(sources.items())).encode())
    return root / f"kernels-{digest.hexdigest()[:16]}"


@functools.cache
def _imports(module: str) -> frozenset[str]:
    """Return the modules of worldpose and data_contracts from which a module takes names."""
    found = set()
    for origin, names, whole in _IMPORT.findall(_source(module) or ""):
        origin = origin or whole
        if origin.split(".")[0] in _OWN:
            found |= {_origin(origin, name) for name in re.findall(r"\w+", names)} or {origin}
    return frozenset(found - {module})


@functools.cache
def _origin(package: str, name: str) -> str:
    """Return the module that a name from a module or package comes from."""
    if _source(f"{package}.{name}") is not None:
        return f"{package}.{name}"
    if (_PACKAGE.parent.joinpath(*package.split(".")) / "__init__.py").is_file():
        for origin, names, _ in _IMPORT.findall(_source(package) or ""):
            if origin.split(".")[0] in _OWN and name in re.findall(r"\w+", names):
                return _origin(origin, name)
    return package


@functools.cache
def _source(module: str) -> str | None:
    """Return the source of a module or of a package's `__init__`; None if there is none."""
    place = _PACKAGE.parent.joinpath(*module.split("."))
    for file in (place.with_suffix(".py"), place / "__init__.py"):
        if file.is_file():
            return file.read_text(encoding="utf-8")
    return None


@compile_kernel
def _do_nothing() -> None:
    pass


def load_compiler() -> None:
    """Load what every process loads with its first kernel, which takes 0.4 s."""
    _do_nothing()
