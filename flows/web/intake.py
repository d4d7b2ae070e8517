"""Creation of matches on a page: uploads, picked videos, the form of match.yaml, and the inbox."""

from __future__ import annotations

import os
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from threading import Thread
from typing import Annotated, Any, Final

from fastapi import APIRouter, HTTPException, Query, Request
from fastapi.responses import JSONResponse, Response
from pydantic import Field, JsonValue
from starlette.concurrency import run_in_threadpool
from starlette.requests import ClientDisconnect

from data_contracts.operations import Priority
from data_contracts.records import Count, Record
from flows.service.inbox import RefusalError, find_refused, fingerprint_of, remove_entry, try_again
from flows.service.layout import served_state
from flows.web.app_context import PageContext, Person
from flows.web.browser_words import in_browser
from flows.web.draft_problems import DraftFile
from flows.web.drafts import Drafts
from flows.web.guard import CHUNK_SUFFIX
from flows.web.images import image_response
from flows.web.video_folders import list_videos, open_video
from worldpose.errors import InputError

FRAME_PX: Final = 960
"""Maximum width of the frames that a page compares, unless it looks at one close up [px]."""
OVERTAKEN: Final = "another page saved this form meanwhile: look at it as it is now"


@dataclass(frozen=True)
class Intake:
    """Where pages put new matches, and read-only folders where they find videos."""

    inbox: Path
    folders: Sequence[Path] = ()


class SavedForm(Record):
    """The form of a match that is being created."""

    revision: Count
    """Revision of the form that the person saw."""
    content: dict[str, JsonValue]
    """match.yaml as filled in so far."""


class NewUpload(Record):
    """A file that the browser will send in chunks."""

    name: str = Field(min_length=1, max_length=255)
    size: Count
    """[byte]"""
    modified_ms: int = Field(default=0, ge=0, le=1 << 53)
    """Time of its last change [ms]."""


class Pick(Record):
    """A video of a named folder."""

    folder: int
    """Index of the folder."""
    path: str = Field(min_length=1, max_length=4096)
    """Path in the folder."""


class NewDraft(Record):
    """The request to create a match, its next version, or a corrected arrival."""

    match: str | None = None
    """Id of the registered match whose next version it is."""
    arrival: str | None = None
    """Name of the refused arrival that it corrects."""


class Named(Record):
    """An entry of the inbox."""

    name: str = Field(min_length=1, max_length=4096)


class Finish(Record):
    """The request to put a match into the inbox."""

    priority: Priority = "normal"
    revision: Count | None = None
    """Revision of the form that the person saw; None = any."""


def routes(context: PageContext, intake: Intake | None) -> APIRouter:
    """Create the routes of arrivals and of matches being created; without intake, of arrivals."""
    router = APIRouter()

    @router.get("/api/inbox")
    def inbox() -> dict[str, Any]:
        arrivals = served_state(context.store.url).arrivals().values()
        return {
            "inbox": None if intake is None else str(intake.inbox),
            "folders": [] if intake is None else [str(folder) for folder in intake.folders],
            "arrivals": [
                {**each.model_dump(mode="json"), "reason": in_browser(each.reason)}
                for each in arrivals
                if each.state != "taken"
            ],
        }

    if intake is not None:
        drafts = Drafts(intake.inbox, intake.folders, context.store)
        Thread(target=drafts.continue_copies, daemon=True).start()
        router.include_router(_draft_routes(drafts, intake, context))
        _add_ways_back(router, intake, context)
    return router


def _add_ways_back(router: APIRouter, intake: Intake, context: PageContext) -> None:
    """Add the routes of refused arrivals; a third one is a draft that corrects them."""
    state = served_state(context.store.url)

    @router.post("/api/inbox/again")
    def again(given: Named) -> dict[str, Any]:
        try_again(state, intake.inbox, given.name)
        return {"again": given.name}

    @router.post("/api/inbox/removal")
    def remove(given: Named) -> dict[str, Any]:
        return {"moved_to": str(remove_entry(state, intake.inbox, given.name))}


def _begin(drafts: Drafts, intake: Intake, context: PageContext, who: str, given: NewDraft) -> str:
    """Create a draft; return its id.

    HTTPException 404 without such a match, 503 if its disk does not answer; InputError if the
    arrival cannot be corrected on a page.
    """
    if given.match is not None:
        return drafts.create(who, context.readable(given.match)).id
    if given.arrival is None:
        return drafts.create(who).id
    entry, arrival = find_refused(served_state(context.store.url), intake.inbox, given.arrival)
    try:
        fingerprint_of(entry.path)  # a link could lead to any file of this machine
    except RefusalError as refusal:
        todo = "Correct it where it came from, or remove it here."
        raise InputError(given.arrival, "a folder with files", str(refusal), todo) from None
    known = (context.store.registration(name) for name in context.store.matches())
    ids = (it.spec.match_id for it in known if it is not None and it.folder == arrival.replaces)
    return drafts.create(who, next(ids, None), entry.path.resolve()).id


def _draft_routes(drafts: Drafts, intake: Intake, context: PageContext) -> APIRouter:
    router = APIRouter(prefix="/api/drafts")

    @router.get("")
    def all_drafts() -> dict[str, Any]:
        return {
            "drafts": [
                {
                    **draft.model_dump(include={"id", "who", "created_at"}),
                    "match_id": draft.content.get("match_id"),
                    "adds_to": draft.match_id,
                    "files": len(draft.files),
                }
                for draft in drafts.all()
            ]
        }

    @router.post("")
    def create(who: Person, given: NewDraft) -> dict[str, Any]:
        return {"id": _begin(drafts, intake, context, who, given)}

    @router.get("/videos")
    def videos(folder: int, path: Annotated[str, Query(max_length=4096)] = "") -> dict[str, Any]:
        return list_videos(intake.folders, folder, path)

    @router.get("/{draft}")
    def view(draft: str) -> dict[str, Any]:
        return drafts.view(draft)

    @router.post("/{draft}/form")
    def save(draft: str, given: SavedForm) -> dict[str, Any]:
        if not drafts.save(draft, given.content, given.revision):
            raise HTTPException(409, OVERTAKEN)
        return drafts.view(draft)

    @router.post("/{draft}/removal")
    def discard(draft: str) -> dict[str, Any]:
        drafts.discard(draft)
        return {"discarded": draft}

    @router.post("/{draft}/finish")
    def finish(draft: str, given: Finish) -> dict[str, Any]:
        arrived = drafts.finish(draft, given.priority, given.revision)
        if arrived is None:
            raise HTTPException(409, OVERTAKEN)
        return {"arrived": arrived}

    _add_files(router, drafts, intake)
    return router


def _add_files(router: APIRouter, drafts: Drafts, intake: Intake) -> None:
    """Add the routes of the files of a draft."""

    @router.post("/{draft}/files")
    def begin_upload(draft: str, given: NewUpload) -> dict[str, Any]:
        file = DraftFile(title=given.name, size=given.size, modified_ms=given.modified_ms)
        return {"file": drafts.add(draft, file).id}

    @router.post("/{draft}/picks")
    def pick(draft: str, given: Pick) -> dict[str, Any]:
        with open_video(intake.folders, given.folder, given.path) as video:
            status = os.fstat(video)
        file = DraftFile(
            title=given.path.rpartition("/")[2],
            size=status.st_size,
            modified_ms=max(0, status.st_mtime_ns // 1_000_000),
            folder=given.folder,
            source=given.path,
        )
        drafts.add(draft, file)
        return drafts.view(draft)

    @router.put("/{draft}/files/{file}" + CHUNK_SUFFIX)
    async def take_chunk(
        draft: str, file: str, offset: Annotated[int, Query(ge=0)], request: Request
    ) -> JSONResponse:
        try:
            chunk = await request.body()
        except ClientDisconnect:
            # Nothing of the chunk is kept: the browser sends it again.
            return JSONResponse({"error": "the connection ended"}, status_code=400)
        # Writing waits for the disk: other requests are answered meanwhile.
        is_taken, received = await run_in_threadpool(drafts.append, draft, file, offset, chunk)
        return JSONResponse({"received": received}, status_code=200 if is_taken else 409)

    @router.get("/{draft}/files/{file}/frames/{number}")
    def frame(
        draft: str,
        file: str,
        number: int,
        fps: Annotated[float, Query(gt=0.0, allow_inf_nan=False)],
        width: Annotated[int, Query(ge=1, le=8192)] = FRAME_PX,
    ) -> Response:
        return image_response(drafts.frame(draft, file, number, fps, width), "jpeg")

    @router.post("/{draft}/files/{file}/removal")
    def remove(draft: str, file: str) -> dict[str, Any]:
        drafts.remove(draft, file)
        return drafts.view(draft)
