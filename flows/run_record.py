"""Run in progress, and the record that it leaves."""

from __future__ import annotations

import logging
import os
import platform
import time
from collections.abc import Callable, Iterable, Iterator, Mapping
from contextlib import contextmanager
from dataclasses import dataclass, field
from datetime import UTC, datetime
from types import MappingProxyType
from typing import Any, Final, Self

import psutil

from data_contracts.match import CameraSpec, ClipSpec
from data_contracts.run import (
    GatePolicy,
    Reservation,
    ResultManifest,
    RunRecord,
    RunState,
    UnitFailure,
)
from flows.gates import Gatekeeper
from flows.left_out import left_out_cameras, left_out_warnings
from flows.method import METHOD, unit_order
from flows.progress import reporter
from flows.review.edit_conflicts import EditedMeanwhileError
from flows.run_plan import PlannedUnit, RunPlan, lost_inputs, without_waiting
from flows.settings import Overrides, settings_of
from flows.stage import Match, Stage
from flows.stages import body_fitting, broadcast_calibration, tracking, triangulation
from flows.usability import RunOutcome, exceeded_limits, judge_run, usable_limits
from tasks.tracing import add_unit_span, stage_span
from worldpose.errors import InputError
from worldpose.ingest.match_folder import MatchFolder
from worldpose.store.recipes import libraries
from worldpose.store.runs import alone, identify_process
from worldpose.store.store import Store

ComputeUnits = Callable[
    [Stage, list[PlannedUnit]], Iterable[tuple[PlannedUnit, BaseException | None]]
]
"""Computes those of a stage's planned units that have no result, and yields each unit when it ends,
with its exception if it failed."""


def latest_run(store: Store, match_id: str) -> RunRecord | None:
    """Return the match's latest finished run, None before the first."""
    return store.run(match_id) if store.runs(match_id) else None


def describe_end(record: RunRecord) -> str:
    """Return a sentence about how a run ended that is not complete."""
    counts = (
        (len(record.failed), "unit failed", "units failed"),
        (len(record.waiting), "waits for review", "wait for review"),
        (len(record.blocked), "is blocked", "are blocked"),
    )
    said = [f"{count} {one if count == 1 else many}" for count, one, many in counts if count]
    if record.state == "partial" and not record.failed:
        said = [f"partial, not all stages have results. {' '.join(record.warnings)}", *said]
    elif record.state == "partial":
        said = ["partial", *said]
    first = f". {record.failed[0].unit}: {record.failed[0].message}" if record.failed else ""
    return f"run {record.run_id} of {record.match_id}: {', '.join(said)}{first}"


LOG: Final = logging.getLogger("worldpose.operations")
LOOK_SECONDS: Final = 1.0
"""Between two looks for the end of another run [s]."""
MOST_SECONDS: Final = 86400.0
"""Time after which a wait for another run of the match ends [s]."""
CLOCK_SECONDS: Final = 5.0
"""Tolerance between the clocks of a process table and of records without `process` [s]."""


def runs_at_work(store: Store, match_id: str) -> tuple[Reservation, ...]:
    """Return the runs of a match that other processes of this machine compute now."""

    def is_at_work(run: Reservation) -> bool:
        if run.host != platform.node() or run.pid == os.getpid():
            return False
        try:  # a later process may have got the number of a killed run's process
            process = psutil.Process(run.pid)
            is_same = identify_process(run.pid) == run.process
            if not run.process:
                is_same = process.create_time() <= run.started_at.timestamp() + CLOCK_SECONDS
            return bool(is_same and process.status() != psutil.STATUS_ZOMBIE)
        except psutil.Error:
            return False

    return tuple(run for run in store.unfinished_runs(match_id) if is_at_work(run))


class AtWorkError(InputError):
    """Another process runs the match."""


@contextmanager
def alone_with(store: Store, match_id: str, *, wait: bool = False) -> Iterator[None]:
    """Hold a match, so that no other process of this machine runs it; or wait until none does.

    Every door that runs a match holds it, from before its settings are read to its record.
    AtWorkError if another process runs it, and this one does not wait, or has for `MOST_SECONDS`.
    """
    said, begun = LOG.info, datetime.now(UTC)
    end = time.monotonic() + MOST_SECONDS
    while True:  # not one long wait: a process that hangs uses no processor time
        with alone(store.blobs, f"match-{match_id}", wait=False) as is_held:
            is_over = not wait or time.monotonic() >= end
            runs = runs_at_work(store, match_id) if is_held or is_over else ()
            if is_held and not runs:
                yield
                return
        if is_over:
            found = [
                f"run {run.run_id}, process {run.pid}, since {run.started_at:%Y-%m-%d %H:%M:%S} UTC"
                for run in runs
            ]
            other = "another process that runs it, perhaps elsewhere"
            other += f", since before {begun:%Y-%m-%d %H:%M:%S} UTC" if wait else ""
            raise AtWorkError(
                f"match {match_id}",
                expected="no run of it at work",
                found=found[0] if found else other,
                todo=f"Wait for its end; or end that process, which holds {store.url}/locks/match-"
                f"{match_id}.lock: its finished results are kept.",
            )
        said("%s: another run of it is at work; this one continues after it", match_id)
        said = LOG.debug
        time.sleep(LOOK_SECONDS)


UNIT_SECONDS: Final[Mapping[str, float]] = MappingProxyType(
    {
        "ingest": 0.1,
        "static_calibration": 0.1,
        "tracking": 2.8,
        "triangulation": 10.9,
        "retriangulation": 10.9,
        "bundle_adjustment": 7.6,
        "body_fitting": 34.1,
        "refitting": 34.1,
        "filtering": 4.9,
        "broadcast_calibration": 40.0,
        "broadcast_tracking": 10.0,
    }
)
"""Stage to the time of a unit in a match's first run, for the progress [s]: of a 20 s clip in 16
cameras; other clips in proportion. A detector's time depends on its net and device."""
DETECTION_SECONDS: Final = 0.6
"""Time of one frame of 1920 x 1080 pixels; others in proportion [s]."""
PAINT_SECONDS: Final = 15.0
"""Time to calibrate a static camera with an image, whose painted lines are used [s]."""
_FULL_HD: Final = 1920 * 1080


def expected_work(
    store: Store, match: Match, missing: Iterable[PlannedUnit], latest: RunRecord | None
) -> dict[str, float]:
    """Return the expected computation time of missing units by stage, from the latest run's [s].

    The sizes of the match tell the time of a first run.
    """
    spec = match.folder.spec
    cameras = {each.id: each for each in spec.cameras}
    clips = {each.id: each for each in spec.clips}
    results = {} if latest is None else latest.results
    before: dict[str, float] = {}
    for stage, unit in dict(name.split("/", 1) for name in results).items():
        place = (match.match_id, stage, unit, results[f"{stage}/{unit}"])
        if store.has(*place):
            before[stage] = store.manifest(*place).seconds
    work: dict[str, float] = {}
    for stage, unit in (planned.name.split("/", 1) for planned in missing):
        seconds = before.get(stage)
        if seconds is None:
            parts = unit.split(".")
            camera = next((cameras[name] for name in parts if name in cameras), None)
            clip = next((clips[name] for name in parts if name in clips), None)
            seconds = first_seconds(match.folder, stage, camera, clip)
        work[stage] = work.get(stage, 0.0) + max(seconds, 1e-3)
    return work


def first_seconds(
    folder: MatchFolder, stage: str, camera: CameraSpec | None, clip: ClipSpec | None
) -> float:
    """Return the expected computation time of a unit that has never been computed [s]."""
    spec = folder.spec
    if stage in ("detection", "redetection") and camera is not None and clip is not None:
        pixels = camera.width * camera.height / _FULL_HD
        return DETECTION_SECONDS * pixels * clip.frame_count * (camera.fps or spec.fps) / spec.fps
    if stage in ("proposal", "static_calibration") and camera is not None:
        has_image = camera.id in folder.stills or camera.id in folder.videos
        return PAINT_SECONDS if has_image else UNIT_SECONDS["static_calibration"]
    seconds = UNIT_SECONDS.get(stage, 1.0)
    if clip is None or stage == "ingest":
        return seconds
    cameras = sum(each.kind == "static" for each in spec.cameras)
    share = 1.0 if stage.startswith("broadcast") else max(cameras, 1) / 16.0
    return seconds * share * clip.frame_count / spec.fps / 20.0


@dataclass
class RunLog:
    """Units that a run has reused, computed and failed to compute so far.

    `close` turns it into the stored record; until then the run counts as unfinished. Units have the
    name `stage/unit`; `latest` is the match's latest run before this one, and `started` is
    `started_at` by the monotonic clock [s].
    """

    plan: RunPlan
    gatekeeper: Gatekeeper
    run_id: str
    latest: RunRecord | None
    started_at: datetime = field(default_factory=lambda: datetime.now(UTC))
    started: float = field(default_factory=time.monotonic)
    executed: list[str] = field(default_factory=list)
    reused: list[str] = field(default_factory=list)
    failed: list[UnitFailure] = field(default_factory=list)
    figures: dict[str, dict[str, float]] = field(default_factory=dict)
    warnings: dict[str, tuple[str, ...]] = field(default_factory=dict)

    @classmethod
    def begin(
        cls,
        store: Store,
        match: Match,
        stages: tuple[Stage, ...],
        overrides: Overrides,
        gates: GatePolicy = "never",
        iteration: int = 1,
    ) -> Self:
        """Reserve a new run; the latest run supplies the results of earlier stages."""
        latest = latest_run(store, match.match_id)
        gatekeeper = Gatekeeper(store, match, gates)
        plan = RunPlan.begin(gatekeeper, stages, overrides, latest, iteration)
        if plan.before is not None and (lost := lost_inputs(store, match, stages, plan.before)):
            raise EditedMeanwhileError(
                f"another iteration of {match.match_id}",
                expected="the results of the previous iteration",
                found=f"none of {', '.join(lost)}",
                todo=f"Restart the iterations: worldpose run {match.match_id} --iterations N.",
            )
        run_id = store.reserve_run(match.match_id)
        for unit in plan.waiting:
            reporter().unit_waits(unit.unit, unit.reasons)
        return cls(plan, gatekeeper, run_id, latest, reused=list(plan.results))

    @property
    def store(self) -> Store:
        """The store of the results."""
        return self.plan.store

    @property
    def match(self) -> Match:
        """The match as it was when the run began."""
        return self.plan.match

    def run_stages(self, compute: ComputeUnits) -> RunRecord:
        """Plan and compute the stages of the run in order; return its stored record."""
        for stage in self.plan.stages:
            units = self.plan.plan_stage(stage)
            self.reuse(unit for unit in units if unit.published)
            with stage_span(stage.name, len(units)):
                for unit, failure in compute(stage, units):
                    self.finish_unit(unit, failure)
            for held in self.plan.hold(stage, self.plan.results):
                reporter().unit_waits(held.unit, held.reasons)
        return self.close()

    def reuse(self, units: Iterable[PlannedUnit]) -> None:
        """Take over results that the store already holds."""
        for unit in units:
            self.plan.add_results([unit])
            self.reused.append(unit.name)

    def finish_unit(self, unit: PlannedUnit, failure: BaseException | None) -> None:
        """Record that a unit's task has ended."""
        if failure is None:
            self.plan.add_results([unit])
            self.executed.append(unit.name)
            manifest = self._read_manifest(unit.name)
            at, seconds = manifest.created_at, manifest.seconds
            add_unit_span(unit.name, unit.key, at, seconds, manifest.figures)
            reporter().unit_done(unit.name, seconds, manifest.figures)
        else:
            message = str(failure) or type(failure).__name__
            self.failed.append(
                UnitFailure(
                    unit=unit.name, error=type(failure).__name__, message=message, key=unit.key
                )
            )
            reporter().unit_failed(unit.name, message)

    def _read_manifest(self, name: str) -> ResultManifest:
        """Keep metrics and warnings of a result, and return its manifest."""
        stage, _, unit = name.partition("/")
        manifest = self.store.manifest(self.match.match_id, stage, unit, self.plan.results[name])
        self.figures[name] = manifest.figures
        self.warnings[name] = manifest.warnings
        return manifest

    def close(self) -> RunRecord:
        """Store the record: the run is then finished, and its review requests are created."""
        blocked = tuple(sorted(self.plan.blocked))  # without those of stages not asked for
        self._carry_over()
        for name in self.plan.results.keys() - self.figures.keys():
            self._read_manifest(name)
        left_out = left_out_cameras(self.store, self.match, METHOD, self.plan.usable_results)
        settings, overrides = self._settings()
        state, limits = self._state(), usable_limits(self.match)
        figures = {name: self.figures[name] for name in sorted(self.plan.results, key=unit_order)}
        lost = left_out_warnings(self.match, left_out, tracking.MIN_CAMERAS)
        said = {name: self.warnings[name] for name in figures}
        outcome = RunOutcome(
            figures=figures,
            warnings=said,
            left_out=lost,
            failed=self.failed,
            lacks_results=state == "failed",
            lacks_people=self.plan.lacks_cameras or self._lacks_people(),
            lacks_joints=self._lacks(triangulation.STAGE, "joints"),
            waiting=len(self.plan.waiting),
        )
        record = RunRecord(
            run_id=self.run_id,
            match_id=self.match.match_id,
            parent=None if self.latest is None else self.latest.run_id,
            iteration=self.plan.iteration,
            state=state,
            results=dict(sorted(self.plan.results.items())),
            settings=settings,
            overrides=overrides,
            body_folder=None if self.match.body_folder is None else str(self.match.body_folder),
            executed=tuple(sorted(self.executed)),
            reused=tuple(sorted(self.reused)),
            failed=tuple(sorted(self.failed, key=lambda failure: failure.unit)),
            blocked=blocked,
            gates=self.gatekeeper.policy,
            waiting=tuple(self.plan.waiting),
            figures=dict(sorted(self.figures.items())),
            left_out=left_out,
            warnings=(
                *lost,
                *broadcast_calibration.uncalibrated_warnings(self.match),
                *(text for warnings in said.values() for text in warnings),
                *exceeded_limits(figures, limits),
            ),
            usability=judge_run(outcome, limits),
            versions=libraries(),
            started_at=self.started_at,
            finished_at=datetime.now(UTC),
            seconds=round(time.monotonic() - self.started, 3),
        )
        self.gatekeeper.ask(self.run_id, self.plan.waiting, self.plan.results)
        self.store.finish_run(record)
        if os.environ.get("OPENLINEAGE_URL"):
            from flows.openlineage import tell_lineage  # few runs need it

            tell_lineage(self.store, record)
        return record

    def _carry_over(self) -> None:
        """Keep results of later stages that are still current, and their open questions."""
        asked = set() if self.latest is None else {each.request for each in self.latest.waiting}
        for stage in METHOD[METHOD.index(self.plan.stages[-1]) + 1 :]:
            units = self.plan.plan_stage(stage)
            current = {unit.name: unit for unit in units if unit.published}
            keys = {name: unit.key for name, unit in current.items()}
            held = self.gatekeeper.list_held_units(stage.name, keys)
            self.plan.waiting += (each for each in held if each.request in asked)
            new = [each for each in held if each.request not in asked]
            self.reuse(current[name] for name in without_waiting(keys, new))

    def _settings(self) -> tuple[dict[str, dict[str, Any]], dict[str, dict[str, Any]]]:
        """Return all settings and the overrides, by stage; stages that did not run keep theirs."""
        first = METHOD.index(self.plan.stages[0])
        settings = {
            stage.name: settings_of(stage, self.plan.overrides).model_dump(mode="json")
            for stage in METHOD
        }
        overrides = {name: dict(values) for name, values in self.plan.overrides.items()}
        if self.latest is not None:
            for stage in METHOD[:first]:
                settings[stage.name] = self.latest.settings[stage.name]
                overrides.pop(stage.name, None)
                if stage.name in self.latest.overrides:
                    overrides[stage.name] = self.latest.overrides[stage.name]
        return settings, overrides

    def _lacks_people(self) -> bool:
        """Return whether a stage of this run found no person in any clip."""
        stages = tracking.STAGE, broadcast_calibration.TRACKING
        return any(self._lacks(stage, "people") for stage in stages)

    def _lacks(self, stage: Stage, figure: str) -> bool:
        """Return whether a stage of this run found none of what a metric counts, in any clip."""
        clips = [f"{stage.name}/{unit}" for unit in stage.units(self.match)]
        found = [self.figures.get(clip, {}).get(figure) for clip in clips]
        return stage in self.plan.stages and bool(found) and all(count == 0 for count in found)

    def _state(self) -> RunState:
        if not self.failed:
            if self.plan.waiting:
                return "waiting"
            lacks = self.plan.lacks_cameras or self._lacks_people()
            return "partial" if lacks or self._lacks(triangulation.STAGE, "joints") else "complete"
        asked = [stage.name for stage in self.plan.stages if stage.units(self.match)]
        through = [stage.name for stage in METHOD[: METHOD.index(body_fitting.STAGE) + 1]]
        last = next((name for name in reversed(asked) if name in through), asked[-1])
        there = any(name.startswith(f"{last}/") for name in self.plan.results)
        return "partial" if there else "failed"
