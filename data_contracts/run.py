"""Lineage: recipes, results and runs."""

from __future__ import annotations

from datetime import datetime
from typing import Literal

from pydantic import Field, JsonValue

from data_contracts.records import (
    CONTRACT_VERSION,
    Amount,
    Count,
    Digest,
    Key,
    Name,
    ProcessId,
    Record,
)
from data_contracts.work import Recipe


class Project(Record):
    """project.json: what makes a folder or a bucket's prefix a project."""

    contract: Literal[1] = CONTRACT_VERSION
    store_format: str
    """Version of the way arrays are written as bytes."""


class StoredFile(Record):
    """One file of a published result."""

    path: str
    """Relative to the result's group."""
    size: Count
    """[byte]"""
    sha256: Digest


class ResultManifest(Record):
    """Written last: a result exists when this file names every other with its checksum."""

    contract: Literal[1] = CONTRACT_VERSION
    key: Key
    recipe: Recipe
    files: tuple[StoredFile, ...]
    content: Digest
    """Digest of `files`: two honest computations of one key agree in it."""
    figures: dict[str, float]
    """Quality figures, with the unit in the name."""
    left_out: dict[Name, str] = {}
    """Static cameras that no later stage may use, by id, and why."""
    warnings: tuple[str, ...] = ()
    """What the run tells the user about this result at its end."""
    created_at: datetime
    """When it was published."""
    seconds: Amount
    """How long it took to compute [s]."""
    run_id: Name
    """The run that computed it."""
    checksum: Digest
    """Digest of this record without `checksum`."""


class UnitFailure(Record):
    """Why a unit of a run has no result."""

    unit: str
    """Stage and unit: `tracking/clip`."""
    error: str
    """Name of the error's class."""
    message: str
    """What the error said."""
    key: Key | None = None
    """Of the result that it would have had: the same key would fail in the same way."""


class Reservation(Record):
    """<run>.open.json: a run's number is taken; alone, the run has not finished."""

    contract: Literal[1] = CONTRACT_VERSION
    run_id: Name
    match_id: Name
    started_at: datetime
    host: str
    """Name of the machine the run is on."""
    pid: ProcessId
    """Its process there."""


class WaitingUnit(Record):
    """A unit whose result is there, and may not be built upon before a person approves it."""

    unit: str
    """Stage and unit: `tracking/clip`."""
    request: Name
    """Id of its `ReviewRequest`."""
    reasons: tuple[str, ...]
    """Why a person is asked."""
    rejected: bool = False
    """A person refused it: it waits for a correction."""


GatePolicy = Literal["auto", "always", "never"]
"""When a person is asked: where figures are beyond their limits, for every result, not at all."""

RunState = Literal["complete", "waiting", "partial", "failed"]


class RunRecord(Record):
    """One run of a match: which result stands for which unit."""

    contract: Literal[1] = CONTRACT_VERSION
    run_id: Name
    """Its number, `0001` the first."""
    match_id: Name
    parent: Name | None
    """The run before this one."""
    iteration: int = Field(default=1, ge=1, le=1000)
    """Which pass over the method; from the second on, results of the one before have a say."""
    state: RunState
    """waiting: nothing failed, but a person has to approve results; partial: some units failed, but
    units of the last stage asked for have results, or bodies where stages after `body_fitting` were
    asked for too: those add to bodies that are there without them. Also partial: no unit failed,
    but too few cameras are left for later stages (`left_out`)."""
    results: dict[str, Key]
    """Unit, as `stage/unit`, to key."""
    settings: dict[str, dict[str, JsonValue]]
    """Stage to all its settings."""
    overrides: dict[str, dict[str, JsonValue]]
    """Stage to the settings that were asked for; the others are defaults."""
    executed: tuple[str, ...]
    """Units, as `stage/unit`, that this run computed."""
    reused: tuple[str, ...]
    """Units whose results were there."""
    failed: tuple[UnitFailure, ...]
    """Units that have no result because their task failed."""
    blocked: tuple[str, ...]
    """Units that have no result because one that they are made from has none, or waits."""
    gates: GatePolicy = "never"
    """When a person was to be asked."""
    waiting: tuple[WaitingUnit, ...] = ()
    """Units that wait for review."""
    figures: dict[str, dict[str, float]]
    """Unit, as `stage/unit`, to quality figures."""
    left_out: dict[Name, str] = {}
    """Static cameras that the run did without, by id, and why."""
    warnings: tuple[str, ...] = ()
    """What the user must know about the results, one sentence each."""
    versions: dict[str, str]
    """Python and numeric libraries."""
    started_at: datetime
    finished_at: datetime
    seconds: Amount
    """How long the run took [s]."""
