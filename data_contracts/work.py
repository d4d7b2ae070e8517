"""Recipe of a result, and the work order of a task.

Separate from `run`: every task imports this module, so its code is part of every result's key.
"""

from __future__ import annotations

from typing import Literal

from pydantic import JsonValue

from data_contracts.records import CONTRACT_VERSION, Amount, Key, Name, Record, UnitName


class Recipe(Record):
    """All that determines a result; its digest is the result's key."""

    contract: Literal[1] = CONTRACT_VERSION
    match_id: Name
    stage: Name
    unit: UnitName
    sources: dict[str, JsonValue]
    """Input from the match folder: digests of files, and values such as the frame rate."""
    inputs: dict[str, Key]
    """Input results: `stage/unit` to key."""
    settings: dict[str, JsonValue]
    code: dict[str, str]
    """Source modules that compute it: module name to digest."""
    libraries: dict[str, str]
    """Numeric libraries that compute it: name to version."""

    @property
    def name(self) -> str:
        """Stage and unit: `tracking/clip`."""
        return f"{self.stage}/{self.unit}"


class Work(Record):
    """One unit of one stage, ready to be computed by a task."""

    project: str
    """Folder or URL of the store."""
    folder: str
    """The match folder; read by `ingest` and `static_calibration` alone."""
    recipe: Recipe
    key: Key
    run_id: Name
    seconds: Amount | None = None
    """Time limit; None = no limit [s]."""
    body_folder: str | None = None
    """Folder of installed body models; None = that of the worker."""
