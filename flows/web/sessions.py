"""Logging in and out, with the form: the pages' server has it, and Prefect's on its own port."""

from __future__ import annotations

from collections.abc import Awaitable, Callable, Mapping
from importlib.resources import files
from importlib.resources.abc import Traversable
from typing import Final

from fastapi import APIRouter, FastAPI, Request
from fastapi.exceptions import RequestValidationError
from fastapi.responses import JSONResponse
from pydantic import Field, field_validator
from starlette.responses import Response
from starlette.types import ASGIApp

from data_contracts.records import Record
from flows.web.access import KNOWN_SECONDS, Access
from flows.web.guard import Guard, set_session
from flows.web.proxy import NAME_LENGTH

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
    """Token as the server printed it, or as the operator chose it."""

    @field_validator("who")
    @classmethod
    def _printable(cls, who: str) -> str:
        if not who.isprintable():
            raise ValueError("expected a name of printable characters, found others")
        return who


def login_app(access: Access) -> ASGIApp:
    """Create the form alone, with what it asks for, as a part of a server for approvers."""
    app = FastAPI(docs_url=None, redoc_url=None, openapi_url=None, redirect_slashes=False)
    app.exception_handler(RequestValidationError)(answer_malformed)
    app.include_router(login_routes(access))

    @app.get("/api/session")
    async def session(request: Request) -> JSONResponse:
        secret = access.form_secret(request.state.session)
        # Whom the other server refuses keeps the form, and can log out or in as another person.
        status = 200 if request.state.role == "approver" else 401
        return JSONResponse({"form_secret": secret}, status_code=status)

    return Guard(app, access)


def login_routes(access: Access) -> APIRouter:
    """Create the routes of sessions and of the form: no log-in needs a thread, as a disk's do."""
    folder = files("flows.web") / "login"
    parts = {f"/login/{name}": folder / name for name in ("page.js", "page.css")}
    router = file_routes({"/login": folder / "page.html", **parts})

    @router.post("/api/login")
    async def login(given: Login, request: Request) -> JSONResponse:
        guesser = access.guesser(given.who, request.cookies.get(f"{access.cookie}_known"))
        if not access.may_try(guesser):
            return JSONResponse(
                {"error": "too many wrong tokens: wait for some seconds"},
                status_code=429,
                headers={"retry-after": "1"},
            )
        if not access.has_token(given.who, given.token):
            return JSONResponse({"error": "this is not the token"}, status_code=401)
        access.forgive(guesser)
        request.state.who = given.who
        answer = JSONResponse({"who": given.who})
        set_session(answer, access, access.session(given.who), access.secure)
        answer.set_cookie(
            f"{access.cookie}_known",
            access.remember(given.who),
            max_age=KNOWN_SECONDS,
            path="/api/login",
            httponly=True,
            samesite="strict",
            secure=access.secure,
        )
        return answer

    @router.post("/api/logout")
    def logout(request: Request) -> JSONResponse:
        access.end(request.state.session)
        proxy = access.proxy if request.state.is_proxied else None
        answer = JSONResponse({"next": "/login" if proxy is None else proxy.sign_out})
        answer.delete_cookie(access.cookie, httponly=True, samesite="strict")
        return answer

    return router


def file_routes(served: Mapping[str, Traversable]) -> APIRouter:
    """Serve files, read once: requests are looked up, and never become paths."""
    router = APIRouter()
    for path, file in served.items():
        router.add_api_route(path, _answer(file.name, file.read_bytes()), methods=["GET"])
    return router


def _answer(name: str, content: bytes) -> Callable[[], Awaitable[Response]]:
    kind = TYPES[name.rpartition(".")[2]]

    async def answer() -> Response:
        return Response(content, media_type=kind, headers={"cache-control": "no-cache"})

    return answer


def answer_malformed(request: Request, error: RequestValidationError) -> JSONResponse:
    """Say which part of a request is malformed."""
    first = error.errors()[0]
    said = f"{'.'.join(map(str, first['loc']))}: {first['msg']}"
    # A key of the body can contain lone surrogates, which a response cannot.
    return JSONResponse({"error": said.encode("utf-8", "replace").decode()}, status_code=422)
