"""The state of a match, and the record of a run whose units fail or whose match is edited."""

import shutil
import subprocess

import page_client
import psutil
import pytest
from command_line import TINY, succeed, worldpose
from page_client import MATCH

from data_contracts.review import NamedTrack, SplitTrack
from data_contracts.run import UnitFailure
from flows import iterate, run_record
from flows.gates import Gatekeeper
from flows.iterate import Iteration, iterate_match
from flows.layers import write_layer
from flows.match_state import NEEDS_FILES, _find, match_state
from flows.method import METHOD
from flows.overview import read_summary
from flows.registering import open_match
from flows.review.corrections import keep_edits
from flows.review.edit_conflicts import EditedMeanwhileError
from flows.review.verdicts import correct, decide, withdraw
from flows.run_plan import RunPlan, plan_run
from flows.run_record import RunLog, describe_end
from flows.run_status import run_status
from flows.running import RunRequest, run_match, settle
from worldpose.store.paths import ResultId


def say(store, **edits):
    keep_edits(store, lambda: open_match(store, TINY), edits, who="Ada", note="")


def state(store):
    return match_state(store, open_match(store, TINY))


def fail(store, state):
    """Add a run whose tracking failed; all that comes later is blocked."""
    names = [stage.name for stage in METHOD]
    later, first = names[names.index("tracking") :], store.run(TINY)
    keys = {unit.name: unit.key for unit in plan_run(store, open_match(store, TINY), {})}
    kept = {name: key for name, key in first.results.items() if name.partition("/")[0] not in later}
    for stage in later:
        shutil.rmtree(f"{store.url}/results/{TINY}/{stage}", ignore_errors=True)
    about = {"unit": "tracking/clip", "key": keys["tracking/clip"]}
    failure = UnitFailure(error="InputError", message="no light", **about)
    blocked = ("triangulation/clip", "body_fitting/clip")
    changed = {"state": state, "results": kept, "failed": (failure,), "blocked": blocked}
    changed |= {"run_id": store.reserve_run(TINY), "parent": first.run_id}
    store.finish_run(first.model_copy(update=changed))
    return store.run(TINY)


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


def split(store):
    """Record the correction that a track is two people."""
    edit = SplitTrack(clip="clip", person=0, first_frame_of_new=12)
    correct(store, open_match(store, TINY), [edit], who="Ada", why="two people")


def recorded(store, stages, failing=None, before_stage=None):
    """A run of `stages` that finds everything in the store, but for what fails."""
    log = RunLog.begin(store, open_match(store, TINY), stages, {})
    for stage in stages:
        if before_stage == stage.name:
            split(store)
        for unit in log.plan.plan_stage(stage):
            log.finish_unit(unit, RuntimeError("x") if stage.name == failing else None)
    return log.close()


BEHIND_CAMERAS = (
    *("body_fitting/clip", "bundle_adjustment/cameras", "camera_consistency/clip"),
    *("retriangulation/clip", "tracking/clip", "triangulation/clip"),
)


@pytest.mark.parametrize(
    ("failing", "until", "state", "blocked"),
    [
        ("filtering", "filtering", "partial", ()),  # the bodies are there
        ("filtering", "refitting", "complete", ()),  # it was not asked for
        ("body_fitting", "filtering", "failed", ("filtering/clip",)),
        # No unit is refitted here: that the last stage has none makes nothing fail.
        ("ingest", "refitting", "failed", BEHIND_CAMERAS),
        ("tracking", "tracking", "failed", ()),
    ],
)
def test_a_run_with_bodies_is_partial_whatever_fails_after_them(
    store, failing, until, state, blocked
):
    names = [stage.name for stage in METHOD]
    record = recorded(store, METHOD[: names.index(until) + 1], failing)
    assert (record.state, record.blocked) == (state, blocked)
    stages = {failure.unit.split("/")[0] for failure in record.failed}
    assert stages == (set() if state == "complete" else {failing})
    assert all(failure.key is not None for failure in record.failed)


def test_a_run_during_an_edit_has_the_match_as_it_began_and_the_edit_is_seen_next(store):
    before = store.run(TINY)
    record = recorded(store, METHOD, before_stage="tracking")
    assert record.state == "complete"
    assert record.results == before.results, "no unit of the edited match is among the others"
    found = run_status(store, TINY)
    assert found.latest.run_id == record.run_id
    assert {unit.planned.name for unit in found.units if unit.own_reasons} == {"tracking/clip"}


def test_iterations_begin_again_when_the_match_is_edited_between_two(store, monkeypatch):
    begun = []

    def one_pass(store, match, request, machines_for):
        begun.append((request.iteration, len(match.corrections)))
        if request.iteration == 2 and not match.corrections:
            split(store)
            raise EditedMeanwhileError("x", expected="a", found="b", todo="c")
        return Iteration(request.iteration, store.run(TINY), None)

    monkeypatch.setattr(iterate, "_pass", one_pass)
    iterate_match(store, open_match(store, TINY), RunRequest({}), 2)
    assert begun == [(1, 0), (2, 0), (1, 1), (2, 1)]


def test_all_iterations_ask_as_the_run_that_waits(store, monkeypatch):
    asked, first = [], store.run(TINY)

    def one_pass(store, match, request, machines_for):
        asked.append(request.gate_policy(match, store.run(TINY)))
        store.finish_run(first.model_copy(update={"run_id": store.reserve_run(TINY)}))
        return Iteration(request.iteration, store.run(TINY), None)

    monkeypatch.setattr(iterate, "_pass", one_pass)
    monkeypatch.setattr(iterate, "run_match", lambda *_: first)
    waits = {"run_id": store.reserve_run(TINY), "state": "waiting", "gates": "auto"}
    store.finish_run(first.model_copy(update=waits))
    iterate_match(store, open_match(store, TINY), RunRequest({}), 2)
    assert asked == ["auto", "auto"]


def test_a_run_is_judged_by_the_limits_of_its_match_and_anew_when_they_change(store):
    click = (
        "clicks of cam03 contradict the others and are not used: 1 (penalty mark left). "
        "Correct or remove them."
    )
    assert store.run(TINY).usability.reservations == (click,)
    asked = ("run", TINY, "--project", store.url, "--json")
    succeed("settings", TINY, "--set", "max_ray_distance_m=0.001", "--project", store.url)
    done = worldpose(*asked)
    assert (done.code, done.json["executed"]) == (0, 0)
    also, said = done.json["usability"]["reservations"]
    assert also == click and said in done.json["warnings"]
    assert done.json["usability"]["verdict"] == "usable with reservations"
    assert "cameras disagree by 5.89 cm (limit 0.1 cm) about where people are in clip" in said
    assert f"reservation: {said}" in " ".join(done.err.split())
    (row,) = succeed("status", TINY, "--project", store.url, "--json").json["matches"]
    assert (row["now"], row["usability"]) == ("usable with reservations", done.json["usability"])
    assert succeed(*asked).json["run"] == done.json["run"]


@pytest.mark.parametrize("failing", [None, "filtering"])
def test_no_person_is_placed_whatever_else_fails(store, monkeypatch, failing):
    read = RunLog._read_manifest

    def read_empty(log, name):
        manifest = read(log, name)
        if name == "tracking/clip":
            log.figures[name] = {**manifest.figures, "people": 0.0}
        return manifest

    monkeypatch.setattr(RunLog, "_read_manifest", read_empty)
    record = recorded(store, METHOD, failing)
    assert (record.state, record.usability.verdict) == ("partial", "not usable")
    assert record.usability.reservations[0].startswith("no person is placed.")


def test_a_part_continues_the_iteration_of_the_latest_run(store):
    first, stages = store.run(TINY), METHOD[: [each.name for each in METHOD].index("tracking") + 1]
    later = {"run_id": store.reserve_run(TINY), "iteration": 2}
    store.finish_run(first.model_copy(update=later))
    latest = store.run(TINY)
    gatekeeper = Gatekeeper(store, open_match(store, TINY), "never")
    plan = RunPlan.begin(gatekeeper, stages, {}, latest, 1)
    assert (plan.iteration, plan.before["filtering/clip"]) == (2, first.results["filtering/clip"])
    assert RunPlan.begin(gatekeeper, METHOD, {}, latest, 1).iteration == 1
    # The last stage ends the whole method, however it is asked for.
    match, asked = open_match(store, TINY), RunRequest({}, until_stage="filtering", iterations=2)
    assert settle(store, match, asked)[1].iterations == 2
    # Without the results of the first iteration, as after an edit, a part begins there.
    shutil.rmtree(f"{store.url}/results/{TINY}/filtering")
    plan = RunPlan.begin(gatekeeper, stages, {}, latest, 1)
    assert (plan.iteration, plan.before) == (1, None)


def test_a_record_names_no_setting_of_a_stage_that_its_run_took_over(store):
    given = {"static_calibration": {"click_noise_px": 3.0}, "filtering": {}}
    log = RunLog.begin(store, open_match(store, TINY), METHOD[-1:], given)
    record = log.run_stages(lambda stage, units: ())
    assert record.overrides == {"filtering": {}}
    assert log.plan.is_recorded_by(record)
