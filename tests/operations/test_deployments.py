"""Deployments at a Prefect server, the runs that restart there, and the worker's refusals."""

import importlib
import os
import platform
import shutil
from contextvars import copy_context
from datetime import UTC, datetime, timedelta
from functools import partial
from pathlib import Path
from threading import Thread
from uuid import uuid4

import anyio
import pytest
import service
from command_line import TINY
from prefect import Flow
from prefect.client.schemas.objects import FlowRun
from prefect.flow_runs import resume_flow_run
from prefect.settings import PREFECT_API_AUTH_STRING, PREFECT_API_URL, temporary_settings

from data_contracts.review import ReviewDecision
from flows.orchestration.prefect_api import UnreachablePrefectError, of_types
from flows.registering import register
from flows.service import recovery
from flows.service.deployed import release_folder
from flows.service.deployments import DEPLOYED, install
from flows.service.layout import is_alive
from flows.service.match_runs import MatchRuns
from flows.service.plan import FLOWS, ServePlan, deployment_name, parse_schedules
from flows.service.recovery import adopt_due, recover
from flows.service.run_queue import beating, queued_run
from flows.service.worker import RefusedRunError, ServedWorker, require_installed
from flows.web import app_context
from flows.web.app_context import Continuing
from worldpose.errors import UsageError
from worldpose.review.journal import read_journal
from worldpose.store.runs import alone
from worldpose.store.store import Store

wait_until = partial(service.wait_until, pause=0.05)


@pytest.fixture(scope="module")
def plan(server, tmp_path_factory):
    # One folder, however often a process comes back to these tests: the server serves one project.
    folder = tmp_path_factory.getbasetemp() / "of-deployments"
    Store.create(folder)
    plan = ServePlan(
        project=str(folder),
        inbox=folder,
        state=folder,
        prefect=server,
        name="ops",
        max_concurrent=2,
    )
    # Prefect has read its settings when this file imported it, before the server was there.
    login = {PREFECT_API_AUTH_STRING: os.environ["PREFECT_API_AUTH_STRING"]}
    with temporary_settings({PREFECT_API_URL: server, **login}):
        install(plan)
        yield plan


@pytest.fixture
def prefect(plan):
    return MatchRuns.of_plan(plan)


def deployments(prefect):
    return {flow: prefect.deployment(deployment_name("ops", flow)) for flow in FLOWS}


def test_deployments_have_queues_by_priority_and_limits(plan, prefect):
    assert tuple(each.flow for each in DEPLOYED) == FLOWS
    limits = {name: prefect.ask(f"/work_pools/{name}") for name in ("ops", "ops-arrivals")}
    assert {name: pool["concurrency_limit"] for name, pool in limits.items()} == {
        "ops": 2,
        "ops-arrivals": 1,
    }
    queues = prefect.ask("/work_pools/ops/queues/filter", {})
    ranks = {queue["name"]: queue["priority"] for queue in queues}
    assert ranks["urgent"] < ranks["normal"] < ranks["background"]
    found = deployments(prefect)
    match, ingest = found["match"], found["ingest"]
    assert (match["work_pool_name"], match["work_queue_name"]) == ("ops", "normal")
    assert match["parameters"] == {"project": plan.project, "time_limits": {}}
    for each in found.values():
        module, _, name = each["entrypoint"].rpartition(".")
        assert isinstance(getattr(importlib.import_module(module), name), Flow)
    assert ingest["work_pool_name"] == "ops-arrivals"
    assert ServePlan.model_validate(ingest["parameters"]["plan"]) == plan
    (schedule,) = ingest["schedules"]
    assert schedule["schedule"]["interval"] == 900.0


def test_pools_and_deployments_that_were_changed_are_put_right(plan, prefect):
    variables = {"type": "object", "properties": {"command": {"type": "string"}}}
    template = {"job_configuration": {"command": "{{ command }}"}, "variables": variables}
    prefect.ask("/work_pools/ops", {"base_job_template": template}, method="PATCH")
    match = deployments(prefect)["match"]
    steps = [{"prefect.deployments.steps.run_shell_script": {"script": "id"}}]
    changed = {"entrypoint": "os.system", "pull_steps": steps}
    prefect.ask(f"/deployments/{match['id']}", changed, method="PATCH")
    assert install(plan).keys() == {each["id"] for each in deployments(prefect).values()}
    variables = prefect.ask("/work_pools/ops")["base_job_template"]["variables"]
    assert (variables["properties"], variables["additionalProperties"]) == ({}, False)
    match = deployments(prefect)["match"]
    assert (match["entrypoint"], match["pull_steps"]) == ("flows.service.deployed.match", [])


def test_a_restart_keeps_what_an_operator_set(plan, prefect):
    def look():
        found = deployments(prefect)
        for each in found.values():
            del each["updated"], each["status"], each["last_polled"]
        planned = planned_runs(prefect, found["reprocess"]["id"])
        return found, {run["id"] for run in planned}

    def update(flow, path="", method="PATCH", **changes):
        body = changes.pop("body", changes)
        prefect.ask(f"/deployments/{found[flow]['id']}{path}", body, method=method)

    found = deployments(prefect)
    given = {**found["reprocess"]["parameters"], "retry": True}
    update("reprocess", tags=["night"], parameters=given, concurrency_limit=1)
    nightly = {"cron": "0 3 * * *", "timezone": "Europe/Vienna"}
    update("reprocess", "/schedules", "POST", body=[{"schedule": nightly, "active": True}])
    (inbox,) = found["ingest"]["schedules"]
    update("ingest", f"/schedules/{inbox['id']}", active=False)
    update("release", "/pause_deployment", "POST")
    update("reprocess", "/schedule", "POST", min_runs=3)
    before, planned = look()
    assert len(planned) >= 3
    install(plan)
    assert look()[0] == before
    install(plan.model_copy(update={"poll_minutes": 5, "time_limits": {"detection": 1.0}}))
    changed, still_planned = look()
    assert planned <= still_planned
    assert changed["reprocess"] == before["reprocess"]
    # New options reach the deployments, and leave the operator's pauses as they are.
    assert changed["match"]["parameters"]["time_limits"] == {"detection": 1.0}
    (inbox,) = changed["ingest"]["schedules"]
    assert (inbox["schedule"]["interval"], inbox["active"]) == (300.0, False)
    for flow in ("ingest", "release", "reprocess"):  # as other tests expect them
        prefect.ask(f"/deployments/{found[flow]['id']}", method="DELETE")
    install(plan)


def test_a_schedule_of_serve_is_made_changed_by_the_option_alone_and_never_removed(plan, prefect):
    def start(text=None, **changes):
        schedules = {} if text is None else parse_schedules([text])
        install(plan.model_copy(update={"schedules": schedules, **changes}))
        return prefect.deployment("reprocess/ops-reprocess")["schedules"]

    night, morning = "reprocess=0 3 * * * Europe/Vienna", "reprocess=30 7 * * 1 Asia/Tokyo"
    (made,) = start(night)
    assert (made["schedule"]["cron"], made["schedule"]["timezone"]) == (
        "0 3 * * *",
        "Europe/Vienna",
    )
    assert start(night) == [made]
    # A person pauses it, and adds another one: both stay, whatever the service is started with.
    place = f"/deployments/{made['deployment_id']}/schedules"
    prefect.ask(f"{place}/{made['id']}", {"active": False}, method="PATCH")
    prefect.ask(place, [{"schedule": {"interval": 7200}, "active": True}])
    after = start(night)
    assert len(after) == 2 and not next(it for it in after if it["id"] == made["id"])["active"]
    assert start() == after
    own = next(it for it in start(morning, poll_minutes=7) if it["id"] == made["id"])
    assert (own["schedule"]["cron"], own["schedule"]["timezone"]) == ("30 7 * * 1", "Asia/Tokyo")
    # Removed by a person, it comes back with another option only.
    prefect.ask(f"{place}/{made['id']}", method="DELETE")
    assert (len(start(morning)), len(start(night))) == (1, 2)
    for flow in ("ingest", "reprocess"):
        found = prefect.deployment(deployment_name("ops", flow))
        prefect.ask(f"/deployments/{found['id']}", method="DELETE")
    install(plan)


@pytest.mark.parametrize("is_updated", [False, True])
def test_what_schedules_missed_runs_once_after_a_start(plan, prefect, is_updated):
    found = prefect.deployment("reprocess/ops-reprocess")
    tags, due = ["auto-scheduled"], datetime.now(UTC) - timedelta(days=3)
    for day in range(3):
        for retry in (False, True):  # two schedules with other parameters are two
            at = (due + timedelta(days=day)).isoformat()
            state = {"type": "SCHEDULED", "state_details": {"scheduled_time": at}}
            given = {"parameters": {"retry": retry}, "tags": tags, "state": state}
            given["name"] = f"missed {day} {retry}"
            prefect.ask(f"/deployments/{found['id']}/create_flow_run", given)
    if is_updated:  # as by another version, whose update removes planned runs
        changed = {"description": "older"}
        prefect.ask(f"/deployments/{found['id']}", changed, method="PATCH")
    install(plan)
    recover(plan)
    recover(plan)
    named = {"name": {"like_": "missed "}}
    runs = prefect.runs(["ops-reprocess"], **named)
    left = [run for run in runs if run["state_type"] == "SCHEDULED"]
    assert sorted(run["parameters"]["retry"] for run in left) == [False, True]
    assert {run["parameters"]["project"] for run in left} == {plan.project}
    for run in prefect.queue.open_runs():
        if run.name.startswith("missed "):
            prefect.cancel(run, "")
    for run in left:
        prefect.ask(f"/flow_runs/{run['id']}", method="DELETE")


def test_a_week_of_missed_scans_is_one_scan_with_the_options_of_now(plan, prefect):
    found = prefect.deployment("ingest/ops-ingest")
    for day in range(7, 0, -1):
        at = (datetime.now(UTC) - timedelta(days=day)).isoformat()
        state = {"type": "SCHEDULED", "state_details": {"scheduled_time": at}}
        missed = {"name": f"scan {day}", "tags": ["auto-scheduled"], "state": state}
        prefect.ask(f"/deployments/{found['id']}/create_flow_run", missed)
    changed = plan.model_copy(update={"settle_seconds": 7.0})
    installed = install(changed)
    for _ in range(3):
        recover(changed)
    kinds = of_types("SCHEDULED", "PENDING")
    (left,) = prefect.runs(["ops-ingest"], state=kinds, name={"like_": "scan "})
    require_installed(FlowRun.model_validate(left), installed)
    (run,) = (run for run in prefect.queue.open_runs() if run.name.startswith("scan "))
    assert run.flow_run == left["id"]
    prefect.cancel(run, "")
    install(plan)


def planned_runs(prefect, deployment):
    wanted = {"deployment_id": {"any_": [deployment]}, "tags": {"all_": ["auto-scheduled"]}}
    return prefect.list_all("flow_runs", flow_runs=wanted)


def open_of(prefect, match):
    return [run for run in prefect.queue.open_runs() if run.match_id == match]


def test_a_page_starts_a_match_by_its_deployment_and_says_what_it_waits_for(
    plan, prefect, monkeypatch
):
    monkeypatch.setattr(app_context, "match_runs_of", lambda url: prefect)
    monkeypatch.setattr(app_context, "FRESH_SECONDS", 0.0)
    continuing = Continuing(Store.create(plan.project))
    first = continuing.go_on("clicked", gates="never")
    assert (first["state"], first["how"]) == ("running", "the deployment")
    assert "waits for its turn" in continuing.go_on("clicked")["how"]
    state = continuing.state("clicked")
    assert (state["state"], state["prefect"]) == ("running", first["prefect"])
    continuing.go_on("clicked-too")
    assert "before it" in continuing.state("clicked-too")["lines"][0]
    (run,) = open_of(prefect, "clicked")
    prefect.queue.begin(run, run.flow_run)
    with beating(prefect.queue, run):
        wait_until(lambda: prefect.queue.beat(run))
    assert continuing.state("clicked")["percent"] == 0.0
    assert "once more" in continuing.go_on("clicked")["how"]
    assert len(open_of(prefect, "clicked")) == 2
    assert continuing.running() == {"clicked": False, "clicked-too": True}
    assert continuing.cancel("clicked", "Ada") and continuing.cancel("clicked-too", "Ada")
    assert open_of(prefect, "clicked") == [] and not continuing.cancel("clicked", "Ada")
    assert prefect.queue.change(prefect.queue.latest(run), "complete") is None
    assert continuing.state("clicked")["lines"][0].endswith("page of the match by Ada.")
    prefect.queue.change(prefect.start("clicked"), "failed", "too dark")
    assert continuing.state("clicked")["lines"] == ["too dark"]


def test_the_worker_takes_installed_runs_with_parameters_of_their_own_alone(plan):
    installed = install(plan)
    ids = {each.flow.name: number for number, each in installed.items()}

    def run(flow, parameters, **changes):
        given = {"flow_id": uuid4(), "deployment_id": ids[flow], "parameters": parameters}
        return FlowRun(**{**given, **changes})

    match = {"project": plan.project, "match_id": "m", "settings": {}}
    arrivals = {"plan": plan.model_dump(mode="json")}
    good = {
        "match": {**match, "time_limits": {}, "gates": "auto"},
        "ingest": arrivals,
        "release": {"project": plan.project, "match_id": "m", "name": "v1", "licence": "any"},
        "reprocess": {"project": plan.project, "retry": True},
    }
    for flow, parameters in good.items():
        assert require_installed(run(flow, parameters), installed).flow.name == flow
    bad = {
        "no deployment": [
            run("match", match, deployment_id=None),
            run("match", match, deployment_id=uuid4()),
        ],
        "may not choose": [
            run("match", match, job_variables={name: "x"})
            for name in ("command", "env", "working_dir", "env.PYTHONPATH")
        ],
        "may not change": [
            run("match", {**match, "project": "/another"}),
            run("match", {"match_id": "m", "settings": {}}),
            run("ingest", {"plan": {**arrivals["plan"], "inbox": "/etc"}}),
        ],
        "parameters": [
            run("match", {"project": plan.project, "settings": {}}),
            run("match", {**match, "unknown": 1}),
            run("match", {**match, "iterations": "many"}),
            run("reprocess", {"project": plan.project, "dask": "tcp://evil:8786"}),
        ],
    }
    for reason, runs in bad.items():
        for each in runs:
            with pytest.raises(RefusedRunError, match=reason):
                require_installed(each, installed)


def test_a_release_lies_in_the_project_under_a_name_that_leads_nowhere_else(tmp_path):
    store = Store.create(tmp_path)
    assert release_folder(store, "m", "v1.0", None) == tmp_path / "releases" / "m" / "v1.0"
    assert release_folder(store, "m", "v1.0", "/elsewhere") == Path("/elsewhere")
    for bad in ("", "../x", "/x", "a/b", ".hidden"):
        with pytest.raises(UsageError, match="name"):
            release_folder(store, "m", bad, None)


@pytest.fixture
def lonely(plan, tmp_path):
    own = plan.model_copy(update={"project": str(tmp_path), "state": tmp_path / "operations"})
    Store.create(own.project)
    return own, MatchRuns.of_plan(own)


DEAD = {"host": platform.node(), "pid": 2**22 + 1, "worker_pid": 1}
"""Process and worker that have ended, beyond the largest process number; on this machine."""


def test_killed_runs_begin_again_and_no_others(lonely, monkeypatch):
    plan, prefect = lonely
    queue, names = prefect.queue, ("lost", "begun", "waits", "done", "off", "crashed", "starting")
    runs = {name: prefect.start(name) for name in names}

    def kinds():
        return {
            name: prefect.ask(f"/flow_runs/{it.flow_run}")["state_name"]
            for name, it in runs.items()
        }

    for name in ("begun", "waits", "done"):
        runs[name] = queue.change(runs[name], "begun", **DEAD)
        prefect.set_state(runs[name].flow_run, "RUNNING", "")
    queue.change(runs["waits"], "waiting")
    prefect.set_state(runs["waits"].flow_run, "PAUSED", "", "Suspended")
    queue.change(runs["done"], "complete")
    prefect.set_state(runs["done"].flow_run, "COMPLETED", "")
    prefect.set_state(runs["off"].flow_run, "CANCELLED", "")
    prefect.set_state(runs["crashed"].flow_run, "CRASHED", "no memory")
    prefect.set_state(runs["starting"].flow_run, "PENDING", "")
    prefect.ask(f"/flow_runs/{runs['lost'].flow_run}", method="DELETE")
    assert sorted(name.partition(",")[0] for name in recover(plan)) == ["begun", "crashed", "lost"]
    again = {queue.latest(run).match_id: queue.latest(run) for run in runs.values()}
    runs["lost"] = again["lost"]
    assert kinds() == {
        **{"lost": "Scheduled", "begun": "AwaitingRetry", "crashed": "AwaitingRetry"},
        **{"waits": "Suspended", "done": "Completed", "off": "Cancelled", "starting": "Pending"},
    }
    states = {name: run.state for name, run in again.items()}
    asked = dict.fromkeys(("lost", "begun", "crashed", "starting"), "asked")
    assert states == {**asked, "waits": "waiting", "done": "complete", "off": "cancelled"}
    # The end of the worker is not the run's fault; a crash is.
    assert (again["begun"].service_deaths, again["begun"].kills) == (1, 0)
    assert (again["crashed"].kills, recover(plan)) == (1, [])
    monkeypatch.setattr(recovery, "STARTING", recovery.STARTING * 0)
    assert [name.partition(",")[0] for name in recover(plan)] == ["starting"]


def test_every_run_is_recovered_whatever_becomes_of_prefects_history(lonely):
    plan, prefect = lonely
    asked, begun, waits = (prefect.start(name, gates="never") for name in ("a", "b", "c"))
    prefect.queue.change(begun, "begun", **DEAD)
    prefect.queue.change(waits, "waiting")
    for run in prefect.list_all("flow_runs"):
        prefect.ask(f"/flow_runs/{run['id']}", method="DELETE")
    assert len(recover(plan)) == 3
    there = prefect.at_prefect(prefect.queue.open_runs())
    assert {run["parameters"]["match_id"] for run in there.values()} == {"a", "b", "c"}
    assert {run["parameters"]["gates"] for run in there.values()} == {"never"}
    assert {run.id for run in prefect.queue.open_runs()} == {asked.id, begun.id, waits.id}
    # A worker that takes such a run finds its former states.
    taken = [queued_run("match", run) for run in there.values()]
    assert {prefect.queue.take(run).id for run in taken} == {asked.id, begun.id, waits.id}


def test_a_run_that_a_person_retries_at_prefect_is_asked_for_again(lonely):
    _, prefect = lonely
    run = prefect.start("again")
    prefect.queue.change(run, "failed", "too dark")
    for given, kept in (("RUNNING", "CRASHED"), ("FAILED", "FAILED")):  # a place is not kept
        prefect.set_state(run.flow_run, given, "")
        adopt_due(prefect)
        assert prefect.ask(f"/flow_runs/{run.flow_run}")["state_type"] == kept
        assert open_of(prefect, "again") == []
    prefect.set_state(run.flow_run, "SCHEDULED", "", "AwaitingRetry")
    adopt_due(prefect)
    assert [each.id for each in open_of(prefect, "again")] == [run.id]


@pytest.mark.slow  # a worker, and the processes of two runs
def test_the_worker_runs_what_is_due_and_ends_what_is_cancelled(plan, tmp_path, monkeypatch):
    own = {"project": str(tmp_path), "state": tmp_path / "operations", "name": "worked"}
    plan = plan.model_copy(update=own)
    monkeypatch.setenv("WORLDPOSE_STATE", str(plan.state))
    monkeypatch.setenv("WORLDPOSE_WORKERS", "1")
    Store.create(plan.project)
    prefect, installed = MatchRuns.of_plan(plan), install(plan)
    absent, held = prefect.start("absent"), prefect.start("held")

    def state(run):
        return prefect.ask(f"/flow_runs/{run.flow_run}")["state_name"]

    worker = ServedWorker("worked", installed)
    at_work = Thread(target=copy_context().run, args=(anyio.run, worker.start, True, False, str))
    # A run waits while another one of its match is at work.
    with alone(Store.open(plan.project).blobs, "match-held", wait=True):
        at_work.start()
        wait_until(lambda: state(held) == "Running" and state(absent) == "Failed")
        pid = int(prefect.ask(f"/flow_runs/{held.flow_run}")["infrastructure_pid"])
        assert is_alive(pid) and prefect.queue.latest(held).pid == pid
        prefect.cancel(prefect.queue.latest(held), "cancelled by Ada")
        wait_until(lambda: state(held) == "Cancelled")
    at_work.join(60)
    assert not at_work.is_alive() and not is_alive(pid)
    assert "absent" in prefect.ask(f"/flow_runs/{absent.flow_run}")["state"]["message"]
    ended = {run.match_id: (run.state, run.message) for run in prefect.queue.runs()}
    assert ended["absent"][0] == "failed" and "absent" in ended["absent"][1]
    assert ended["held"] == ("cancelled", "cancelled by Ada")


@pytest.mark.slow  # a worker twice, and the processes of a run
def test_a_run_that_waits_is_answered_in_prefects_own_form(plan, tiny, tmp_path, monkeypatch):
    """One verdict on all that it asks about; the run's process has ended meanwhile."""
    own = {"project": str(tmp_path / "p"), "state": tmp_path / "operations", "name": "asking"}
    plan = plan.model_copy(update=own)
    monkeypatch.setenv("WORLDPOSE_STATE", str(plan.state))
    monkeypatch.setenv("WORLDPOSE_WORKERS", "1")
    folder = shutil.copytree(tiny, tmp_path / "match")
    shutil.copy(folder / "reference" / "calibration.toml", folder)
    store = Store.create(plan.project)
    register(store, folder)
    prefect, installed = MatchRuns.of_plan(plan), install(plan)
    asked = prefect.start(TINY, until_stage="static_calibration", gates="always")

    def work_until(name):
        worker = ServedWorker("asking", installed)
        at_work = Thread(
            target=copy_context().run, args=(anyio.run, worker.start, True, False, str)
        )
        at_work.start()
        state = f"/flow_runs/{asked.flow_run}"
        wait_until(lambda: prefect.ask(state)["state_name"] in (name, "Failed", "Crashed"))
        at_work.join(60)
        assert prefect.ask(state)["state_name"] == name

    work_until("Suspended")
    first = store.run(TINY)
    assert (first.state, first.gates, len(first.waiting)) == ("waiting", "always", 6)
    with pytest.raises(RuntimeError, match="required property"):  # no verdict is none
        resume_flow_run(asked.flow_run, run_input={"who": "Ada"})
    resume_flow_run(asked.flow_run, run_input={"verdict": "approve", "who": "Bob", "why": "seen"})
    work_until("Completed")
    said = [each for each in read_journal(store, TINY).records if isinstance(each, ReviewDecision)]
    assert [(each.verdict, each.who) for each in said] == [("approve", "Bob")] * 6
    second = store.run(TINY)
    assert (second.state, second.executed, second.results) == ("complete", (), first.results)
    assert store.unfinished_runs(TINY) == ()


def test_a_server_that_refuses_or_is_gone_is_named(plan):
    absent = MatchRuns("http://127.0.0.1:9/api", tries=1, name="ops", project=plan.project)
    with pytest.raises(UnreachablePrefectError, match=r"127\.0\.0\.1:9.*nothing was started"):
        absent.start("m")
    with pytest.raises(UnreachablePrefectError, match="answers 401"):
        MatchRuns(plan.prefect, "worldpose:wrong", name="ops", project=plan.project).start("m")
