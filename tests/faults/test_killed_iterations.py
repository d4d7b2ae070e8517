"""Iterations and the server of the review pages, killed anywhere and begun again."""

import http.client
import json
import multiprocessing
import os
import random
import signal
import threading
import time
from collections import Counter
from contextlib import contextmanager

import pytest
from command_line import TINY
from page_client import MATCH, TOKEN
from service import free_ports
from test_killed_runs import assert_nothing_half_written, assert_same_store

from data_contracts.review import Correction, DeletedDetection
from flows import iterate
from flows import match as match_flow
from flows.iterate import iterate_match
from flows.match import task_of
from flows.registering import open_match, register
from flows.review.verdicts import correct
from flows.run_record import RunLog
from flows.running import RunRequest
from flows.settings import selected_stages
from worldpose.review.journal import read_journal
from worldpose.simulation.matches import MatchOptions, simulate_match
from worldpose.simulation.scenarios import SCENARIOS
from worldpose.store.blobs import install_fault_hook
from worldpose.store.store import Store

pytestmark = pytest.mark.faults

PASSES = 2


def compute_here(stage, units, work):
    """Compute each unit in this process, as a Prefect task on a Dask worker would."""
    task = task_of(stage)
    for unit, each in zip(units, work, strict=True):
        task.fn(each)
        yield unit, None


def run_here(store, match, request):
    match = open_match(store, match.match_id)  # as the flow does: it may have been edited
    stages = selected_stages(request.from_stage, request.until_stage)
    log = RunLog.begin(store, match, stages, request.settings, "never", request.iteration)
    return match_flow.run_stages(log, request.time_limits)


@contextmanager
def no_machines(store, request):
    yield lambda missing: request


def loop(project, folder, at_commit_point):
    """The loop over iterations in this process."""
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(match_flow, "compute", compute_here)
        patch.setattr(iterate, "run_match", run_here)
        patch.setattr(iterate, "shared_machines", no_machines)
        install_fault_hook(at_commit_point)
        store = Store.open_or_new(str(project))
        match, _ = register(store, folder)
        iterate_match(store, match, RunRequest({}), PASSES)
        install_fault_hook(None)


def loop_and_die(project, folder, skip):
    """Run the loop in a fork that is killed at the commit point after `skip` others."""
    visits = []

    def strike(point):
        visits.append(point)
        if len(visits) > skip:
            os.kill(os.getpid(), signal.SIGKILL)

    def run():
        loop(project, folder, strike)
        os._exit(0)  # nothing of the test session ends with its copy

    process = multiprocessing.get_context("fork").Process(target=run)
    process.start()
    process.join(300)
    return process.exitcode


@pytest.fixture(scope="module")
def short(tmp_path_factory):
    """A third of a second of a small match with given cameras."""
    folder = tmp_path_factory.mktemp("short") / "match"
    options = {"duration": 0.32, "calibrated": True, "stills": False, "video": False}
    simulate_match(SCENARIOS["tiny"], 3, folder, MatchOptions(**options))
    return folder


@pytest.fixture(scope="module")
def undisturbed(short, tmp_path_factory):
    """A project without faults, and the commit points that its loop passed."""
    project = tmp_path_factory.mktemp("undisturbed") / "project"
    visits = []
    # Here, so that copies of this process find every kernel loaded.
    loop(project, short, visits.append)
    return project, visits


@pytest.mark.slow
@pytest.mark.parametrize("seed", range(20))
def test_killed_at_a_random_commit_point_of_the_loop(seed, short, undisturbed, tmp_path):
    reference, visits = undisturbed
    skip = random.Random(seed).randrange(len(visits))
    project = tmp_path / "project"
    assert loop_and_die(project, short, skip) == -signal.SIGKILL
    assert_nothing_half_written(project)
    loop(project, short, None)
    assert_same_store(project, reference)


def delete_a_box(project):
    """Edits of a person on another machine during the run."""
    store = Store.open(str(project))
    (match_id,) = store.matches()
    deleted = DeletedDetection(camera="cam01", frame=3, detection=0)
    correct(store, open_match(store, match_id), [deleted], who="Ada", why="a shadow")


def standing(project):
    """The latest run's results."""
    store = Store.open(str(project))
    (match_id,) = store.matches()
    return store.run(match_id).results


def assert_every_run_is_of_one_piece(project):
    """Inputs of a run's results are results of the same run, or of the previous pass.

    A pass continues the previous one, whose runs are therefore included.
    """
    store = Store.open(str(project))
    (match_id,) = store.matches()
    records = [store.run(match_id, run) for run in store.runs(match_id)]
    for record in records:
        passes = [each.results for each in records if each.iteration == record.iteration - 1]
        for name, key in record.results.items():
            recipe = store.manifest(match_id, *name.split("/"), key).recipe
            for source, made_from in recipe.inputs.items():
                before = {results.get(source) for results in passes}
                assert made_from == record.results.get(source) or made_from in before, name


@pytest.fixture(scope="module")
def edited(short, tmp_path_factory):
    """A project in which the same was done after the edit."""
    project = tmp_path_factory.mktemp("edited") / "project"
    register(Store.create(str(project)), short)
    delete_a_box(project)
    loop(project, short, None)
    return project


@pytest.mark.slow
@pytest.mark.parametrize("seed", range(4))
def test_an_edit_at_a_random_moment_of_the_loop(seed, short, undisturbed, edited, tmp_path):
    reference, visits = undisturbed
    moment = random.Random(seed).randrange(len(visits))
    project = tmp_path / "project"
    seen = []

    def strike(point):
        seen.append(point)
        if len(seen) == moment + 1:
            delete_a_box(project)

    loop(project, short, strike)
    assert len(seen) > moment
    assert_every_run_is_of_one_piece(project)
    assert standing(project) in (standing(reference), standing(edited))
    loop(project, short, None)
    assert standing(project) == standing(edited)


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
