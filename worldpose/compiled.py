"""Machine code for numerical kernels (Numba), threads that run them, and reading in advance."""

from __future__ import annotations

import functools
import hashlib
import os
from collections import deque
from collections.abc import Callable, Iterable, Iterator
from concurrent.futures import Future, ThreadPoolExecutor
from contextvars import copy_context
from pathlib import Path
from typing import Literal, TypeVar, cast

from numba import njit
from numba.core import config

from worldpose.cache_folder import find_cache_folder
from worldpose.sources import code_version

Function = TypeVar("Function", bound=Callable[..., object])
Item = TypeVar("Item")
Result = TypeVar("Result")

_PACKAGE = Path(__file__).resolve().parent


def compile_kernel(function: Function) -> Function:
    """Return `function`, compiled to machine code on its first call and cached on disk if possible.

    No fast-math and no parallel loops: the same input gives the same bits on any number of
    threads. The interpreter lock is released, and division by zero gives infinity as in numpy.
    """
    return _compile(function, "never")


def inline_kernel(function: Function) -> Function:
    """Return `function`, compiled as `compile_kernel` does, and into each kernel that calls it.

    For short functions of scalars in inner loops: the call alone may take as long as they do.
    """
    return _compile(function, "always")


def _compile(function: Function, inline: Literal["never", "always"]) -> Function:
    given = config.CACHE_DIR  # type: ignore[attr-defined]
    folder = given or _cache_folder(_module_of(function))
    # Numba reads this setting while it decorates.
    config.CACHE_DIR = str(folder or "")  # type: ignore[attr-defined]
    cached = folder is not None
    try:
        compiled = njit(cache=cached, nogil=True, error_model="numpy", inline=inline)(function)
        return cast(Function, compiled)
    finally:
        config.CACHE_DIR = given  # type: ignore[attr-defined]


def map_in_threads(function: Callable[[Item], Result], items: Iterable[Item]) -> Iterator[Result]:
    """Yield the result for each item, in order; two threads compute them at the same time.

    Kernels and large numpy operations release the interpreter lock. Results are those of a loop:
    each item is computed by itself. At most two results wait, so memory stays flat.
    """
    waiting: deque[Future[Result]] = deque()
    # Threads of one unit: the only clip of a match uses two cores, and the units of many clips on a
    # large machine do not hinder each other.
    max_threads = 2
    with ThreadPoolExecutor(min(max_threads, os.cpu_count() or 1)) as threads:
        for item in items:
            # With the caller's settings of numpy's warnings.
            waiting.append(threads.submit(copy_context().run, function, item))
            if len(waiting) > max_threads:
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
    digest = hashlib.sha256("".join(code_version(module).values()).encode())
    return root / f"kernels-{digest.hexdigest()[:16]}"


@compile_kernel
def _do_nothing() -> None:
    pass


def load_compiler() -> None:
    """Load what every process loads with its first kernel, which takes 0.4 s."""
    _do_nothing()
