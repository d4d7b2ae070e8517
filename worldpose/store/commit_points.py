"""Named points in the publication of a result at which a test can inject faults."""

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
"""In execution order.

`before_write`, `after_write`: around the arrays in private staging. `before_publish`: all is hashed
and nothing is outside staging. `during_publish`: some data is durable, no manifest anywhere.
`before_commit`, `after_commit`: around the one atomic step that makes the result exist, which is a
rename in a folder and the manifest's creation in object storage. `before_run_record`,
`after_run_record`: around the creation of the run's record.
"""

_hook: Callable[[str], None] | None = None


def install_fault_hook(hook: Callable[[str], None] | None) -> None:
    """Call `hook` with the name of every commit point reached from now on; None removes it.

    For fault tests only: no product code installs one.
    """
    global _hook
    _hook = hook


def reached(point: str) -> None:
    """Call the installed hook, if any, with the name of the current `point`."""
    if _hook is not None:
        _hook(point)
