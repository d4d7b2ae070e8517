"""Content-addressed store of results: written atomically, verified on read, never overwritten.

Input: arrays that match a layout of `data_contracts`, and the recipe that they were computed by.
Output: labelled arrays, the runs that used them, and the reasons for differences between results.
"""

from typing import TYPE_CHECKING

from worldpose.lazy_names import import_on_use

if TYPE_CHECKING:
    from worldpose.store.garbage import Garbage, GcPlan, collect, plan_gc
    from worldpose.store.integrity import Finding, repair, verify
    from worldpose.store.paths import ResultId
    from worldpose.store.recipes import (
        RecipeDifference,
        code_version,
        libraries,
        recipe_differences,
        recipe_key,
    )
    from worldpose.store.runs import list_pins, pin_run, unpin_run
    from worldpose.store.store import Run, Store, open_run
    from worldpose.store.writer import ResultWriter

__all__ = [
    "Finding",
    "Garbage",
    "GcPlan",
    "RecipeDifference",
    "ResultId",
    "ResultWriter",
    "Run",
    "Store",
    "code_version",
    "collect",
    "libraries",
    "list_pins",
    "open_run",
    "pin_run",
    "plan_gc",
    "recipe_differences",
    "recipe_key",
    "repair",
    "unpin_run",
    "verify",
]

__getattr__ = import_on_use(
    __name__,
    {
        "worldpose.store.garbage": (
            "Garbage",
            "GcPlan",
            "collect",
            "plan_gc",
        ),
        "worldpose.store.integrity": (
            "Finding",
            "repair",
            "verify",
        ),
        "worldpose.store.paths": ("ResultId",),
        "worldpose.store.recipes": (
            "RecipeDifference",
            "code_version",
            "libraries",
            "recipe_differences",
            "recipe_key",
        ),
        "worldpose.store.runs": (
            "list_pins",
            "pin_run",
            "unpin_run",
        ),
        "worldpose.store.store": (
            "Run",
            "Store",
            "open_run",
        ),
        "worldpose.store.writer": ("ResultWriter",),
    },
)
