"""A change at Prefect is repeated in its server while SQLite's one writer is busy."""

import pytest
from starlette.applications import Starlette
from starlette.responses import JSONResponse
from starlette.routing import Route
from starlette.testclient import TestClient

from flows.orchestration.prefect_server import REPETITIONS, RepeatBusy


class BusyError(Exception):
    """The database's."""


@pytest.fixture
def server():
    """A server that refuses so many requests, as Prefect does, and what it was sent."""

    async def create(request):
        app.state.got.append(await request.json())
        if len(app.state.got) <= app.state.refusals:
            raise BusyError
        return JSONResponse({"number": len(app.state.got)}, 201)

    async def say_busy(request, error):
        return JSONResponse({"exception_message": "Service Unavailable"}, 503)

    routes = [Route("/create", create, methods=["POST"])]
    app = Starlette(routes=routes, exception_handlers={Exception: say_busy})
    app.state.got, app.state.refusals = [], 0
    return app


def send(app):
    client = TestClient(RepeatBusy(app, pause_s=0.0), raise_server_exceptions=False)
    return client.post("/create", json={"run": 1})


@pytest.mark.parametrize("refusals", [0, 1, REPETITIONS])
def test_a_refused_change_is_made_again_as_it_was(server, refusals):
    server.state.refusals = refusals
    answer = send(server)
    assert (answer.status_code, answer.json()) == (201, {"number": refusals + 1})
    assert server.state.got == [{"run": 1}] * (refusals + 1)


def test_a_database_that_stays_busy_is_told(server):
    server.state.refusals = 100
    assert send(server).status_code == 503
    assert len(server.state.got) == REPETITIONS + 1


def test_another_error_is_passed_on_once(server):
    assert TestClient(RepeatBusy(server)).post("/none").status_code == 404
    assert TestClient(RepeatBusy(server)).get("/create").status_code == 405
