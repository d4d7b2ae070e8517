"""A match has one state with one thing to do, and pages, command and status page agree on it."""

import shutil
import subprocess

import page_client
import psutil
import pytest
from command_line import TINY, succeed
from page_client import MATCH

from data_contracts.review import NamedTrack, SplitTrack
from data_contracts.run import UnitFailure
from flows import run_record
from flows.layers import write_layer
from flows.match_state import NEEDS_FILES, _find, match_state
from flows.method import METHOD
from flows.overview import read_summary
from flows.registering import open_match
from flows.review.corrections import keep_edits
from flows.review.verdicts import decide, withdraw
from flows.run_plan import plan_run
from flows.run_record import describe_end
from flows.running import RunRequest, run_match
from worldpose.store.paths import ResultId


def say(store, **edits):
    keep_edits(store, lambda: open_match(store, TINY), edits, who="Ada", note="")


def state(store):
    return match_state(store, open_match(store, TINY))


def fail(store, state):
    """Add a run whose tracking failed; all that comes later is blocked."""
    later = [stage.name for stage in METHOD][[s.name for s in METHOD].index("tracking") :]
    first = store.run(TINY)
    keys = {unit.name: unit.key for unit in plan_run(store, open_match(store, TINY), {})}
    kept = {name: key for name, key in first.results.items() if name.partition("/")[0] not in later}
    for stage in later:
        shutil.rmtree(f"{store.url}/results/{TINY}/{stage}", ignore_errors=True)
    failure = UnitFailure(
        unit="tracking/clip", error="InputError", message="no light", key=keys["tracking/clip"]
    )
    record = first.model_copy(
        update={
            "run_id": store.reserve_run(TINY),
            "parent": first.run_id,
            "state": state,
            "results": kept,
            "failed": (failure,),
            "blocked": ("triangulation/clip", "body_fitting/clip"),
        }
    )
    store.finish_run(record)
    return record


def test_corrections_make_a_match_out_of_date_and_names_do_not(store):
    assert (state(store).name, state(store).words) == ("ready", "usable with reservations")
    say(store, name=NamedTrack(clip="clip", person=0, name="Ann"))
    assert state(store).name == "ready"
    say(store, split=SplitTrack(clip="clip", person=0, first_frame_of_new=12))
    found = state(store)
    assert (found.name, found.words) == ("outdated", "out of date because of 1 correction")
    assert found.seconds > 10.0
    withdraw(store, open_match(store, TINY), ["split"], who="Ada", why="")
    assert state(store).name == "ready"


def test_questions_then_answers(store):
    run_match(store, open_match(store, TINY), RunRequest({}, gates="auto"))
    assert state(store).words == "2 questions"
    match, latest = open_match(store, TINY), store.run(TINY)
    lost = {**latest.figures, "tracking/clip": {"unmatched_share": 0.6}}
    found = _find(store, match, latest.model_copy(update={"figures": lost}), {}, [], [])
    assert (found.words, found.todo) == ("not usable, 2 questions", NEEDS_FILES)
    decide(store, open_match(store, TINY), (), "approve", who="Ada", why="")
    assert state(store).words == "out of date because its questions are answered"


@pytest.mark.parametrize(
    ("kind", "words"), [("failed", "failed: tracking of clip"), ("partial", "partial: tracking of")]
)
def test_a_failure_has_its_reason_everywhere(store, project_copy, kind, words):
    record = fail(store, kind)
    found = state(store)
    assert found.name == kind
    assert found.words.startswith(words)
    assert found.why == "no light. 2 later steps wait for it."
    assert "tracking/clip: no light" in describe_end(record)
    assert ("partial" in describe_end(record)) == (kind == "partial")
    ada = page_client.log_in(page_client.served(project_copy), "Ada")
    (status,) = ada.get("/api/status").json()["matches"]
    (row,) = succeed("status", "--json", "--project", project_copy).json["matches"]
    pages = [ada.get(MATCH).json(), *ada.get("/api/matches").json()["matches"]]
    seen = [(page["state"]["words"], page["state"]["why"]) for page in pages]
    seen += [(each["now"], each["why"]) for each in (status, row)]
    assert set(seen) == {(found.words, found.why)}


def test_a_run_that_was_killed_is_stopped_and_can_be_continued(store, monkeypatch):
    gone = subprocess.Popen(["true"])
    gone.wait()
    with monkeypatch.context() as patched:
        patched.setattr("os.getpid", lambda: gone.pid)
        number = store.reserve_run(TINY)
    found = state(store)
    assert (found.name, found.words) == ("stopped", "stopped before its end")
    assert f"Run {number} ended before it was recorded" in found.why
    store.reserve_run(TINY)  # of this process, which is at work
    assert state(store).name == "running"


def test_a_match_is_not_ready_while_iterations_are_set_that_were_not_run(store):
    write_layer(store, f"matches/{TINY}", {"iterations": 2})
    found = state(store)
    assert (found.name, found.words) == ("outdated", "out of date because of its iterations")
    assert found.why.startswith("2 iterations are to be run") and found.seconds > 10.0
    assert not read_summary(store, TINY).is_settled  # reprocessing runs it
    write_layer(store, f"matches/{TINY}", {"iterations": "auto"})  # one alone cannot be the best
    assert state(store).words == "out of date because of its iterations"
    assert not read_summary(store, TINY).is_settled
    write_layer(store, f"matches/{TINY}", {})
    first = store.run(TINY)
    others = {name: key for name, key in first.results.items() if name != "tracking/clip"}
    second = {"run_id": store.reserve_run(TINY), "iteration": 2, "results": others}
    store.finish_run(first.model_copy(update=second))
    assert state(store).words == "out of date because of its iterations"  # 1 is set again


def test_a_run_is_at_work_whatever_becomes_of_the_clock(store, monkeypatch):
    with subprocess.Popen(["sleep", "60"]) as work:
        with monkeypatch.context() as patched:
            patched.setattr("os.getpid", lambda: work.pid)
            store.reserve_run(TINY)
        begun = psutil.Process.create_time
        monkeypatch.setattr(psutil.Process, "create_time", lambda self: begun(self) + 7200.0)
        assert state(store).name == "running"
        # A later process has the number of a killed one.
        monkeypatch.setattr(run_record, "identify_process", lambda pid: "another")
        assert state(store).name == "stopped"
        work.kill()


def test_a_result_that_was_removed_makes_a_match_out_of_date_everywhere(store):
    key = store.run(TINY).results["triangulation/clip"]
    store.withdraw(ResultId.from_name(TINY, "triangulation/clip", key))
    found, summary = state(store), read_summary(store, TINY)
    assert (found.name, found.words) == ("outdated", "out of date because results were removed")
    assert (summary.kind, summary.words, summary.problem) == (found.name, found.words, "")
    (unit,) = summary.stages["triangulation"]
    assert (unit.state, unit.why) == ("failed", "its result was withdrawn or removed")
