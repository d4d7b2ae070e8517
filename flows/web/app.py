"""Server of the review pages."""

from __future__ import annotations

import errno
from collections.abc import AsyncIterator, Callable
from contextlib import asynccontextmanager
from importlib.resources import files
from pathlib import Path
from threading import Thread

from fastapi import APIRouter, FastAPI, Request
from fastapi.exceptions import RequestValidationError
from fastapi.responses import JSONResponse

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
from flows.web.access import LOOPBACK, Access
from flows.web.app_context import PageContext, Person
from flows.web.browser_words import describe_error
from flows.web.guard import LOG, Guard
from flows.web.http_server import serve_http
from flows.web.intake import Intake
from flows.web.intake import routes as routes_of_intake
from flows.web.sessions import answer_malformed, file_routes, login_routes
from worldpose.errors import InputError, InternalError, WorldposeError
from worldpose.store.store import Store


def create_app(project: str, access: Access, intake: Intake | None = None) -> FastAPI:
    """Create the server of a project's pages, or InputError if there is none.

    Without intake, people create no matches there.
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
    app.include_router(login_routes(access))
    app.include_router(_sessions(context, intake))
    tools = corrections, evidence, calibration, detections, identities
    for module in (queue, history, *tools, results, settings, status_page):
        app.include_router(module.routes(context))
    for with_inbox in (routes_of_intake, offsets.routes):
        app.include_router(with_inbox(context, intake))
    app.include_router(_files())
    url = context.store.url
    app.add_middleware(Guard, access=access, disk=None if "://" in url else Path(url))
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
    ours. Without intake, people create no matches here. InputError if there is no such project, or
    the port is taken.
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
    async def health() -> dict[str, str]:
        return {"state": "up"}

    @router.get("/api/session")
    async def session(request: Request, who: Person) -> dict[str, str | bool]:
        return {
            "who": who,
            "role": request.state.role,
            "form_secret": access.form_secret(request.state.session),
            "project": context.store.url,
            "takes_files": intake is not None and request.state.role == "approver",
        }

    return router


def _files() -> APIRouter:
    """Serve the built pages."""
    folder = files("flows.web") / "static"
    built = folder / "assets"
    assets = {f"/assets/{it.name}": it for it in built.iterdir()} if built.is_dir() else {}
    return file_routes({"/": folder / "index.html", **assets})


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

    app.exception_handler(RequestValidationError)(answer_malformed)

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
