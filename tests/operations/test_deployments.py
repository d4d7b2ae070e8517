"""Deployments at a Prefect server, and the runs that restart there."""

import asyncio
import importlib
import os
import re
from collections import Counter
from datetime import UTC, datetime, timedelta
from pathlib import Path
from uuid import uuid4

import pytest
from prefect import Flow
from prefect.client.orchestration import get_client
from prefect.client.schemas.actions import DeploymentUpdate, WorkPoolUpdate
from prefect.client.schemas.filters import (
    FlowRunFilter,
    FlowRunFilterDeploymentId,
    FlowRunFilterTags,
)
from prefect.client.schemas.objects import FlowRun, StateType
from prefect.client.schemas.schedules import CronSchedule
from prefect.settings import PREFECT_API_AUTH_STRING, PREFECT_API_URL, temporary_settings
from prefect.states import Cancelling, Completed, Crashed, Running, Suspended
from prefect.workers.process import ProcessWorker

from data_contracts.release import EXPORT_FORMATS
from flows.method import METHOD
from flows.orchestration import suspension
from flows.service import recovery, watching
from flows.service.deployed import release_folder
from flows.service.deployments import DEPLOYED, RefusedRunError, install, require_installed
from flows.service.forms import offer_matches
from flows.service.match_runs import MatchRuns
from flows.service.plan import FLOWS, ServePlan, deployment_name
from flows.service.recovery import name_scheduled_runs, restart_lost_runs
from flows.service.watching import failed_runs
from flows.web import app_context
from flows.web.app_context import Continuing
from worldpose.errors import InputError, UsageError
from worldpose.store.store import Store


@pytest.fixture(scope="module")
def plan(server, tmp_path_factory):
    """A plan whose deployments are installed."""
    # One folder, however often a process comes back to these tests: the server serves one project.
    folder = tmp_path_factory.getbasetemp() / "of-deployments"
    folder.mkdir(exist_ok=True)
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
        asyncio.run(install(plan))
        yield plan


def test_deployments_have_queues_by_priority_and_limits(plan):
    async def look():
        async with get_client() as client:
            pools = {name: await client.read_work_pool(name) for name in ("ops", "ops-arrivals")}
            queues = await client.match_work_queues([""], "ops")
            deployments = {
                each.flow: await client.read_deployment_by_name(f"{each.flow}/ops-{each.flow}")
                for each in DEPLOYED
            }
        return pools, queues, deployments

    assert tuple(each.flow for each in DEPLOYED) == FLOWS
    pools, queues, deployments = asyncio.run(look())
    assert {name: pool.concurrency_limit for name, pool in pools.items()} == {
        "ops": 2,
        "ops-arrivals": 1,
    }
    ranks = {queue.name: queue.priority for queue in queues}
    assert ranks["urgent"] < ranks["normal"] < ranks["background"]
    match = deployments["match"]
    assert (match.work_pool_name, match.work_queue_name) == ("ops", "normal")
    assert match.parameters == {"project": plan.project, "time_limits": {}}
    assert match.entrypoint == "flows.service.deployed.match"
    for each in deployments.values():  # what the worker will load
        module, _, name = each.entrypoint.rpartition(".")
        assert isinstance(getattr(importlib.import_module(module), name), Flow)
    ingest = deployments["ingest"]
    assert ingest.work_pool_name == "ops-arrivals"
    assert ServePlan.model_validate(ingest.parameters["plan"]) == plan
    (schedule,) = ingest.schedules
    assert schedule.schedule.interval.total_seconds() == 900.0


def test_pools_and_deployments_that_were_changed_are_put_right(plan):
    async def change():
        async with get_client() as client:
            template = ProcessWorker.get_default_base_job_template()
            await client.update_work_pool("ops", WorkPoolUpdate(base_job_template=template))
            match = await client.read_deployment_by_name("match/ops-match")
            steps = [{"prefect.deployments.steps.run_shell_script": {"script": "id"}}]
            changed = DeploymentUpdate(entrypoint="os.system", pull_steps=steps)
            await client.update_deployment(match.id, changed)

    async def look():
        async with get_client() as client:
            pool = await client.read_work_pool("ops")
            return pool.base_job_template, await client.read_deployment_by_name("match/ops-match")

    asyncio.run(change())
    installed = asyncio.run(install(plan))
    template, match = asyncio.run(look())
    assert set(template["variables"]["properties"]) == {"stream_output"}
    assert not template["variables"]["additionalProperties"]
    assert (match.entrypoint, match.pull_steps) == ("flows.service.deployed.match", [])
    assert installed[match.id].entrypoint == match.entrypoint
    assert len(installed) == len(DEPLOYED)


def test_a_restart_keeps_what_an_operator_set(plan):
    async def look(client):
        found = {
            flow: await client.read_deployment_by_name(deployment_name("ops", flow))
            for flow in FLOWS
        }
        planned = await planned_runs(client, found["reprocess"].id)
        return found, {run.id for run in planned}

    async def set_and_restart():
        async with get_client() as client:
            found = {
                flow: await client.read_deployment_by_name(deployment_name("ops", flow))
                for flow in FLOWS
            }
            reprocess = found["reprocess"]
            given = {**reprocess.parameters, "retry": True}
            changes = DeploymentUpdate(tags=["night"], parameters=given, concurrency_limit=1)
            await client.update_deployment(reprocess.id, changes)
            nightly = CronSchedule(cron="0 3 * * *", timezone="Europe/Vienna")
            await client.create_deployment_schedules(reprocess.id, [(nightly, True)])
            (inbox,) = found["ingest"].schedules
            await client.update_deployment_schedule(found["ingest"].id, inbox.id, active=False)
            await client.pause_deployment(found["release"].id)
            await offer_matches(plan, ("lab",))
            await plan_runs(client, reprocess.id)
            before = await look(client)
            await install(plan)
            after = await look(client)
            options = {"poll_minutes": 5, "time_limits": {"detection": 1.0}}
            await install(plan.model_copy(update=options))
            changed = await look(client)
            for flow in ("ingest", "release", "reprocess"):  # as other tests expect them
                await client.delete_deployment(found[flow].id)
            await install(plan)
        return before, after, changed

    (before, planned), (after, still_planned), (changed, planned_last) = asyncio.run(
        set_and_restart()
    )
    unset = {"updated", "status", "last_polled"}
    for flow in FLOWS:
        assert after[flow].model_dump(exclude=unset) == before[flow].model_dump(exclude=unset)
    assert planned <= still_planned and planned <= planned_last
    assert changed["reprocess"].model_dump(exclude=unset) == before["reprocess"].model_dump(
        exclude=unset
    )
    # New options reach the deployments, and leave the operator's pauses as they are.
    assert changed["match"].parameters["time_limits"] == {"detection": 1.0}
    (inbox,) = changed["ingest"].schedules
    assert (inbox.schedule.interval, inbox.active) == (timedelta(minutes=5), False)


def test_forms_ask_for_typed_values_and_offer_choices(plan):
    async def look():
        async with get_client() as client:
            found = [
                await client.read_deployment_by_name(deployment_name("ops", flow)) for flow in FLOWS
            ]
        return {each.name: each.parameter_openapi_schema["properties"] for each in found}

    asyncio.run(offer_matches(plan, ("lab", "away")))
    forms = asyncio.run(look())
    assert len(forms) == len(FLOWS)  # each deployment has a name of its own
    match = forms["ops-match"]
    assert match["match_id"]["enum"] == ["away", "lab"]
    assert match["until_stage"]["enum"] == [stage.name for stage in METHOD]
    assert set(match["gates"]["enum"]) == {"never", "auto", "always"}
    assert forms["ops-release"]["formats"]["items"]["enum"] == list(EXPORT_FORMATS)
    assert forms["ops-reprocess"]["matches"]["items"]["enum"] == ["away", "lab"]
    for form in forms.values():
        assert not {"project", "plan"} & set(form)  # a run must not change them
        for field in form.values():
            assert field.get("type") not in (None, "null") and "anyOf" not in field, field
    asyncio.run(install(plan))
    asyncio.run(offer_matches(plan, ()))
    assert "enum" not in asyncio.run(look())["ops-match"]["match_id"]


def test_runs_have_readable_names_of_their_own(plan):
    runs = MatchRuns(plan.prefect, "ops", os.environ["PREFECT_API_AUTH_STRING"])
    run = runs.start("lab", priority="urgent", key="twice", gates="never")
    assert re.fullmatch(r"lab, \d\d \w{3} \d\d:\d\d:\d\d", run.name)
    assert runs.start("lab", key="twice").id == run.id
    assert [each.id for each in runs.active() if each.match_id == "lab"] == [run.id]

    async def scheduled():
        async with get_client() as client:
            ingest = await client.read_deployment_by_name(deployment_name("ops", "ingest"))
            await plan_runs(client, ingest.id)
            await name_scheduled_runs(plan)
            await client.delete_flow_run(run.id)
            return await planned_runs(client, ingest.id)

    for each in asyncio.run(scheduled()):
        due = each.next_scheduled_start_time.astimezone()
        assert each.name == f"inbox, {due:%d %b %H:%M:%S}"


async def plan_runs(client, deployment):
    """Plan a deployment's next runs, as Prefect's scheduler does every minute."""
    await client.request(
        "POST", "/deployments/{id}/schedule", path_params={"id": deployment}, json={}
    )


async def planned_runs(client, deployment):
    of = FlowRunFilterDeploymentId(any_=[deployment])
    scheduled = FlowRunFilterTags(all_=["auto-scheduled"])
    found = await client.read_flow_runs(
        flow_run_filter=FlowRunFilter(deployment_id=of, tags=scheduled)
    )
    assert len(found) >= 3
    return found


def test_the_worker_takes_installed_runs_with_parameters_of_their_own_alone(plan):
    installed = asyncio.run(install(plan))
    ids = {each.entrypoint.rpartition(".")[2]: number for number, each in installed.items()}

    def run(flow, parameters, **changes):
        given = {"flow_id": uuid4(), "deployment_id": ids[flow], "parameters": parameters}
        return FlowRun(**{**given, **changes})

    match = {"project": plan.project, "match_id": "m", "settings": {}}
    arrivals = {"plan": plan.model_dump(mode="json")}
    good = [
        run("match", {**match, "time_limits": {}, "gates": "auto"}),
        run("match", match, job_variables={"stream_output": False}),
        run("ingest", arrivals),
        run("release", {"project": plan.project, "match_id": "m", "name": "v1", "licence": "any"}),
        run("reprocess", {"project": plan.project, "retry": True}),
    ]
    for each in good:
        assert require_installed(each, installed).entrypoint.endswith(
            next(flow for flow, number in ids.items() if number == each.deployment_id)
        )
    bad = {
        "no deployment": [
            run("match", match, deployment_id=None),
            run("match", match, deployment_id=uuid4()),
        ],
        "may not choose": [
            run("match", match, job_variables={name: "x"})
            for name in ("command", "env", "working_dir", "env.PYTHONPATH", "name")
        ],
        "may not change": [
            run("match", {**match, "project": "/another"}),
            run("match", {"match_id": "m", "settings": {}}),
            run("ingest", {"plan": {**arrivals["plan"], "inbox": "/etc"}}),
            run("reprocess", {"project": "/another"}),
        ],
        "parameters": [
            run("match", {"project": plan.project, "settings": {}}),
            run("match", {**match, "unknown": 1}),
            run("match", {**match, "settings": "no mapping"}),
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


def test_installed_again_changes_limits_and_another_project_is_refused(plan):
    more = plan.model_copy(update={"max_concurrent": 3})
    asyncio.run(install(more))

    async def limit():
        async with get_client() as client:
            return (await client.read_work_pool("ops")).concurrency_limit

    assert asyncio.run(limit()) == 3
    # A service with its own server has no foreign deployments there: it was moved.
    for owns_prefect, advice in ((False, "--name"), (True, "Was the project moved?")):
        changes = {"project": "/another", "owns_prefect": owns_prefect}
        with pytest.raises(InputError, match=re.escape(advice)):
            asyncio.run(install(plan.model_copy(update=changes)))


def test_killed_runs_begin_again_and_no_others(plan, monkeypatch):
    dead, alive = 2**22 + 1, 1  # beyond the largest process number; the first process

    async def give_runs():
        states = {
            "crashed": (Crashed(), None),
            "dead": (Running(), dead),
            "alive": (Running(), alive),
            "waits": (Suspended(), dead),
            "done": (Completed(), dead),
        }
        async with get_client() as client:
            deployment = await client.read_deployment_by_name("match/ops-match")
            for name, (state, pid) in states.items():
                run = await client.create_flow_run_from_deployment(deployment.id, name=name)
                await client.set_flow_run_state(run.id, state, force=True)
                if pid is not None:
                    await client.update_flow_run(run.id, infrastructure_pid=str(pid))

    async def states():
        async with get_client() as client:
            return {run.name: run.state_name for run in await client.read_flow_runs()}

    asyncio.run(give_runs())
    assert asyncio.run(restart_lost_runs(plan)) == ["crashed"]
    # A run that has given a sign of life a moment ago is not looked after yet; later it is.
    monkeypatch.setattr(recovery, "SILENT", recovery.SILENT * 0)
    assert asyncio.run(restart_lost_runs(plan)) == ["dead"]
    expected = {"crashed": "AwaitingRetry", "dead": "AwaitingRetry", "alive": "Running"}
    expected |= {"waits": "Suspended", "done": "Completed"}
    found = asyncio.run(states())
    assert {name: found[name] for name in expected} == expected
    # When the service starts, none of its runs is at work; on a server of others they may be.
    others = plan.model_copy(update={"owns_prefect": False})
    assert asyncio.run(restart_lost_runs(others, at_start=True)) == ["alive"]  # silent there
    asyncio.run(set_state("alive", Running()))
    assert asyncio.run(restart_lost_runs(plan, at_start=True)) == ["alive"]
    asyncio.run(set_state("alive", Cancelling()))
    assert asyncio.run(restart_lost_runs(plan, at_start=True)) == []
    assert asyncio.run(states())["alive"] == "Cancelled"


async def set_state(name, state):
    async with get_client() as client:
        for run in await client.read_flow_runs():
            if run.name == name:
                await client.set_flow_run_state(run.id, state, force=True)


def test_a_run_that_keeps_being_killed_is_left_for_a_person(plan, monkeypatch):
    async def kill_thrice():
        async with get_client() as client:
            deployment = await client.read_deployment_by_name("match/ops-match")
            run = await client.create_flow_run_from_deployment(deployment.id, name="poison")
            for _ in range(3):
                await client.set_flow_run_state(run.id, Running(), force=True)
                await client.set_flow_run_state(run.id, Crashed(message="killed"), force=True)
            return await client.read_flow_run(run.id)

    run = asyncio.run(kill_thrice())
    assert (run.state_type, run.run_count) == (StateType.CRASHED, 3)
    assert "poison" not in asyncio.run(restart_lost_runs(plan))
    failed = {each.name: each for each in asyncio.run(failed_runs(plan, datetime.now(UTC)))}
    assert (failed["poison"].state, failed["poison"].message) == ("crashed", "killed")


@pytest.fixture(scope="module")
def hundreds(plan):
    """Give the server 210 failed runs of a match, 40 crashed and 210 suspended ones of others.

    Prefect lists them by random ids, so that a page of 200 lacks some of each.
    """

    async def create():
        async with get_client() as client:
            found = await client.read_deployment_by_name(plan.match_deployment)
            for match, count, state in HUNDREDS:
                run = {
                    "state": {"type": state, "message": "made"},
                    "parameters": {"project": plan.project, "match_id": match},
                }
                missing = [{**run, "name": f"{match}, {number}"} for number in range(count)]
                while missing:  # SQLite's one writer was busy
                    answer = await client.request(
                        "POST",
                        "/deployments/{id}/create_flow_run/bulk",
                        path_params={"id": found.id},
                        json=missing,
                    )
                    created = [each["status"] == "CREATED" for each in answer.json()["results"]]
                    missing = [
                        each
                        for each, is_there in zip(missing, created, strict=True)
                        if not is_there
                    ]

    asyncio.run(create())


HUNDREDS = (
    ("old-match", 1, "FAILED"),
    ("crashed-match", 40, "CRASHED"),
    *[("failed-match", 70, "FAILED")] * 3,
    *[("paused-match", 70, "PAUSED")] * 3,
)


def test_alerts_name_all_failed_runs_and_those_that_should_have_restarted(
    plan, hundreds, monkeypatch
):
    def failed_by_match():
        failed = asyncio.run(failed_runs(plan, datetime.now(UTC)))
        return Counter(each.match_id for each in failed), failed

    counts, _ = failed_by_match()
    assert (counts["failed-match"], counts["crashed-match"]) == (210, 0)
    monkeypatch.setattr(watching, "RESTART_PATIENCE", timedelta(0))
    counts, failed = failed_by_match()
    assert (counts["failed-match"], counts["crashed-match"]) == (210, 40)
    (message,) = {each.message for each in failed if each.match_id == "crashed-match"}
    assert message == "made; it was not restarted"


def test_crashed_and_suspended_runs_are_found_among_hundreds(plan, hundreds, monkeypatch):
    again = asyncio.run(restart_lost_runs(plan))
    assert sorted(again) == sorted(f"crashed-match, {number}" for number in range(40))
    resumed = []
    monkeypatch.setattr(suspension, "resume_flow_run", lambda id, run_input: resumed.append(id))
    suspension.resume_suspended(plan.project, "paused-match")
    assert len(set(resumed)) == 210


def test_pages_show_the_last_run_of_every_match_among_hundreds(plan, hundreds, monkeypatch):
    runs = MatchRuns(plan.prefect, "ops", os.environ["PREFECT_API_AUTH_STRING"])
    monkeypatch.setattr(app_context, "match_runs_of", lambda url: runs)
    monkeypatch.setattr(app_context, "FRESH_SECONDS", 0.0)
    continuing = Continuing(Store.create(plan.project))
    for _ in range(2):  # the second look asks for later runs alone
        assert continuing.state("old-match")["lines"] == ["made"]
        assert continuing.links().keys() >= {match for match, _, _ in HUNDREDS}
