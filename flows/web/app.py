"""Server of the review pages."""

from __future__ import annotations

import errno
import logging
from collections.abc import AsyncIterator, Callable
from contextlib import asynccontextmanager
from http.cookies import CookieError, SimpleCookie
from importlib.resources import files
from pathlib import Path
from threading import Thread
from typing import Final

from fastapi import APIRouter, FastAPI, Request
from fastapi.exceptions import RequestValidationError
from fastapi.responses import JSONResponse
from pydantic import Field, field_validator
from starlette.datastructures import Headers, MutableHeaders
from starlette.responses import RedirectResponse, Response
from starlette.types import ASGIApp, Message, Receive, Scope, Send

from data_contracts.records import Record
from flows.review.edit_conflicts import StaleEditError
from flows.service import status_page
from flows.web import (
    calibration,
    corrections,
    detections,
    evidence,
    history,
    identities,
    offsets,
    queue,
    results,
    settings,
)
from flows.web.access import KNOWN_SECONDS, LOOPBACK, SESSION_SECONDS, Access
from flows.web.app_context import PageContext, Person
from flows.web.browser_words import describe_error
from flows.web.host_guard import host_name, refusal, refuse_foreign
from flows.web.http_server import serve_http
from flows.web.intake import CHUNK_BYTES, CHUNK_SUFFIX, Intake
from flows.web.intake import routes as routes_of_intake
from flows.web.proxy import NAME_LENGTH, Role
from worldpose.errors import InputError, InternalError, WorldposeError
from worldpose.store.store import Store

LOG: Final = logging.getLogger("worldpose.pages")
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


def create_app(project: str, access: Access, intake: Intake | None = None) -> FastAPI:
    """Create the server of a project's pages; without intake, people create no matches there.

    Raises:
        InputError: there is no such project.
    """
    context = PageContext(Store.open(project), access)

    @asynccontextmanager
    async def lifespan(app: FastAPI) -> AsyncIterator[None]:
        Thread(target=calibration.warm_up, args=[context], daemon=True).start()
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
    app.include_router(_sessions(context, intake))
    tools = corrections, evidence, calibration, detections, identities
    for module in (queue, history, *tools, results, settings, status_page):
        app.include_router(module.routes(context))
    for with_inbox in (routes_of_intake, offsets.routes):
        app.include_router(with_inbox(context, intake))
    app.include_router(_files())
    app.add_middleware(Guard, access=access)
    return app


def serve(
    project: str,
    access: Access,
    *,
    host: str,
    port: int,
    tls: tuple[Path, Path] | None,
    announce: Callable[[], None] = lambda: None,
    intake: Intake | None = None,
) -> None:
    """Serve a project's pages; return when interrupted.

    TLS has a certificate and a key file. Port 0 is any free one; `announce` is called when it is
    ours. Without intake, people create no matches here.

    Raises:
        InputError: there is no such project, or the port is taken.
    """
    certificate, key = (None, None) if tls is None else map(str, tls)
    serve_http(
        create_app(project, access, intake),
        host=host,
        port=port,
        announce=announce,
        server_header=False,
        ssl_certfile=certificate,
        ssl_keyfile=key,
        timeout_graceful_shutdown=2,
    )


def address(access: Access, host: str, port: int) -> str:
    """Return the pages' URL; the token is in the fragment, which browsers do not send."""
    name = host
    if host not in LOOPBACK:
        name = sorted(access.hosts - LOOPBACK)[0]
    name = f"[{name}]" if ":" in name else name
    return f"{'https' if access.secure else 'http'}://{name}:{port}/login#token={access.token}"


def _sessions(context: PageContext, intake: Intake | None) -> APIRouter:
    router = APIRouter()
    access = context.access

    @router.get("/api/health")
    def health() -> dict[str, str]:
        return {"state": "up"}

    @router.post("/api/login")
    def login(given: Login, request: Request) -> JSONResponse:
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
        _set_session(answer, access, access.session(given.who), access.secure)
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

    @router.get("/api/session")
    def session(request: Request, who: Person) -> dict[str, str | bool]:
        return {
            "who": who,
            "role": request.state.role,
            "form_secret": access.form_secret(request.state.session),
            "project": context.store.url,
            "takes_files": intake is not None and request.state.role == "approver",
        }

    return router


def _set_session(answer: Response, access: Access, session: str, secure: bool) -> None:
    """Set the cookie of a session, out of reach of scripts and other sites."""
    answer.set_cookie(
        access.cookie,
        session,
        max_age=SESSION_SECONDS,
        httponly=True,
        samesite="strict",
        secure=secure,
    )


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


def add_answers(app: FastAPI) -> None:
    """Answer with JSON: 409 and the difference, 422 and what to do, 500 or 507 and the reason."""

    @app.exception_handler(StaleEditError)
    def stale(request: Request, error: StaleEditError) -> JSONResponse:
        return JSONResponse(
            {"error": describe_error(error), "difference": dict(error.difference)}, status_code=409
        )

    @app.exception_handler(InputError)
    def unfit(request: Request, error: InputError) -> JSONResponse:
        parts = {name: getattr(error, name) for name in ("where", "expected", "found", "todo")}
        return JSONResponse({"error": describe_error(error), **parts}, status_code=422)

    @app.exception_handler(RequestValidationError)
    def answer_malformed(request: Request, error: RequestValidationError) -> JSONResponse:
        first = error.errors()[0]
        place = ".".join(str(part) for part in first["loc"])
        said = f"{place}: {first['msg']}"
        # A key of the body can contain lone surrogates, which a response cannot.
        return JSONResponse({"error": said.encode("utf-8", "replace").decode()}, status_code=422)

    @app.exception_handler(OSError)
    def unreachable(request: Request, error: OSError) -> JSONResponse:
        place = f"{error.filename}: " if error.filename else ""
        return JSONResponse({"error": f"{place}{error.strerror or error}"}, status_code=500)

    @app.exception_handler(WorldposeError)
    def answer_failed(request: Request, error: WorldposeError) -> JSONResponse:
        said = " ".join(str(error).split())
        LOG.warning("%s %r failed: %s", request.method, request.url.path, said)
        cause = error.__cause__
        is_full = isinstance(cause, OSError) and cause.errno in (errno.ENOSPC, errno.EDQUOT)
        return JSONResponse({"error": describe_error(error)}, status_code=507 if is_full else 500)

    @app.exception_handler(Exception)
    def unforeseen(request: Request, error: Exception) -> JSONResponse:
        """Report an internal error: traceback in the log, no blame of the user on the page."""
        where = f"{request.method} {request.url.path}"
        return JSONResponse({"error": str(InternalError.wrap(where, error))}, status_code=500)


OPEN: Final = frozenset(
    {"/api/health", "/api/login", "/login", "/login/page.js", "/login/page.css"}
)
"""Paths that answer without a session."""
BODY_BYTES: Final = 1 << 20
"""Maximum size of a request body [byte]."""
SAFE: Final = frozenset({"GET", "HEAD", "OPTIONS"})
HSTS_SECONDS: Final = 365 * 86400
"""Time for which browsers then reach this name by TLS alone."""
ASKING: Final = "/preview"
"""Suffix of paths that are posted to with every mouse move, and change nothing."""
POLICY: Final = (
    "default-src 'none'; script-src 'self'; style-src 'self'; img-src 'self' blob: data:; "
    "media-src 'self'; connect-src 'self'; base-uri 'none'; form-action 'self'; "
    "frame-ancestors 'none'"
)
"""Content that a page can load: scripts, styles, images, videos of this server; nothing inline."""


class Guard:
    """Refuses requests that do not come from a page of this server with a valid session.

    Host: a foreign name that points here (DNS rebinding) is refused. Session: all but `OPEN` needs
        one; a person whom a trusted proxy names gets one. Changes: need the session's form secret,
        and this origin if the browser states one. Size: at most `BODY_BYTES`, or `CHUNK_BYTES` of
        a chunk of a file. Every login and every requested change is logged with person, request
        and response.
    """

    def __init__(self, app: ASGIApp, access: Access) -> None:
        self.app, self.access = app, access

    async def __call__(self, scope: Scope, receive: Receive, send: Send) -> None:
        """Send the refusal, or pass the request on with person, role and session in `state`."""
        if scope["type"] == "lifespan":
            await self.app(scope, receive, send)
            return
        if scope["type"] != "http":
            raise RuntimeError(f"nothing here speaks {scope['type']}")
        headers = Headers(scope=scope)
        access = self.access
        session = _cookie(headers, access.cookie)
        visitor = None if access.proxy is None else access.proxy.visitor(scope, headers)
        begun = Response()  # a session that begins with this request
        if visitor is None:
            who = access.person(session)
            role: Role | None = access.role(who)
        else:
            who, role = visitor.who, visitor.role
            if access.person(session, by_proxy=True) != who:
                session = access.session(who, by_proxy=True)
                _set_session(begun, access, session, access.secure or visitor.secure)
        state = scope.setdefault("state", {})
        state |= {"who": who, "role": role, "session": session, "is_proxied": visitor is not None}

        is_gone = False

        async def receive_noted() -> Message:
            nonlocal is_gone
            message = await receive()
            is_gone = is_gone or message["type"] == "http.disconnect"
            return message

        async def send_sealed(message: Message) -> None:
            if message["type"] == "http.response.start":
                sealed = MutableHeaders(scope=message)
                _seal(sealed, scope["path"])
                # Not of localhost: a browser would ask all of its ports for TLS, Prefect's too.
                if access.secure and host_name(headers.get("host", "")) not in LOOPBACK:
                    sealed["strict-transport-security"] = f"max-age={HSTS_SECONDS}"
                if role is not None and "set-cookie" not in sealed:  # as logging out sets one
                    for cookie in begun.headers.getlist("set-cookie"):
                        sealed.append("set-cookie", cookie)
                is_frequent = scope["path"].endswith((ASKING, CHUNK_SUFFIX))
                asked = is_frequent and message["status"] < 400
                # A client that disconnected in the middle of its request requested nothing.
                if scope["method"] not in SAFE and not asked and not is_gone:
                    place = f"{scope['method']} {scope['path']}"
                    # After a login, log the new person.
                    LOG.info("%s: %r: %s", state["who"] or "nobody", place, message["status"])
            await send(message)

        refusal = self._refusal(scope, headers)
        if refusal is not None:
            await refusal(scope, receive_noted, send_sealed)
            return
        await self.app(scope, receive_noted, send_sealed)

    def _refusal(self, scope: Scope, headers: Headers) -> Response | None:
        foreign = refuse_foreign(scope, headers, self.access.hosts)
        if foreign is not None:
            return foreign
        path, method, state = scope["path"], scope["method"], scope["state"]
        who, role, session = state["who"], state["role"], state["session"]
        if role is None:
            return refusal(403, f"none of the groups of {who} has a role here")
        if state["is_proxied"] and path == "/login":
            return RedirectResponse("/", status_code=303)
        if path not in OPEN and who is None:
            if method == "GET" and path == "/":
                return RedirectResponse("/login", status_code=303)
            return refusal(401, "log in first")
        if method in SAFE:
            return None
        if path not in OPEN and not self.access.may_change(role, path):
            return refusal(403, f"the role of {who}, {role}, does not allow this")
        if headers.get("sec-fetch-site", "same-origin") != "same-origin":
            return refusal(403, "this comes from a page of another server")
        is_chunk = method == "PUT" and path.endswith(CHUNK_SUFFIX)
        kind = "application/octet-stream" if is_chunk else "application/json"
        if headers.get("content-type", "").partition(";")[0] != kind:
            return refusal(415, "only bytes are taken in" if is_chunk else "only JSON is taken in")
        if path not in OPEN and not self.access.has_form_secret(
            session or "", headers.get("x-form-secret", "")
        ):
            return refusal(403, "the page is of another session: load it again")
        length = headers.get("content-length", "")
        if not (length.isascii() and length.isdigit()):  # without a length, the size is unbounded
            return refusal(411, "state its length")
        limit = CHUNK_BYTES if is_chunk else BODY_BYTES
        if len(length) > 12 or int(length) > limit:
            return refusal(413, f"at most {limit} bytes are taken in")
        return None


def _cookie(headers: Headers, name: str) -> str | None:
    try:
        found = SimpleCookie(headers.get("cookie", "")).get(name)
    except CookieError:
        return None
    return None if found is None else found.value


def _seal(headers: MutableHeaders, path: str) -> None:
    headers.setdefault("content-security-policy", POLICY)
    headers["x-content-type-options"] = "nosniff"
    headers["x-frame-options"] = "DENY"
    headers["referrer-policy"] = "no-referrer"
    headers["cross-origin-opener-policy"] = "same-origin"
    headers["cross-origin-resource-policy"] = "same-origin"
    if "cache-control" not in headers:
        headers["cache-control"] = "no-store"
