"""Names of a package that are imported on first use, so that a command imports what it needs.

Settings and the readers of a match folder take milliseconds to import, an estimator takes up to a
second. A command that only plans needs the settings of all stages and no estimator.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from importlib import import_module


def import_on_use(package: str, modules: Mapping[str, tuple[str, ...]]) -> Callable[[str], object]:
    """Return the `__getattr__` of a package (PEP 562) that imports each name on first use.

    Args:
        package: its name, `__name__`.
        modules: names by the module that defines them; type checkers read the imports under
            `TYPE_CHECKING`, which a test compares with these.
    """
    homes = {name: module for module, names in modules.items() for name in names}

    def import_name(name: str) -> object:
        if name not in homes:
            raise AttributeError(f"module {package!r} has no attribute {name!r}")
        return getattr(import_module(homes[name]), name)

    return import_name
