"""Runs of a match over time: cause, settings, comparison and pins; and a match's thumbnail."""

from __future__ import annotations

from datetime import UTC, datetime
from typing import Any, Final

import numpy as np
from fastapi import APIRouter, HTTPException
from fastapi.responses import Response
from numpy.typing import NDArray
from pydantic import Field

from data_contracts.pin import Pin
from data_contracts.records import Name, Record
from data_contracts.run import RunRecord
from flows.match_state import corrections_since
from flows.results.comparison import compare_runs
from flows.settings import flatten
from flows.stage import Match
from flows.web.app_context import PageContext, Person
from flows.web.images import image_response
from flows.web.results import describe_changes
from worldpose.errors import WorldposeError
from worldpose.ingest.footage import read_still
from worldpose.store.runs import list_pins, pin_run, unpin_run
from worldpose.store.store import Store
from worldpose.video.folder import open_video

THUMBNAIL_WIDTH: Final = 160
"""Width of a match's image on the home page [px]."""


class GivenPin(Record):
    """A name for a run, which keeps it."""

    run: Name
    name: Name
    why: str = Field(default="", max_length=2000)


def routes(context: PageContext) -> APIRouter:
    """Create the routes of a match's history."""
    router = APIRouter(prefix="/api/matches/{match_id}")

    @router.get("/runs")
    def runs(match_id: str) -> list[dict[str, Any]]:
        store, match = context.store, context.stored_match(match_id)
        pins = list_pins(store.blobs, match_id)
        records = {run_id: store.run(match_id, run_id) for run_id in store.runs(match_id)}
        return [
            {
                "id": run_id,
                "state": record.state,
                "verdict": record.usability.verdict,
                "finished_at": record.finished_at,
                "seconds": record.seconds,
                "computed": len(record.executed),
                "failed": [each.unit for each in record.failed],
                "settings": [
                    *(f"{name} = {value}" for name, value in flatten(record.overrides).items()),
                    f"gates = {record.gates}",
                ],
                "cause": _find_cause(match, record, records.get(record.parent or "")),
                "pins": [pin.name for pin in pins if pin.run_id == run_id],
            }
            for run_id, record in reversed(records.items())
        ]

    @router.get("/runs/{before}/{after}")
    def compare(match_id: str, before: str, after: str) -> list[dict[str, Any]]:
        context.stored_match(match_id)
        a, b = (_find_run(context.store, match_id, name) for name in (before, after))
        return describe_changes(compare_runs(context.store, a, b))

    @router.get("/thumbnail")
    def thumbnail(match_id: str) -> Response:
        import cv2  # imported here: few pages decode an image

        picture = _first_picture(context.stored_match(match_id))
        if picture is None:
            raise HTTPException(404, "no camera has an image")
        height = round(THUMBNAIL_WIDTH * picture.shape[0] / picture.shape[1])
        small = cv2.resize(picture, (THUMBNAIL_WIDTH, height), interpolation=cv2.INTER_AREA)
        answer = image_response(np.asarray(small, dtype=np.uint8), "jpeg")
        answer.headers["cache-control"] = "private, max-age=3600"
        return answer

    _add_changes(router, context)
    return router


def _add_changes(router: APIRouter, context: PageContext) -> None:
    """Add the routes that cancel a run, and keep one by a name."""

    @router.post("/cancellation")
    def cancel(match_id: str, who: Person) -> dict[str, bool]:
        context.registration(match_id)  # its disk may not answer
        if not context.continuing.cancel(match_id, who):
            raise HTTPException(409, "no run of these pages is at work: end it where it was begun")
        return {"cancelled": True}

    @router.post("/pins")
    def pin(match_id: str, given: GivenPin, who: Person) -> dict[str, str]:
        context.stored_match(match_id)
        _find_run(context.store, match_id, given.run)
        now = datetime.now(UTC)
        kept = Pin(
            match_id=match_id,
            name=given.name,
            run_id=given.run,
            who=who,
            why=given.why,
            pinned_at=now,
        )
        return {"name": pin_run(context.store.blobs, kept).name}

    @router.post("/pins/{name}/removal")
    def unpin(match_id: str, name: str) -> dict[str, str]:
        context.stored_match(match_id)
        return {"name": unpin_run(context.store.blobs, match_id, name).name}


def _find_run(store: Store, match_id: str, run_id: str) -> RunRecord:
    if run_id not in store.runs(match_id):
        raise HTTPException(404, "no such run")
    return store.run(match_id, run_id)


def _find_cause(match: Match, record: RunRecord, parent: RunRecord | None) -> str:
    """Return why a run was made, by what differs from the run before it."""
    if parent is None:
        first = "first run" + " that ended" * (int(record.run_id) > 1)
        return "the run before was removed" if record.parent else first
    made = corrections_since(match.journal, parent.started_at, record.started_at)
    causes = [f"{made} {'correction' if made == 1 else 'corrections'}"] if made > 0 else []
    causes += ["other settings"] if parent.overrides != record.overrides else []
    causes += ["other libraries"] if parent.versions != record.versions else []
    new = [name for name in record.results if name.startswith("ingest/")]
    is_new = any(parent.results.get(name) != record.results[name] for name in new)
    causes += ["new files"] if is_new and not parent.failed and not causes else []
    causes += ["answers to its questions"] if parent.waiting and not causes else []
    causes += ["failed steps again"] if parent.failed and not causes else []
    return ", ".join(causes) or "run again"


def _first_picture(match: Match) -> NDArray[np.uint8] | None:
    """Return the first image of a static camera, else of a moving one; None if there is none."""
    folder = match.folder
    for owner in (*(each.id for each in folder.spec.static_cameras), *folder.spec.broadcast_views):
        try:
            if owner in folder.stills:
                camera = folder.spec.camera(owner)
                return read_still(folder.stills[owner], (camera.width, camera.height))
            if owner in folder.videos:
                with open_video(folder.videos[owner]) as video:
                    return video.frame(0)
        except (OSError, WorldposeError):
            continue  # the page of the match shows the error
    return None
