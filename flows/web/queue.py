"""Pending reviews of all matches: age, reason and severity."""

from __future__ import annotations

import time
from collections.abc import Hashable
from dataclasses import dataclass, field
from math import isfinite
from pathlib import Path
from threading import Lock
from typing import Any, Final

from fastapi import APIRouter

from data_contracts.review import ReviewRequest
from data_contracts.static_calibration import ClickedMarkings
from flows.gates import GATES
from flows.layers import read_layer
from flows.match_state import describe_problem, match_state
from flows.method import METHOD
from flows.review.descriptions import review_json
from flows.review.verdicts import Review, reviews_of, still_waiting
from flows.run_record import latest_run
from flows.service.overview import MANY
from flows.stage import Match
from flows.web.app_context import PageContext
from flows.web.browser_words import describe_error, in_browser
from flows.web.calibration import key_frames
from flows.web.corrections import count_corrections, describe_groups
from worldpose.errors import WorldposeError
from worldpose.review.journal import read_journal
from worldpose.store.store import Store

BUDGET_SECONDS: Final = 0.25
"""Time that one request spends on changed matches; the page asks again for the others."""
REREAD_SECONDS: Final = 60.0
"""Age at which a summary is made again without a change: a video can be removed."""
ALWAYS_CHECKED: Final = 8
"""Matches that every request checks, unless there are `MANY`."""


def routes(context: PageContext) -> APIRouter:
    """Create the routes of the queue and of one match."""
    router = APIRouter(prefix="/api/matches")
    glances = _Glances(context)

    @router.get("")
    def matches() -> dict[str, Any]:
        return glances.look()

    @router.get("/{match_id}")
    def match(match_id: str) -> dict[str, Any]:
        opened = context.match(match_id)
        latest = latest_run(context.store, match_id)
        folder = opened.folder
        return {
            **_glance(context, opened),
            "reviews": [
                describe_review(each) for each in reviews_of(context.store, opened, latest)
            ],
            "groups": describe_groups(opened),
            "cameras": [
                {
                    "id": camera.id,
                    "given": camera.id in folder.calibrations,
                    "clicks": _clicks(opened, camera.id),
                    "has_picture": camera.id in folder.stills or camera.id in folder.videos,
                    "figures": _figures(context, opened, camera.id),
                }
                for camera in folder.spec.static_cameras
            ],
            "clips": [
                _clip(context, opened, name)
                for clip in folder.spec.clips
                for name in dict.fromkeys((clip.id, *folder.spec.views_of(clip.id)))
            ],
            "failures": [
                {**each.model_dump(), "message": " ".join(in_browser(each.message).split())}
                for each in (() if latest is None else latest.failed)
            ],
            "stages": [stage.name for stage in METHOD if stage.units(opened)],
            "left_out": {} if latest is None else latest.left_out,
            "warnings": [] if latest is None else [in_browser(each) for each in latest.warnings],
        }

    return router


@dataclass
class _Glances:
    """Summaries of all matches for the queue; one request checks as many as its time allows.

    A match is opened again only if its folder, journal or runs have changed.
    """

    context: PageContext
    _known: dict[str, tuple[Hashable, dict[str, Any]]] = field(default_factory=dict)
    _folders: dict[str, Path] = field(default_factory=dict)
    _layers: dict[str, list[str]] = field(default_factory=dict)
    _checked: dict[str, float] = field(default_factory=dict)
    _opened: dict[str, float] = field(default_factory=dict)
    _lock: Lock = field(default_factory=Lock)

    def look(self) -> dict[str, Any]:
        """Return all matches, those not seen yet by name only, and how many are still to check."""
        names = self.context.store.matches()
        with self._lock:
            begun = time.monotonic()
            oldest = sorted(names, key=lambda name: self._checked.get(name, 0.0))
            left = len(oldest)
            for number, name in enumerate(oldest):
                is_late = time.monotonic() - begun > BUDGET_SECONDS
                if is_late and number and (number >= ALWAYS_CHECKED or len(names) > MANY):
                    break
                self._check(name)
                self._checked[name] = time.monotonic()
                left -= 1
            found = [
                dict(self._known[name][1]) if name in self._known else _unseen(name)
                for name in names
            ]
        for each in found:
            # The progress of a run changes all the time.
            each["at_work"] = _local_run(self.context, each["match"]) or each["elsewhere"]
        return {"matches": found, "left": left}

    def _check(self, name: str) -> None:
        stamp = self._stamp(name)
        is_old = time.monotonic() - self._opened.get(name, -REREAD_SECONDS) >= REREAD_SECONDS
        if stamp is not None and not is_old and self._known[name][0] == stamp:
            return
        self._opened[name] = time.monotonic()
        try:
            match = self.context.match(name)
            glance = _glance(self.context, match)
        except (OSError, WorldposeError) as error:
            glance = {"match": name, "problem": describe_error(error), "waiting": [], "run": None}
            stamp = None
        else:
            self._folders[name] = match.folder.folder
            self._layers[name] = [each.name for each in match.layers if each.is_stored]
            stamp = stamp or self._stamp(name)
        glance["elsewhere"] = _elsewhere(self.context.store, name)
        self._known[name] = (stamp, glance)

    def _stamp(self, name: str) -> Hashable:
        """Return what a summary depends on; None if it must be read again."""
        store, folder = self.context.store, self._folders.get(name)
        if folder is None:
            return None
        try:
            journal = read_journal(store, name)
            files = sorted((folder / "annotations").rglob("*.json"))
            times = [file.stat().st_mtime_ns for file in (folder / "match.yaml", *files)]
            listed = folder.stat().st_mtime_ns
            layers = [read_layer(store, each).revision for each in self._layers[name]]
        except (OSError, WorldposeError):
            return None
        at_work = tuple(each.run_id for each in store.unfinished_runs(name))
        return (journal.last, store.runs(name), at_work, listed, *times, *layers)


def _unseen(name: str) -> dict[str, Any]:
    return {
        "match": name,
        "problem": None,
        "is_unseen": True,
        "waiting": [],
        "run": None,
        "elsewhere": None,
    }


def describe_review(review: Review) -> dict[str, Any]:
    """Return one review request as JSON for the pages."""
    (unit,) = review.request.keys
    return {**review_json(review), "unit": unit, "excess": _excess(review.request)}


def _glance(context: PageContext, match: Match) -> dict[str, Any]:
    store = context.store
    latest = latest_run(store, match.match_id)
    known = {each.request.id: each for each in reviews_of(store, match, latest)}
    waiting = []
    for unit in still_waiting(store, match, latest):
        review = known.get(unit.request)
        waiting.append(
            {
                "id": unit.request,
                "unit": unit.unit,
                "reasons": unit.reasons,
                "rejected": unit.rejected or (review is not None and review.state == "reject"),
                "since": None if review is None else review.request.created_at,
                "excess": 0.0 if review is None else _excess(review.request),
            }
        )
    folder = match.folder
    corrections, first_clicks = count_corrections(match)
    return {
        "match": match.match_id,
        "problem": None,
        "damage": match.journal.damage,
        "run": None
        if latest is None
        else {
            "id": latest.run_id,
            "state": latest.state,
            "finished_at": latest.finished_at,
            "gates": latest.gates,
            "usability": {
                "verdict": latest.usability.verdict,
                "reservations": [in_browser(each) for each in latest.usability.reservations],
            },
            "failed": len(latest.failed),
        },
        "waiting": waiting,
        "to_click": list(folder.to_click),
        "has_image": bool({*folder.stills, *folder.videos}),
        "corrections": corrections,
        "first_clicks": first_clicks,
        "stale": len(match.stale),
        "state": _state(store, match),
        "at_work": _local_run(context, match.match_id) or _elsewhere(store, match.match_id),
    }


def _state(store: Store, match: Match) -> dict[str, Any]:
    """Return the state of a match as JSON, with the numbers of its units as the command has them.

    While a run of these pages is at work, the pages show its progress in place of this state.
    """
    try:
        found = match_state(store, match)
    except (OSError, WorldposeError) as error:  # a setting can name a missing file
        found = describe_problem(error)
    return {
        "name": found.name,
        "words": found.words,
        "why": in_browser(found.why),
        "todo": found.todo,
        "seconds": found.seconds,
        "units": {state.value: len(names) for state, names in found.units.items()},
    }


def _local_run(context: PageContext, match_id: str) -> dict[str, Any] | None:
    state = context.continuing.state(match_id)
    if state is None:
        return None
    return {**state, "lines": [in_browser(line) for line in state["lines"]]}


def _elsewhere(store: Store, match_id: str) -> dict[str, Any] | None:
    open_runs = store.unfinished_runs(match_id)
    if not open_runs:
        return None
    last = open_runs[-1]
    return {"state": "elsewhere", "lines": [f"run {last.run_id} on {last.host} has not ended"]}


def _clip(context: PageContext, match: Match, clip: str) -> dict[str, Any]:
    """Return a clip or broadcast view with its key frames: clicked, and those to click next."""
    latest = latest_run(context.store, match.match_id)
    key = None if latest is None else latest.results.get(f"broadcast_calibration/{clip}")
    pick_next = []
    if key is not None:
        result = context.store.open_result(match.match_id, "broadcast_calibration", clip, key)
        pick_next = [int(frame) for frame in result.attrs["pick_next"]]
    folder = match.folder
    spec = next((each for each in folder.spec.clips if each.id == clip), None)
    owners = [camera.id for camera in folder.spec.static_cameras]
    owners += [] if spec is None else folder.spec.views_of(clip)
    filmed = [name for name in owners if name in folder.videos or name in folder.detections]
    frames = {"first_frame": 0, "frame_count": 0}
    if spec is not None:
        frames = {"first_frame": spec.first_frame, "frame_count": spec.frame_count}
    return {
        "id": clip,
        **frames,
        "cameras": filmed,
        "has_video": clip in match.folder.videos,
        "key_frames": key_frames(match, clip),
        "pick_next": pick_next,
        "has_tracks": latest is not None and f"tracking/{clip}" in latest.results,
    }


def _excess(request: ReviewRequest) -> float:
    gate = GATES.get(request.gate)
    return 0.0 if gate is None else gate.excess(request.figures)


def _clicks(match: Match, camera: str) -> int:
    clicked = match.folder.clicked.get(camera)
    return 0 if clicked is None else len(clicked.points) + len(clicked.drawn)


def _figures(context: PageContext, match: Match, camera: str) -> dict[str, float]:
    """Return a camera's metrics in the latest run, or before it those of the preview."""
    latest = latest_run(context.store, match.match_id)
    figures = {} if latest is None else latest.figures.get(f"static_calibration/{camera}", {})
    clicked = match.folder.clicked.get(camera)
    if figures or clicked is None:
        return figures
    previewed, errors = context.previews.get((match.match_id, camera), (None, {}))
    is_same = previewed is not None and _list_marks(previewed) == _list_marks(clicked)
    return {name: value for name, value in errors.items() if is_same and isfinite(value)}


def _list_marks(clicked: ClickedMarkings) -> set[tuple[Any, ...]]:
    points = {(point.name, *point.xy) for point in clicked.points}
    return points | {(marking.name, *marking.xy) for marking in clicked.drawn}
