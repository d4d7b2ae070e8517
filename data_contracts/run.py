"""Lineage: recipes, results and runs."""

from __future__ import annotations

from collections.abc import Mapping
from datetime import datetime
from typing import Final, Literal

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
from data_contracts.usability import Usability
from data_contracts.work import Recipe


class Project(Record):
    """project.json: what makes a folder or a bucket's prefix a project."""

    contract: Literal[1] = CONTRACT_VERSION
    store_format: str
    """Version of the encoding of arrays."""


class StoredFile(Record):
    """One file of a published result or a release."""

    path: str
    """Relative to the result's group or the manifest, with forward slashes."""
    size: Count
    """[byte]"""
    sha256: Digest


class ResultManifest(Record):
    """Written last: a result exists once this file lists all others with their checksums."""

    contract: Literal[1] = CONTRACT_VERSION
    key: Key
    recipe: Recipe
    files: tuple[StoredFile, ...]
    content: Digest
    """Digest of `files`; equal for repeated computations of one key."""
    figures: dict[str, float]
    """Quality metrics, with the unit in the name."""
    left_out: dict[Name, str] = {}
    """Static cameras that later stages must not use, by id, with the reason."""
    warnings: tuple[str, ...] = ()
    """Warnings that the run prints at its end."""
    created_at: datetime
    """Time of publication."""
    seconds: Amount
    """Computing time [s]."""
    run_id: Name
    """The run that computed it."""
    checksum: Digest
    """Digest of this record without `checksum`."""


class UnitFailure(Record):
    """A failed unit, which has no result."""

    unit: str
    """Stage and unit: `tracking/clip`."""
    error: str
    """Name of the error's class."""
    message: str
    """The error's message."""
    key: Key | None = None
    """Key of the missing result: the same key would fail in the same way."""


class Reservation(Record):
    """<run>.open.json: reserves a run's number; without <run>.json, the run has not finished."""

    contract: Literal[1] = CONTRACT_VERSION
    run_id: Name
    match_id: Name
    started_at: datetime
    host: str
    """Name of the run's machine."""
    pid: ProcessId
    """Process id on that machine."""
    process: str = ""
    """The machine's boot, and the process's start since then; empty where neither is told."""


class WaitingUnit(Record):
    """A unit whose result later stages may not use before its approval."""

    unit: str
    """Stage and unit: `tracking/clip`."""
    request: Name
    """Id of its `ReviewRequest`."""
    reasons: tuple[str, ...]
    """Reasons for the review."""
    rejected: bool = False
    """A reviewer rejected it; it waits for a correction."""


GatePolicy = Literal["auto", "always", "never"]
"""When results need approval: if metrics exceed their limits, always, or never."""

RunState = Literal["complete", "waiting", "partial", "failed"]
EXIT_CODES: Final[Mapping[RunState, int]] = {"complete": 0, "failed": 1, "waiting": 3, "partial": 4}
"""State of a run to the exit code of `worldpose run`."""


BODY_STAGES: Final = ("body_fitting", "refitting")
"""Stages that produce bodies, the best last."""
JOINT_STAGES: Final = ("triangulation", "retriangulation", *BODY_STAGES)
"""Stages that produce 3D joints, the best last."""


class RunRecord(Record):
    """One run of a match and the result of every unit."""

    contract: Literal[1] = CONTRACT_VERSION
    run_id: Name
    """Its number, from `0001`."""
    match_id: Name
    parent: Name | None
    """The previous run."""
    iteration: int = Field(default=1, ge=1, le=1000)
    """Pass over the method; from the second on, results of the previous one are input."""
    state: RunState
    """waiting: nothing failed, but results need approval; partial: some units failed, but units of
    the last requested stage have results, or bodies if stages after `body_fitting` were requested,
    which only add to bodies. Also partial: no unit failed, but too few cameras are left for later
    stages (`left_out`)."""
    results: dict[str, Key]
    """Unit, as `stage/unit`, to key."""
    settings: dict[str, dict[str, JsonValue]]
    """Stage to all its settings."""
    overrides: dict[str, dict[str, JsonValue]]
    """Stage to the requested settings; the others are defaults."""
    body_folder: str | None = None
    """Folder of installed bodies that the run was given; None = the default."""
    executed: tuple[str, ...]
    """Units, as `stage/unit`, that this run computed."""
    reused: tuple[str, ...]
    """Units whose results existed."""
    failed: tuple[UnitFailure, ...]
    """Units that have no result because their task failed."""
    blocked: tuple[str, ...]
    """Units without a result because an input has none, or needs approval."""
    gates: GatePolicy = "never"
    """When results needed approval."""
    waiting: tuple[WaitingUnit, ...] = ()
    """Units under review."""
    figures: dict[str, dict[str, float]]
    """Unit, as `stage/unit`, to quality metrics."""
    left_out: dict[Name, str] = {}
    """Static cameras that the run left out, by id, with the reason."""
    warnings: tuple[str, ...] = ()
    """Warnings about the results, one sentence each."""
    usability: Usability
    """Verdict on the results."""
    versions: dict[str, str]
    """Python and numeric libraries."""
    started_at: datetime
    finished_at: datetime
    seconds: Amount
    """Duration of the run [s]."""
