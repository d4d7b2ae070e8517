"""A browser for tests of the pages' server, and what its addresses are."""

import os
import socket
import subprocess
import time
import urllib.error
import urllib.request
import warnings
from contextlib import contextmanager
from pathlib import Path

from command_line import TINY, WORLDPOSE

from flows.web.access import access_for
from flows.web.app import create_app
from flows.web.intake import Intake

with warnings.catch_warnings():
    warnings.simplefilter("ignore")  # of the web framework, about its own test client
    from fastapi.testclient import TestClient

TOKEN = "a-token-of-twenty-four.."
HERE = "http://127.0.0.1:8571"
MATCH = f"/api/matches/{TINY}"


def served(project):
    """The server of a project's pages, with an inbox for new matches."""
    access = access_for("127.0.0.1", token=TOKEN, names=(), secure=False)
    app = create_app(str(project), access, Intake(Path(project) / "inbox"))
    app.state.access = access
    return app


def browser(app):
    """A browser that has not logged in."""
    return TestClient(app, base_url=HERE)


def log_in(app, who):
    """A browser that has, with the form secret."""
    logged_in = browser(app)
    assert logged_in.post("/api/login", json={"who": who, "token": TOKEN}).status_code == 200
    secret = logged_in.get("/api/session").json()["form_secret"]
    logged_in.headers["x-form-secret"] = secret
    return logged_in


def free_port():
    with socket.create_server(("127.0.0.1", 0)) as free:
        return free.getsockname()[1]


def wait_until_up(base):
    """Wait until a server of pages answers."""
    for _ in range(240):
        try:
            with urllib.request.urlopen(f"{base}/api/health"):
                return
        except urllib.error.URLError:
            time.sleep(0.5)


@contextmanager
def serving(project, folder, *options):
    """The address of a process that serves a project's pages; its log lies in a folder."""
    port = free_port()
    environment = {**os.environ, "WORLDPOSE_REVIEW_TOKEN": TOKEN}
    command = [*WORLDPOSE, "review", "serve", "--port", str(port), "--project", str(project)]
    command += map(str, options)
    with (folder / "pages.log").open("wb") as log:
        server = subprocess.Popen(command, env=environment, stdout=log, stderr=log)
    base = f"http://127.0.0.1:{port}"
    try:
        wait_until_up(base)
        yield base
    finally:
        server.terminate()
        server.wait(30)


def a_click(browser, camera="cam03"):
    clicked = browser.get(f"{MATCH}/pictures/{camera}").json()["points"]
    return next(iter(sorted(clicked.items())))


def moved(name, was, xy, number=1, camera="cam03"):
    edit = {"kind": "moved_point", "camera": camera, "marking": name, "was": was, "xy": xy}
    return {"edits": [{"id": f"moved_point.{number:012x}", "edit": edit}]}
