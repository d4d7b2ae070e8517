"""Decorator that compiles numerical kernels to machine code (Numba)."""

from __future__ import annotations

import functools
import hashlib
import os
from collections.abc import Callable
from pathlib import Path
from typing import TypeVar, cast

from numba import njit
from numba.core import config

Function = TypeVar("Function", bound=Callable[..., object])


def compiled(function: Function) -> Function:
    """Return `function`, compiled to machine code on its first call and cached on disk.

    No fast-math and no parallel loops: the same input gives the same bits on any number of
    threads. The interpreter lock is released, and division by zero gives infinity as in numpy.
    """
    given = config.CACHE_DIR  # type: ignore[attr-defined]
    # Numba reads this setting while it decorates.
    config.CACHE_DIR = given or str(_cache_folder())  # type: ignore[attr-defined]
    try:
        return cast(Function, njit(cache=True, nogil=True, error_model="numpy")(function))
    finally:
        config.CACHE_DIR = given  # type: ignore[attr-defined]


@functools.cache
def _cache_folder() -> Path:
    """Return a cache folder that is unique to the state of the kernels' sources.

    Numba recompiles a kernel when its own file changes, but not when a kernel or constant from
    another file changes: it would then run machine code of the old source.
    """
    package = Path(__file__).parent
    digest = hashlib.sha256()
    for folder in sorted(path for path in package.iterdir() if path.is_dir()):
        sources = [source.read_bytes() for source in sorted(folder.rglob("*.py"))]
        if any(b"@compiled" in source for source in sources):
            for source in sources:
                digest.update(source)
    root = package if os.access(package, os.W_OK) else Path.home() / ".cache" / "worldpose"
    return root / "__pycache__" / f"kernels-{digest.hexdigest()[:16]}"
