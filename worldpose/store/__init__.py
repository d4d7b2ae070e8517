"""Keeps results by what they were made from: whole or not at all, checked, never overwritten.

Takes arrays that fit a layout of `data_contracts` and the recipe they were made by; gives them
back as labelled arrays, with what runs used them and why a result is another than before.
"""

from worldpose.store.comparison import compare_stores
from worldpose.store.fingerprint import code_version, libraries
from worldpose.store.garbage import Garbage, GcPlan, collect, plan_gc
from worldpose.store.integrity import Finding, repair, verify
from worldpose.store.opened_run import Run, open_run
from worldpose.store.paths import ResultId
from worldpose.store.pins import list_pins, pin_run, unpin_run
from worldpose.store.recipes import explain_difference, key_of
from worldpose.store.store import Store
from worldpose.store.writer import ResultWriter

__all__ = [
    "Finding",
    "Garbage",
    "GcPlan",
    "ResultId",
    "ResultWriter",
    "Run",
    "Store",
    "code_version",
    "collect",
    "compare_stores",
    "explain_difference",
    "key_of",
    "libraries",
    "list_pins",
    "open_run",
    "pin_run",
    "plan_gc",
    "repair",
    "unpin_run",
    "verify",
]
