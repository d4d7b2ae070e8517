"""Matches in pages with their states and pending reviews, and one match."""

from __future__ import annotations

import re
from collections import Counter
from collections.abc import Container, Sequence
from math import isfinite
from pathlib import Path
from typing import Any, Final

from fastapi import APIRouter

from data_contracts.operations import MatchSummary
from data_contracts.static_calibration import ClickedMarkings
from flows.gates import GATES
from flows.method import METHOD
from flows.overview import PAGE
from flows.review.descriptions import review_json
from flows.review.verdicts import Review, reviews_of
from flows.run_record import latest_run
from flows.service.layout import served_state
from flows.stage import Match
from flows.web.app_context import PageContext, say_cancelled
from flows.web.browser_words import in_browser
from flows.web.calibration import key_frames
from flows.web.corrections import describe_groups

BUDGET_SECONDS: Final = 0.25
"""Time that one request spends on changed matches; the page asks again for the others."""
ORDER: Final = (
    *("questions", "failed", "calibrate", "outdated", "stopped", "partial"),
    *("running", "new", "ready", ""),
)
"""Kinds of states, the most urgent first; the last one is that of a match not read yet."""

_INTAKE: Final = {
    "state": "running",
    "is_intake": True,
    "waits": True,
    "lines": ["Its files are read, and its run then begins by itself."],
}
_ABOUT: Final = {stage.name: stage.about for stage in METHOD}


def routes(context: PageContext) -> APIRouter:
    """Create the routes of the queue and of one match."""
    router = APIRouter(prefix="/api/matches")
    overview = context.overview

    @router.get("")
    def matches(search: str = "", kind: str = "", page: int = 1) -> dict[str, Any]:
        found = overview.look(BUDGET_SECONDS)
        return _choose(context, found, search.strip().lower(), kind, max(page, 1))

    @router.get("/{match_id}")
    def match(match_id: str) -> dict[str, Any]:
        opened = context.stored_match(match_id)
        latest = latest_run(context.store, match_id)
        folder = opened.folder
        return {
            **_glance(context, overview.read(match_id)),
            "reviews": [
                describe_review(each) for each in reviews_of(context.store, opened, latest)
            ],
            "groups": describe_groups(context.store, opened),
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
            "stages": [
                {"name": stage.name, "about": stage.about}
                for stage in METHOD
                if stage.units(opened)
            ],
            "next_versions": [
                {"name": each.name, "state": each.state, "reason": in_browser(each.reason)}
                for each in served_state(context.store.url).arrivals().values()
                if each.replaces == opened.registration.folder and each.state != "taken"
            ],
            "left_out": {} if latest is None else latest.left_out,
            "warnings": [] if latest is None else [in_browser(each) for each in latest.warnings],
        }

    return router


def _choose(
    context: PageContext, found: Sequence[MatchSummary], search: str, kind: str, page: int
) -> dict[str, Any]:
    """Return the matches of a page of those sought, and what the page says about all."""
    running, sought = context.continuing.running(), []
    counts: Counter[str] = Counter()
    for match in found:
        its_kind = _kind(match, running)
        counts[its_kind] += 1
        if search in match.match_id.lower() and kind in ("", its_kind):
            at = 0.0 if match.latest is None else match.latest.finished_at.timestamp()
            sought.append((ORDER.index(its_kind), -at, match.match_id, match))
    sought.sort(key=lambda each: each[:3])
    page = min(page, max(1, -(-len(sought) // PAGE)))
    shown = (each[3] for each in sought[PAGE * (page - 1) : PAGE * page])
    return {
        "matches": [
            _glance(context, each if each.is_unseen else context.overview.glance(each.match_id))
            for each in shown
        ],
        "total": len(found),
        "sought": len(sought),
        "page": page,
        "pages": -(-len(sought) // PAGE),
        "counts": {name: counts[name] for name in ORDER if counts[name]},
        "left": sum(each.is_unseen for each in found),
    }


def _kind(match: MatchSummary, running: Container[str]) -> str:
    """Return the kind of a match's state, as pages filter by it."""
    if match.is_unseen:
        return ""
    if match.problem:
        return "failed"
    return "running" if match.match_id in running else match.kind


def describe_review(review: Review) -> dict[str, Any]:
    """Return one review request as JSON for the pages."""
    (unit,), gate = review.request.keys, GATES.get(review.request.gate)
    excess = 0.0 if gate is None else gate.excess(review.request.figures)
    return {**review_json(review), "unit": unit, "excess": excess}


def _glance(context: PageContext, found: MatchSummary) -> dict[str, Any]:
    """Return a summary as JSON; while a run of these pages is at work, they show its progress."""
    at_work = _local_run(context, found.match_id) or _intake(context, found)
    found, latest = say_cancelled(found, at_work), found.latest
    elsewhere = {"state": "elsewhere", "lines": [found.open_run]} if found.open_run else None
    return {
        "match": found.match_id,
        "is_unseen": found.is_unseen,
        "problem": in_browser(found.problem) if found.problem else None,
        "damage": found.damage,
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
        "waiting": [each.model_dump() for each in found.waiting],
        "to_click": list(found.to_click),
        "has_image": found.has_image,
        "corrections": found.corrections,
        "first_clicks": found.first_clicks,
        "stale": found.outdated,
        "state": {
            "name": found.kind,
            "words": found.words,
            "why": in_browser(found.why),
            "todo": in_browser(found.todo),
            "seconds": found.seconds,
            "units": {kind: len(names) for kind, names in found.units.items()},
        },
        "at_work": at_work or elsewhere,
    }


def _local_run(context: PageContext, match_id: str) -> dict[str, Any] | None:
    state = context.continuing.state(match_id)
    if state is None:
        return None
    lines = [in_browser(line) for line in state["lines"]]
    if about := _ABOUT.get(state.get("stage", "")):
        begin = state["stage"].replace("_", "[_ ]")
        lines = [re.sub(f"^{begin}\\b", about, line) for line in lines]
    return {**state, "lines": lines}


def _intake(context: PageContext, found: MatchSummary) -> dict[str, Any] | None:
    """Return the state of a registered match whose intake has not asked for its run yet."""
    if found.kind != "new":
        return None
    name = Path(context.registration(found.match_id).folder).name
    for each in served_state(context.store.url).arrivals().values():
        if each.state == "arriving" and each.name.rpartition("/")[2] == name:
            return {**_INTAKE}
    return None


def _clip(context: PageContext, match: Match, clip: str) -> dict[str, Any]:
    """Return a clip or broadcast view with its key frames: clicked, and those to click next."""
    latest = latest_run(context.store, match.match_id)
    key = None if latest is None else latest.results.get(f"broadcast_calibration/{clip}")
    pick_next = []
    if key is not None and context.store.has(match.match_id, "broadcast_calibration", clip, key):
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
        "fps": match.folder.spec.fps,
        **frames,
        "cameras": filmed,
        "has_video": clip in match.folder.videos,
        "key_frames": key_frames(match, clip),
        "pick_next": pick_next,
        "has_tracks": latest is not None and f"tracking/{clip}" in latest.results,
    }


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
