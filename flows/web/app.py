"""Server of the review pages."""

from __future__ import annotations

from collections.abc import AsyncIterator, Callable
from contextlib import asynccontextmanager
from importlib.resources import files
from threading import Thread
from typing import Final

from fastapi import APIRouter, FastAPI, Request
from fastapi.responses import JSONResponse, Response
from pydantic import Field, field_validator

from data_contracts.records import Record
from flows.service import status_page
from flows.web import (
    calibration,
    decisions,
    detections,
    evidence,
    identities,
    outliers,
    queue,
    views,
)
from flows.web.access import NAME_LENGTH, SESSION_SECONDS, Access
from flows.web.app_context import Desk, Person
from flows.web.errors import add_answers
from flows.web.guard import Guard
from worldpose.store import Store

TYPES: Final = {
    "html": "text/html; charset=utf-8",
    "css": "text/css; charset=utf-8",
    "js": "text/javascript; charset=utf-8",
    "svg": "image/svg+xml",
}


class Login(Record):
    """Login form."""

    who: str = Field(min_length=1, max_length=NAME_LENGTH)
    """Recorded with all decisions and corrections of the person; printable, so that no log line
    breaks."""
    token: str
    """As the server printed it, or as the operator chose it."""

    @field_validator("who")
    @classmethod
    def _printable(cls, who: str) -> str:
        if not who.isprintable():
            raise ValueError("expected a name of printable characters, found others")
        return who


def create_app(project: str, access: Access) -> FastAPI:
    """Create the server of a project's pages.

    Args:
        project: folder or URL of the store.
        access: access control.

    Raises:
        InputError: there is no such project.
    """
    desk = Desk(Store.open(project), access)

    @asynccontextmanager
    async def lifespan(app: FastAPI) -> AsyncIterator[None]:
        Thread(target=calibration.warm_up, args=[desk], daemon=True).start()
        yield

    app = FastAPI(
        title="worldpose review",
        docs_url=None,
        redoc_url=None,
        openapi_url=None,
        redirect_slashes=False,
        lifespan=lifespan,
    )
    add_answers(app)
    app.include_router(_sessions(desk))
    for module in (
        queue,
        decisions,
        evidence,
        outliers,
        calibration,
        detections,
        views,
        identities,
        status_page,
    ):
        app.include_router(module.routes(desk))
    app.include_router(_files())
    app.add_middleware(Guard, access=access)
    return app


def _sessions(desk: Desk) -> APIRouter:
    router = APIRouter()
    access = desk.access

    @router.get("/api/health")
    def health() -> dict[str, str]:
        return {"state": "up"}

    @router.post("/api/login")
    def login(given: Login, request: Request) -> JSONResponse:
        address = "" if request.client is None else request.client.host
        if not access.may_try(address):
            return JSONResponse(
                {"error": "too many wrong tokens: wait for ten seconds"},
                status_code=429,
                headers={"retry-after": "10"},
            )
        if not access.has_token(given.token):
            access.note_wrong(address)
            return JSONResponse({"error": "this is not the token"}, status_code=401)
        request.state.who = given.who
        answer = JSONResponse({"who": given.who})
        answer.set_cookie(
            access.cookie,
            access.session(given.who),
            max_age=SESSION_SECONDS,
            httponly=True,
            samesite="strict",
            secure=access.secure,
        )
        return answer

    @router.post("/api/logout")
    def logout(request: Request) -> JSONResponse:
        access.end(request.state.session)
        answer = JSONResponse({})
        answer.delete_cookie(access.cookie, httponly=True, samesite="strict")
        return answer

    @router.get("/api/session")
    def session(request: Request, who: Person) -> dict[str, str]:
        secret = access.form_secret(request.state.session)
        return {"who": who, "form_secret": secret, "project": desk.store.url}

    return router


def _files() -> APIRouter:
    """Serve the built pages, read once: requests are looked up, and never become paths."""
    router = APIRouter()
    folder = files("flows.web")
    served = {
        "/login": folder / "login" / "page.html",
        "/login/page.js": folder / "login" / "page.js",
        "/login/page.css": folder / "login" / "page.css",
        "/": folder / "static" / "index.html",
    }
    built = folder / "static" / "assets"
    if built.is_dir():
        served |= {f"/assets/{each.name}": each for each in built.iterdir()}
    for path, file in served.items():
        router.add_api_route(path, _answer(file.name, file.read_bytes()), methods=["GET"])
    return router


def _answer(name: str, content: bytes) -> Callable[[], Response]:
    kind = TYPES[name.rpartition(".")[2]]

    def answer() -> Response:
        return Response(content, media_type=kind, headers={"cache-control": "no-cache"})

    return answer
