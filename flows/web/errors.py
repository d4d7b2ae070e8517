"""Errors as responses that a page can show."""

from __future__ import annotations

import errno
import logging

from fastapi import FastAPI, Request
from fastapi.exceptions import RequestValidationError
from fastapi.responses import JSONResponse

from flows.review.edit_conflicts import StaleEditError
from worldpose.errors import InputError, InternalError, WorldposeError

LOG = logging.getLogger("worldpose.pages")


def add_answers(app: FastAPI) -> None:
    """Answer with JSON: 409 and the difference, 422 and what to do, 500 or 507 and the reason."""

    @app.exception_handler(StaleEditError)
    def stale(request: Request, error: StaleEditError) -> JSONResponse:
        return JSONResponse(
            {"error": str(error), "difference": dict(error.difference)}, status_code=409
        )

    @app.exception_handler(InputError)
    def unfit(request: Request, error: InputError) -> JSONResponse:
        parts = {name: getattr(error, name) for name in ("where", "expected", "found", "todo")}
        return JSONResponse({"error": str(error), **parts}, status_code=422)

    @app.exception_handler(RequestValidationError)
    def malformed(request: Request, error: RequestValidationError) -> JSONResponse:
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
    def failed(request: Request, error: WorldposeError) -> JSONResponse:
        said = " ".join(str(error).split())
        LOG.warning("%s %r failed: %s", request.method, request.url.path, said)
        cause = error.__cause__
        is_full = isinstance(cause, OSError) and cause.errno in (errno.ENOSPC, errno.EDQUOT)
        return JSONResponse({"error": str(error)}, status_code=507 if is_full else 500)

    @app.exception_handler(Exception)
    def unforeseen(request: Request, error: Exception) -> JSONResponse:
        """Report an internal error: traceback in the log, no blame of the user on the page."""
        where = f"{request.method} {request.url.path}"
        return JSONResponse({"error": str(InternalError.wrapping(where, error))}, status_code=500)
