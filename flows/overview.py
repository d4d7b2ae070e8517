"""Summaries of matches: what lists of them show, kept in the store and verified at each use.

A summary is derived from a match's folder, journal, runs, results and settings, and from the code.
It has their paths, and a digest of the times of their last changes. A summary with another digest
now is stale and is made again; so is one that is damaged or absent.
"""

from __future__ import annotations

import hashlib
import math
import os
import time
from collections import Counter
from collections.abc import Iterable, Iterator, Mapping
from contextlib import suppress
from dataclasses import dataclass, field
from datetime import UTC, datetime
from functools import cache
from pathlib import Path
from typing import Any, Final

from pydantic import JsonValue

from data_contracts.match import Registration
from data_contracts.operations import MatchSummary, Question, UnitSummary
from data_contracts.review import ReviewRecord, ReviewRequest
from data_contracts.run import RunRecord
from flows.gates import GATES
from flows.layers import PROJECT, VENUES, layer_path, match_layer, read_layer, read_layers
from flows.match_state import MatchState, describe_problem, match_state
from flows.method import METHOD
from flows.patience import SILENT_SECONDS, reach, read_in_time
from flows.registering import open_for_review
from flows.results.timings import Cost
from flows.review.corrections import objections_of
from flows.review.descriptions import is_first_click
from flows.review.metric_words import all_reasons
from flows.review.verdicts import reviews_of, still_waiting
from flows.run_record import latest_run, runs_at_work
from flows.run_status import run_status
from flows.settings import resolve
from flows.stage import Match
from worldpose.body.body_file import body_folder
from worldpose.errors import CorruptionError, InputError, StoreError, WorldposeError
from worldpose.review.journal import last_decision, read_journal, requests_by_id
from worldpose.store.blobs import changed_at
from worldpose.store.documents import seal, unseal
from worldpose.store.paths import record_path, registration_path, summary_path
from worldpose.store.recipes import libraries
from worldpose.store.runs import run_order
from worldpose.store.store import Run, Store

PAGE: Final = 50
"""Matches of a page."""
TURN_SECONDS: Final = 10.0
"""Between two looks at changes outside the project, unless there are too many matches."""
GLANCE_SECONDS: Final = 5.0
"""For so long, open pages with a list of matches share what was read."""
TICK_NS: Final = 20_000_000
"""Two changes within a clock tick of the file system have the same time [ns]."""
TURN_SHARE: Final = 0.2
"""Share of the time of a look after which it reads only matches that changed in the project."""
MOST_FILES: Final = 1000
"""Files of a match that are watched one by one; of more, such as images, the folders."""
BODIES = "body_fitting"
"""The stage whose bodies count as the poses of a project."""


def read_summary(store: Store, match_id: str, *, is_patient: bool = True) -> MatchSummary:
    """Return the summary of a match; made again unless the kept one is of what is there now.

    If a disk does not answer, it is silent: the kept one, with this problem. While a disk is slow,
    it is the kept one for who is not patient.
    """
    unseen = MatchSummary(match_id=match_id, is_unseen=True)
    found, is_silent = read_in_time(
        f"match {match_id} of {store.url}",
        store.blobs.marks([registration_path(match_id), *_own(match_id)]),
        lambda known: _read_summary(store, match_id, known),
        unseen,
        is_patient=is_patient,
    )
    if not is_silent:
        return found
    error = InputError(
        f"match {match_id}",
        expected="a disk of its folder that answers",
        found=f"no answer yet after {SILENT_SECONDS:g} s",
        todo="Look after the disk, or the network to it: what waits for it then continues.",
    )
    return _say_problem(found, error).model_copy(update={"is_silent": True, "is_unseen": False})


def _read_summary(store: Store, match_id: str, known: list[MatchSummary]) -> MatchSummary:
    """Return a summary as `read_summary`; the kept one is added to `known` before it is checked."""
    path = summary_path(match_id)
    with suppress(StoreError, InputError):  # it is damaged, or of another version
        data = store.blobs.read(path)
        kept = None if data is None else unseal(MatchSummary, data, path)
        if kept and kept.match_id == match_id:
            known.append(kept)
            for folder in [each for each in kept.watched if each.startswith("/")][:1]:
                reach(folder)
            if kept.made_from == _basis(store, kept)[0]:
                return kept
    return make_summary(store, match_id)


def make_summary(store: Store, match_id: str) -> MatchSummary:
    """Make and keep the summary of a match; its `problem` says what cannot be read.

    It is not kept if something changed meanwhile, or if the project cannot be written.
    """
    draft = MatchSummary(match_id=match_id)
    try:
        draft = _watch(store, draft)
        basis, newest = _basis(store, draft)
        if 0 <= time.time_ns() - newest < TICK_NS:
            time.sleep(1e-9 * TICK_NS)  # a later change has a later time
            basis, _ = _basis(store, draft)
        made = _summarize(store, draft)
        if _watch(store, made) == made and basis == _basis(store, made)[0]:
            made = made.model_copy(update={"made_from": basis})
            with suppress(StoreError):
                store.blobs.put(summary_path(match_id), seal(made))
        return made
    except (OSError, WorldposeError) as error:
        return _say_problem(draft, error)


@dataclass
class Overview:
    """The summaries of a project for lists, without their units.

    A match that changed in the project and was not read since is unseen. For changes outside the
    project, such as in match folders, the others are read in turn.
    """

    store: Store
    _heads: dict[str, MatchSummary] = field(default_factory=dict)
    _marks: dict[str, tuple[int, ...]] = field(default_factory=dict)
    _read_at: dict[str, float] = field(default_factory=dict)
    _recent: dict[str, tuple[float, MatchSummary]] = field(default_factory=dict)
    _at_work: set[str] = field(default_factory=set)

    def look(self, budget: float = math.inf) -> list[MatchSummary]:
        """Return all matches; at least one is read, changed ones first, and all in the budget [s].

        Without a change, a match is read again after `TURN_SECONDS`.
        """
        begun, there = time.monotonic(), self._list()
        for name in set(self._marks) - there.keys():
            self._marks.pop(name, None)
            self._heads.pop(name, None)
        turn = sorted(there, key=lambda name: self._read_at.get(name, -math.inf))
        changed = [name for name in turn if self._marks.get(name) != there[name]]
        changed.sort(key=lambda name: name not in self._heads)  # a moment ago, before the unknown
        old = [name for name in turn if begun - self._read_at.get(name, 0.0) > TURN_SECONDS]
        for number, name in enumerate(dict.fromkeys((*changed, *old))):
            share = 1.0 if number < len(changed) else TURN_SHARE
            if number and time.monotonic() - begun > share * budget:
                break
            if name not in self._at_work:  # of another thread
                self._read(name, there[name])
        return [
            self._heads[name]
            if self._marks.get(name) == mark
            else MatchSummary(match_id=name, is_unseen=True)
            for name, mark in there.items()
        ]

    def read(self, match_id: str) -> MatchSummary:
        """Return the whole summary of a match, as it is now."""
        return self._read(match_id, self._marks.get(match_id, ()))

    def glance(self, match_id: str) -> MatchSummary:
        """Return the whole summary of a match, as it was `GLANCE_SECONDS` ago or later."""
        now, kept = time.monotonic(), self._recent.get(match_id)
        if kept and kept[0] == self._read_at.get(match_id) and now - kept[0] < GLANCE_SECONDS:
            return kept[1]
        found = self.read(match_id)
        recent = {name: it for name, it in self._recent.items() if now - it[0] < GLANCE_SECONDS}
        # Replaced, not changed: other threads read it.
        self._recent = {**recent, match_id: (self._read_at[match_id], found)}
        return found

    def _list(self) -> dict[str, tuple[int, ...]]:
        """Return each match with the times of changes of its registration, runs and journal."""
        names = self.store.matches()
        paths = [path for name in names for path in (registration_path(name), *_own(name))]
        marks = iter(self.store.blobs.marks(paths))
        return dict(zip(names, zip(marks, marks, marks, strict=True), strict=True))

    def _read(self, name: str, mark: tuple[int, ...]) -> MatchSummary:
        self._at_work.add(name)
        try:
            found = read_summary(self.store, name, is_patient=False)
        finally:
            self._at_work.discard(name)
        slim: dict[str, Any] = {"stages": {}, "units": {}, "watched": (), "settings": {}}
        self._heads[name], self._read_at[name] = found.model_copy(update=slim), time.monotonic()
        self._marks[name] = mark  # last: without it the head is not used
        return found


def is_late(found: Iterable[MatchSummary]) -> bool:
    """Return whether some matches are still to be read."""
    return any(each.is_unseen for each in found)


def cost_of(match: MatchSummary) -> Cost:
    """Return core hours and bytes of all results of the latest run."""
    units = [unit for _, unit in units_of(match)]
    seconds = sum(unit.seconds or 0.0 for unit in units)
    return Cost(seconds / 3600.0, sum(unit.bytes for unit in units))


def units_of(match: MatchSummary) -> Iterator[tuple[str, UnitSummary]]:
    """Yield all units with their stage."""
    return ((stage, unit) for stage, units in match.stages.items() for unit in units)


def age(since: datetime | None) -> float:
    """Return the elapsed time [s]; never negative, even if the clock was changed."""
    return 0.0 if since is None else max(0.0, (datetime.now(UTC) - since).total_seconds())


def _own(match_id: str) -> tuple[str, str]:
    """Return the folders of the project in which runs and people's decisions appear."""
    return f"runs/{match_id}", f"reviews/{match_id}"


def _watch(store: Store, summary: MatchSummary) -> MatchSummary:
    """Return a summary with the files, folders and the open run that it depends on."""
    match_id = summary.match_id
    found = [registration_path(match_id), *_own(match_id), f"results/{match_id}"]
    found += [f"results/{match_id}/{stage.name}" for stage in METHOD]
    with suppress(OSError, WorldposeError):  # the summary says what cannot be read
        if last := read_journal(store, match_id).last:
            found.append(f"reviews/{match_id}/{last:06d}.json")
    runs = store.runs(match_id)
    found += [record_path(match_id, runs[-1])] if runs else []
    with suppress(OSError, WorldposeError):
        for name, key in (store.run(match_id, runs[-1]).results if runs else {}).items():
            found += [f"results/{match_id}/{name}", f"results/{match_id}/{name}/{key}"]
    with suppress(OSError, WorldposeError):
        if registration := store.registration(match_id):
            found += _files_of(registration)
            found += _settings_of(store, registration)
    run = ""
    for open_run in store.unfinished_runs(match_id)[-1:]:
        run = f"run {open_run.run_id} on {open_run.host} has not ended"
    watched = tuple(dict.fromkeys(found))
    return summary.model_copy(update={"watched": watched, "open_run": run})


def _files_of(registration: Registration) -> Iterator[str]:
    """Yield the match folder, its folders, and its files unless there are too many."""
    folder = Path(registration.folder)
    reach(str(folder))
    yield str(folder)
    if folder.is_dir():
        yield from sorted(each.path for each in os.scandir(folder) if each.is_dir())
    paths = [folder / file.path for file in registration.files]
    yield from sorted({str(path.parent) for path in paths})
    yield from map(str, paths if len(paths) <= MOST_FILES else (folder / "match.yaml",))


def _settings_of(store: Store, registration: Registration) -> Iterator[str]:
    """Yield the files of the layers of settings, and the files and folders that these can name.

    A file that is absent or cannot be parsed is among them: it can be added or corrected.
    """
    spec = registration.spec
    own = match_layer(spec.match_id)
    yield from (layer_path(PROJECT), layer_path(own), str(body_folder()))
    venue = read_layer(store, own).values.get("venue", spec.venue)
    if venue is not None:
        yield layer_path(f"{VENUES}/{venue}")
    for layer in read_layers(store, spec):
        yield from _paths_in(list(layer.values.values()))


def _paths_in(value: JsonValue) -> Iterator[str]:
    """Yield the paths that a value, or each of a list, can name: `/net.onnx`, `onnx:/net.onnx`."""
    if isinstance(value, list):
        for each in value:
            yield from _paths_in(each)
    elif isinstance(value, str) and value and "\0" not in value:
        path = value if value.startswith(("/", "~")) else value.partition(":")[2] or value
        # Of a path's `expanduser`, an unknown user is an error.
        yield str(Path(os.path.expanduser(path)).absolute())  # noqa: PTH111


def _basis(store: Store, summary: MatchSummary) -> tuple[str, int]:
    """Return a digest of what a summary was made from, and the time of the last change [ns]."""
    inside = [path for path in summary.watched if not path.startswith("/")]
    marks = store.blobs.marks(inside)
    marks += [changed_at(path) for path in summary.watched if path.startswith("/")]
    said = [code_digest(), os.environ.get("WORLDPOSE_BODY_FOLDER", ""), summary.open_run, *marks]
    if summary.open_run:  # it can end without a trace
        said += [run.run_id for run in runs_at_work(store, summary.match_id)]
    text = "\n".join(map(str, said))
    return hashlib.sha256(text.encode()).hexdigest()[:32], max(marks, default=0)


@cache
def code_digest() -> str:
    """Return a digest of the code and the libraries of this process, wherever it is installed."""
    top = Path(__file__).parents[1]
    found = hashlib.sha256(str(sorted(libraries().items())).encode())
    for package in ("data_contracts", "flows", "tasks", "worldpose"):
        for file in sorted((top / package).rglob("*.py")):
            found.update(f"{file.relative_to(top)}\n".encode() + file.read_bytes())
    return found.hexdigest()[:16]


def _summarize(store: Store, draft: MatchSummary) -> MatchSummary:
    """Return a summary with what the match, its runs and its journal say.

    OSError if a file cannot be read, WorldposeError if a record is damaged.
    """
    match_id, latest = draft.match_id, latest_run(store, draft.match_id)
    last = "" if latest is None else latest.run_id
    open_runs = store.unfinished_runs(match_id)
    begun = [run.started_at for run in open_runs if run_order(run.run_id) > run_order(last)]
    stages = {} if latest is None else list_units(store, latest)
    found: dict[str, Any] = {
        "latest": None if latest is None else latest.model_copy(update=NOT_KEPT),
        "stages": stages,
        "progress": {name: dict(Counter(it.state for it in stages[name])) for name in stages},
        "running_since": begun[-1] if begun else None,
        "poses": tuple(_bodies_of(store.run(match_id, it)) for it in store.runs(match_id)),
    }
    try:
        match = open_for_review(store, match_id)
    except (OSError, WorldposeError) as error:  # its runs are still shown
        return _say_problem(draft.model_copy(update=found), error)
    try:
        now = match_state(store, match)
    except (OSError, WorldposeError) as error:  # a setting can name a missing file
        now = describe_problem(error)
    first = sum(map(is_first_click, match.corrections))
    lost = 0 if latest is None else len(objections_of(Run(store, latest)))
    found |= {
        "waiting": tuple(_questions(store, match, latest)),
        "to_click": match.folder.to_click,
        "has_image": bool({*match.folder.stills, *match.folder.videos}),
        "corrections": len(match.corrections) - first,
        "first_clicks": first,
        "outdated": len(match.stale) + lost,
        "damage": match.journal.damage,
        "settings": resolve(match.layers).overrides,
        "is_settled": _is_settled(store, match_id),
    }
    return draft.model_copy(update=found | _say(now))


def _say_problem(summary: MatchSummary, error: OSError | WorldposeError) -> MatchSummary:
    return summary.model_copy(update=_say(describe_problem(error)) | {"problem": str(error)})


NOT_KEPT: Final[Mapping[str, Any]] = {
    **{name: {} for name in ("results", "settings", "figures", "versions")},
    **dict.fromkeys(("executed", "reused"), ()),
}
"""Fields of a run's record that its summary leaves out."""


def _say(state: MatchState) -> dict[str, Any]:
    return {
        "kind": state.name,
        **{name: getattr(state, name) for name in ("words", "why", "todo", "seconds")},
        "units": {kind.value: names for kind, names in state.units.items()},
    }


def _is_settled(store: Store, match_id: str) -> bool:
    """Return whether reprocessing has nothing to do; never if that could not be found out."""
    try:
        status = run_status(store, match_id)
    except (OSError, WorldposeError):
        return False
    return status is None or not status.is_stale


def _questions(store: Store, match: Match, latest: RunRecord | None) -> Iterator[Question]:
    known = {each.request.id: each for each in reviews_of(store, match, latest)}
    for unit in still_waiting(store, match, latest):
        review = known.get(unit.request)
        gate = None if review is None else GATES.get(review.request.gate)
        yield Question(
            id=unit.request,
            unit=unit.unit,
            reasons=unit.reasons,
            rejected=unit.rejected or (review is not None and review.state == "reject"),
            since=latest and latest.finished_at if review is None else review.request.created_at,
            excess=0.0 if gate is None or review is None else gate.excess(review.request.figures),
        )


def list_units(store: Store, run: RunRecord) -> dict[str, tuple[UnitSummary, ...]]:
    """Return the units of a run by stage, in the order of the method."""
    records = read_journal(store, run.match_id).questions
    asked = requests_by_id(records)
    units: dict[str, list[UnitSummary]] = {}
    for name, summary in (
        *((name, _result(store, run, name, records, asked)) for name in sorted(run.results)),
        *(
            (it.unit, UnitSummary(unit=_unit(it.unit), state="failed", why=it.message))
            for it in run.failed
        ),
        *((name, UnitSummary(unit=_unit(name), state="blocked")) for name in run.blocked),
    ):
        units.setdefault(name.partition("/")[0], []).append(summary)
    return {
        stage.name: tuple(sorted(units[stage.name], key=lambda unit: unit.unit))
        for stage in METHOD
        if stage.name in units
    }


def _result(
    store: Store,
    run: RunRecord,
    name: str,
    records: tuple[ReviewRecord, ...],
    asked: Mapping[str, ReviewRequest],
) -> UnitSummary:
    stage, _, unit = name.partition("/")
    try:
        manifest = store.manifest(run.match_id, stage, unit, run.results[name])
    except CorruptionError:
        raise
    except StoreError:  # a run computes it again
        return UnitSummary(unit=unit, state="failed", why="its result was withdrawn or removed")
    decision = last_decision(records, name, manifest.content)
    is_approved = decision is not None and decision.verdict == "approve"
    gate = GATES.get(stage)
    waits = next((each for each in run.waiting if each.unit == name), None)
    found = UnitSummary(
        unit=unit,
        state="done",
        seconds=manifest.seconds,
        figures=manifest.figures,
        objections=()
        if gate is None or is_approved
        else tuple(gate.objections(manifest.figures).values()),
        bytes=sum(file.size for file in manifest.files),
    )
    if waits is None or is_approved:
        return found
    request = asked.get(waits.request)
    since = run.finished_at if request is None else request.created_at
    why = all_reasons(waits.reasons)
    return found.model_copy(update={"state": "waiting", "waiting_since": since, "why": why})


def _unit(name: str) -> str:
    return name.partition("/")[2]


def _bodies_of(run: RunRecord) -> tuple[datetime, float]:
    fitted = [name for name in run.executed if name.partition("/")[0] == BODIES]
    return run.finished_at, sum(run.figures.get(name, {}).get("bodies", 0.0) for name in fitted)
