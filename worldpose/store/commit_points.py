"""Named places in the life of a result where a test may kill the process or fail the disk."""

from __future__ import annotations

from collections.abc import Callable

COMMIT_POINTS = (
    "before_write",
    "after_write",
    "before_publish",
    "during_publish",
    "before_commit",
    "after_commit",
    "before_run_record",
    "after_run_record",
)
"""In the order they are reached.

`before_write`, `after_write`: around the arrays in private staging. `before_publish`: all is hashed
and nothing lies outside staging. `during_publish`: some data is durable, no manifest anywhere.
`before_commit`, `after_commit`: around the one atomic step that makes the result exist, which is a
rename in a folder and the manifest's creation in object storage. `before_run_record`,
`after_run_record`: around the creation of the run's record.
"""

_hook: Callable[[str], None] | None = None


def install_fault_hook(hook: Callable[[str], None] | None) -> None:
    """Calls `hook` with the name of every commit point reached from now on; None removes it.

    For fault tests only: nothing in the product installs one.
    """
    global _hook
    _hook = hook


def reached(point: str) -> None:
    """Tells the installed hook, if any, that the process is at `point`."""
    if _hook is not None:
        _hook(point)
