"""Clock offsets on the page of a match: proposed from the people in the videos, and applied."""

from __future__ import annotations

import secrets
import shutil
import tempfile
from dataclasses import dataclass, field
from pathlib import Path
from threading import Lock
from typing import Any, Final

from fastapi import APIRouter
from starlette.responses import Response

from data_contracts.match import ClockOffset
from data_contracts.records import Record
from flows.results.clock_offsets import ClockOffsets, find_offsets
from flows.run_record import latest_run
from flows.run_status import plan_as_latest
from flows.service.inbox import next_version, put_in
from flows.service.layout import served_state
from flows.web.app_context import PageContext
from flows.web.draft_folder import copy_version
from flows.web.drafts import DRAFTS
from flows.web.intake import Intake
from worldpose.errors import InputError
from worldpose.ingest.writing import write_offsets
from worldpose.store.store import Run

COMPARED: Final = ("ingest/", "static_calibration/", "detection/")
"""Results of which offsets are found."""
MAX_OFFSET_SECONDS: Final = 2.0
"""Largest offset between two cameras that is sought [s]."""


class Seen(Record):
    """The request to apply the proposal that a person saw."""

    offsets: dict[str, ClockOffset]
    """`offset_frames` by camera [frame]."""


@dataclass
class Proposals:
    """The proposal of the match that was asked about last: it takes up to minutes."""

    context: PageContext
    _lock: Lock = field(default_factory=Lock)
    _known: tuple[tuple[str, ...], ClockOffsets, bytes] | None = None

    def find(self, match_id: str) -> tuple[ClockOffsets, bytes]:
        """Return the offsets of a match by its latest run, and their plot as PNG.

        InputError if there is no run, or fewer than two cameras have a calibration and 2D poses.
        """
        from worldpose.reports.drawing import draw_synchronization  # late: it loads matplotlib

        match = self.context.match(match_id)
        record = latest_run(self.context.store, match_id)
        if record is None:
            raise InputError(match_id, "a run with people", "none yet", "Run the match first.")
        plan = plan_as_latest(self.context.store, match, record, {})
        made = {unit.name: unit.key for unit in plan if unit.name.startswith(COMPARED)}
        if any(record.results.get(name, key) != key for name, key in made.items()):
            found, todo = "a run from before the last changes", "Run it again first."
            raise InputError(match_id, "a run of the match as it is now", found, todo)
        made_from = (match_id, record.run_id, match.registration.model_dump_json())
        with self._lock:
            if self._known is None or self._known[0] != made_from:
                run = Run(self.context.store, record)
                offsets = find_offsets(run, match, None, MAX_OFFSET_SECONDS)
                with tempfile.TemporaryDirectory() as folder:
                    plot = Path(folder) / "clocks.png"
                    draw_synchronization(offsets.found, offsets.names, plot)
                    self._known = made_from, offsets, plot.read_bytes()
            return self._known[1:]


def routes(context: PageContext, intake: Intake | None) -> APIRouter:
    """Create the routes of clock offsets; without intake, nobody applies them here."""
    router = APIRouter(prefix="/api/matches/{match_id}/offsets")
    proposals = Proposals(context)

    @router.get("")
    def offsets(match_id: str) -> dict[str, Any]:
        found, _ = proposals.find(match_id)
        return {
            "clip": found.clip,
            "cameras": [row._asdict() for row in found.rows],
            "changed": found.changed,
            "verdict": found.verdict,
            "warning": found.warning,
            "has_rest": found.has_rest,
        }

    @router.get("/plot")
    def plot(match_id: str) -> Response:
        return Response(proposals.find(match_id)[1], media_type="image/png")

    if intake is not None:

        @router.post("")
        def apply(match_id: str, given: Seen) -> dict[str, str]:
            found, _ = proposals.find(match_id)
            if not given.offsets or given.offsets != found.changed:
                todo = "Look at the offsets again."
                raise InputError(match_id, "the offsets that are proposed now", "others", todo)
            return {"arrived": _apply(context, intake.inbox, match_id, given)}

    return router


def _apply(context: PageContext, inbox: Path, match_id: str, given: Seen) -> str:
    """Put the next version of a match with other clock offsets into the inbox; return its name."""
    before, name = context.registration(match_id).folder, next_version(inbox, match_id)
    draft = inbox / DRAFTS / f".{secrets.token_hex(8)}"
    try:
        copy_version(Path(before), draft)
        write_offsets(draft, given.offsets)
        put_in(served_state(context.store.url), inbox, draft, name, replaces=before)
    finally:
        shutil.rmtree(draft, ignore_errors=True)
    return name
