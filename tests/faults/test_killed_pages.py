"""The server of the review pages killed between taking an edit in and keeping it."""

import contextlib
import multiprocessing
import os
import random
import re
import signal
import socket
import subprocess
import threading
import time
from collections import Counter
from concurrent.futures import ThreadPoolExecutor

import pytest
from command_line import WORLDPOSE
from editing import Editor, account
from page_client import MATCH, TOKEN

from flows.registering import register
from worldpose.store.store import Store

pytestmark = pytest.mark.faults

STEPS = 20
"""Steps of saving within which a server dies: those of three edits."""

ANSWERED = re.compile(
    rf"^\d{{4}}-\d\d-\d\d \d\d:\d\d:\d\d,\d{{3}}  (\w+): 'POST {MATCH}/corrections': 200$", re.M
)
"""A line of the log: when, who, what, and the answer."""


class Disk:
    """A disk that keeps what was synced; at its last step the power fails.

    Around each sync and link of the process, in the order they come, lies a step. What was linked
    and whose folder was not synced since is gone when the power fails.
    """

    def __init__(self, last):
        self.left = last
        self.sync, self.link = os.fsync, os.link
        self.pending = {}
        self.lock = threading.Lock()

    def install(self):
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

    Disk(last).install()
    calibration.warm_up = lambda context: None  # a second of kernels in each life
    access = access_for("127.0.0.1", token=TOKEN, names=(), secure=False)
    serve(str(project), access, host="127.0.0.1", port=port, tls=None)


class MortalServer:
    """The server in copies of this process, each dying after some steps, the last one living."""

    def __init__(self, project, seed, deaths):
        self.arguments = (project, free_port())
        rng = random.Random(seed)
        self.lives = [rng.randint(1, STEPS) for _ in range(deaths)]
        self.died = 0
        self.start()

    def start(self):
        last = self.lives.pop(0) if self.lives else -1
        arguments = (*self.arguments, last)
        clean = multiprocessing.get_context("forkserver")
        self.process = clean.Process(target=serve_and_die, args=arguments, daemon=True)
        self.process.start()

    def revive(self):
        self.process.join(60)
        assert self.process.exitcode == -signal.SIGKILL
        self.died += 1
        self.start()


def free_port():
    """Return a free port below the ephemeral range, so that no client takes it meanwhile."""
    for port in random.sample(range(20_000, 32_000), 100):
        with socket.socket() as end, contextlib.suppress(OSError):
            end.bind(("127.0.0.1", port))
            return port
    raise OSError("no port is free")


@pytest.fixture
def project(tiny, tmp_path):
    store = Store.create(tmp_path / "project")
    register(store, tiny)
    return tmp_path / "project"


def edited_while_dying(project, seed, deaths):
    """Somebody's edits through the deaths of the server, the last one after them; deaths."""
    server = MortalServer(project, seed, deaths)
    editor = Editor(server.arguments[1], "Ada", "cam03", seed, server.revive)
    try:
        editor.open_page()
        for _ in range(STEPS * deaths):
            if server.died == deaths:
                break
            editor.edit()
        editor.edit()
    finally:
        server.process.kill()
        server.process.join()
    return editor, server.died


def more(*seeds):
    return [pytest.param(seed, 20, marks=pytest.mark.slow) for seed in seeds]


@pytest.mark.parametrize(("seed", "deaths"), [(0, 2), *more(1, 2, 3)])
def test_acknowledged_edits_survive_and_none_is_doubled(seed, deaths, project):
    editor, died = edited_while_dying(project, seed, deaths)
    assert died == deaths
    assert account(project, [editor]) == []


@pytest.mark.slow
@pytest.mark.timeout(1800)  # each start takes seconds of processor time
def test_the_command_killed_at_random_moments_under_two_editors(project, tmp_path):
    rng, port, kills = random.Random(7), free_port(), 8
    editors = [Editor(port, "Ada", "cam03", 1), Editor(port, "Bob", "cam00", 2)]
    over = threading.Event()

    def work(editor):
        editor.open_page()
        while not over.is_set():
            editor.edit()
        editor.edit()

    with (tmp_path / "pages.log").open("ab") as log, ThreadPoolExecutor(2) as pool:
        server = start(project, port, log)
        try:
            at_work = [pool.submit(work, editor) for editor in editors]
            for _ in range(kills):
                editors[0].await_server()
                wanted = sum(editor.answers for editor in editors) + rng.randrange(3)
                while sum(editor.answers for editor in editors) < wanted:
                    assert not any(each.done() for each in at_work), [e.result() for e in at_work]
                    time.sleep(0.005)
                time.sleep(rng.uniform(0.0, 0.1))  # about as long as saving takes
                server.kill()
                assert server.wait() == -signal.SIGKILL
                server = start(project, port, log)
        finally:
            over.set()
            for each in at_work:
                each.result()
            server.terminate()
            server.wait()
    assert account(project, editors) == []
    assert sum(editor.cuts for editor in editors) >= kills // 2
    said = Counter(ANSWERED.findall((tmp_path / "pages.log").read_text()))
    for editor in editors:
        assert said[editor.who] >= editor.answers > 0


def start(project, port, log):
    """The command in a process of its own."""
    command = [*WORLDPOSE, "review", "serve", "--port", str(port), "--project", str(project)]
    environment = {**os.environ, "WORLDPOSE_REVIEW_TOKEN": TOKEN}
    return subprocess.Popen(command, env=environment, stdout=log, stderr=log)
