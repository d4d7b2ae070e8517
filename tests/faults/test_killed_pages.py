"""The server of the review pages killed between taking an edit in and keeping it."""

import http.client
import json
import multiprocessing
import os
import random
import signal
import threading
import time
from collections import Counter

import pytest
from command_line import TINY
from page_client import MATCH, TOKEN
from service import free_ports

from data_contracts.review import Correction
from flows.registering import open_match, register
from worldpose.review.journal import read_journal
from worldpose.store.store import Store

pytestmark = pytest.mark.faults

STEPS = 20
"""Steps of saving within which a server dies: those of three edits."""
PATIENCE = 300.0
"""Seconds until a server that was started has to answer."""


class Disk:
    """A disk that keeps what was synced; at its last step the power fails.

    Around each sync and link of the process, in the order they come, lies a step. What was linked
    and whose folder was not synced since is gone when the power fails.
    """

    def __init__(self, last):
        self.left, self.pending, self.lock = last, {}, threading.Lock()
        self.sync, self.link = os.fsync, os.link
        os.fsync, os.link = self.fsync_once, self.link_once

    def step(self):
        with self.lock:
            self.left -= 1
            if self.left == 0:
                for path in self.pending:
                    path.unlink()
                os.kill(os.getpid(), signal.SIGKILL)

    def fsync_once(self, descriptor):
        self.step()
        self.sync(descriptor)
        synced = os.fstat(descriptor).st_ino
        with self.lock:
            self.pending = {p: own for p, own in self.pending.items() if synced != own}
        self.step()

    def link_once(self, source, target):
        self.step()
        with self.lock:
            self.link(source, target)
            self.pending[target] = target.parent.stat().st_ino
        self.step()


def serve_and_die(project, port, last):
    from flows.web import calibration
    from flows.web.access import access_for
    from flows.web.app import serve

    Disk(last)
    calibration.warm_up = lambda context: None  # a second of kernels in each life
    access = access_for("127.0.0.1", token=TOKEN, names=(), secure=False)
    serve(str(project), access, host="127.0.0.1", port=port, tls=None)


class MortalServer:
    """The server in copies of this process, each dying after some steps, the last one living."""

    def __init__(self, project, rng, deaths):
        self.project, self.died = project, 0
        (self.port,) = free_ports(1)
        self.lives = [rng.randint(1, STEPS) for _ in range(deaths)]
        self.start()

    def start(self):
        arguments = (self.project, self.port, self.lives.pop(0) if self.lives else -1)
        clean = multiprocessing.get_context("forkserver")
        self.process = clean.Process(target=serve_and_die, args=arguments, daemon=True)
        self.process.start()

    def revive(self):
        self.process.join(60)
        assert self.process.exitcode == -signal.SIGKILL
        self.died += 1
        self.start()


class Editor:
    """A person who moves clicks of a camera, and knows what was acknowledged.

    After a cut the very same edits are sent again, or else given up and the page loaded again.
    """

    def __init__(self, server, rng):
        self.server, self.rng = server, rng
        self.sent, self.acknowledged = {}, []
        self.headers = {"content-type": "application/json"}
        login = self.insist("POST", "/api/login", {"who": "Ada", "token": TOKEN})
        self.headers["cookie"] = login[2].partition(";")[0]
        self.headers["x-form-secret"] = self.insist("GET", "/api/session")[1]["form_secret"]
        self.look()

    def look(self):
        self.places = self.insist("GET", f"{MATCH}/pictures/cam03")[1]["points"]

    def edit(self):
        """Move up to three clicks at once, until it is acknowledged or given up."""
        names = self.rng.sample(sorted(self.places), self.rng.randint(1, 3))
        moved = {name: [self.rng.uniform(0, 900), self.rng.uniform(0, 500)] for name in names}
        batch = {}
        for name, xy in moved.items():
            place = {"camera": "cam03", "marking": name, "was": self.places[name], "xy": xy}
            batch[f"moved_point.{self.rng.getrandbits(64):016x}"] = {"kind": "moved_point", **place}
        self.sent |= batch
        edits = {"edits": [{"id": number, "edit": edit} for number, edit in batch.items()]}
        while (answer := self.ask("POST", f"{MATCH}/corrections", edits)) is None:
            self.server.revive()
            self.insist("GET", "/api/health")
            if self.rng.random() < 0.3:
                self.look()
                return
        assert answer[0] == 200, answer
        self.acknowledged += batch
        self.places |= moved

    def insist(self, method, path, body=None):
        """The answer of a server that is there or comes back, in time."""
        deadline = time.monotonic() + PATIENCE
        while (answer := self.ask(method, path, body)) is None:
            assert time.monotonic() < deadline, "the server does not come back"
            if self.server.process.exitcode is not None:  # it died of what a request keeps
                self.server.revive()
            time.sleep(0.02)
        assert answer[0] == 200, answer
        return answer

    def ask(self, method, path, body=None):
        """Status, content and cookie of the answer; None where the server is gone."""
        connection = http.client.HTTPConnection("127.0.0.1", self.server.port, timeout=PATIENCE)
        try:
            content = None if body is None else json.dumps(body)
            connection.request(method, path, content, self.headers)
            answer = connection.getresponse()
            return answer.status, json.loads(answer.read()), answer.headers.get("set-cookie", "")
        except (OSError, http.client.HTTPException, json.JSONDecodeError):
            return None
        finally:
            connection.close()


@pytest.mark.slow
@pytest.mark.parametrize(("seed", "deaths"), [(0, 2), (1, 20), (2, 20), (3, 20)])
def test_acknowledged_edits_survive_and_none_is_doubled(seed, deaths, tiny, tmp_path):
    store, rng = Store.create(str(tmp_path / "project")), random.Random(seed)
    register(store, tiny)
    server = MortalServer(tmp_path / "project", rng, deaths)
    try:
        editor = Editor(server, rng)
        while server.died < deaths:
            editor.edit()
        editor.edit()
    finally:
        server.process.kill()
        server.process.join()
    journal = read_journal(store, TINY)
    kept = [each for each in journal.records if isinstance(each, Correction)]
    assert journal.damage == ()
    assert max(Counter(each.id for each in kept).values()) == 1
    for each in kept:
        sent = editor.sent[each.id]
        assert (each.edit.model_dump(mode="json", include=set(sent)), each.who) == (sent, "Ada")
    # What was acknowledged is there, in its order; what was given up may be.
    acknowledged = [each.id for each in kept if each.id in editor.acknowledged]
    assert acknowledged == editor.acknowledged
    clicked = open_match(store, TINY).folder.clicked["cam03"]
    assert {each.name: list(each.xy) for each in clicked.points} == editor.places
