"""Deployments at a Prefect server, and the runs that restart there."""

import asyncio
import importlib
import os
import re
from datetime import UTC, datetime, timedelta
from pathlib import Path
from uuid import uuid4

import pytest
from prefect import Flow
from prefect.client.orchestration import get_client
from prefect.client.schemas.actions import DeploymentUpdate, WorkPoolUpdate
from prefect.client.schemas.objects import FlowRun, StateType
from prefect.settings import PREFECT_API_AUTH_STRING, PREFECT_API_URL, temporary_settings
from prefect.states import Cancelling, Completed, Crashed, Running, Scheduled, Suspended
from prefect.workers.process import ProcessWorker

from data_contracts.release import EXPORT_FORMATS
from flows.method import METHOD
from flows.service import recovery
from flows.service.deployed import release_folder
from flows.service.deployments import DEPLOYED, RefusedRunError, install, require_installed
from flows.service.forms import offer_matches
from flows.service.match_runs import MatchRuns
from flows.service.plan import FLOWS, ServePlan, deployment_name
from flows.service.recovery import name_scheduled_runs, restart_lost_runs
from flows.service.watching import failed_runs
from worldpose.errors import InputError, UsageError
from worldpose.store import Store


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
    assert match.parameters == {"project": plan.project, "settings": {}, "time_limits": {}}
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


def test_runs_have_readable_names_of_their_own(plan, monkeypatch):
    runs = MatchRuns(plan.prefect, "ops", os.environ["PREFECT_API_AUTH_STRING"])
    run = runs.start("lab", priority="urgent", key="twice", gates="never")
    assert re.fullmatch(r"lab, \d\d \w{3} \d\d:\d\d:\d\d", run.name)
    assert runs.start("lab", key="twice").id == run.id
    assert [each.id for each in runs.active() if each.match_id == "lab"] == [run.id]

    async def scheduled():
        async with get_client() as client:
            ingest = await client.read_deployment_by_name(deployment_name("ops", "ingest"))
            due = datetime.now(UTC) + timedelta(hours=1)
            made = await client.create_flow_run_from_deployment(
                ingest.id, name="macho-mongrel", state=Scheduled(scheduled_time=due)
            )
            real = recovery._runs

            async def of_a_schedule(*given):
                return [
                    each.model_copy(update={"auto_scheduled": True}) for each in await real(*given)
                ]

            monkeypatch.setattr(recovery, "_runs", of_a_schedule)
            await name_scheduled_runs(plan)
            named = await client.read_flow_run(made.id)
            await client.delete_flow_run(made.id)
            await client.delete_flow_run(run.id)
        return named, due

    named, due = asyncio.run(scheduled())
    assert named.name == f"inbox, {due.astimezone():%d %b %H:%M:%S}"


def test_deployments_of_an_earlier_version_are_removed(plan):
    async def leave():
        async with get_client() as client:
            match = await client.read_deployment_by_name(deployment_name("ops", "match"))
            for project in (plan.project, "/elsewhere"):
                name = "ops" if project == plan.project else "others"
                given = {"project": project}
                await client.create_deployment(match.flow_id, name=name, parameters=given)
        await install(plan)
        async with get_client() as client:
            return [each.name for each in await client.read_deployments()]

    names = asyncio.run(leave())
    assert "ops" not in names and "others" in names


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
    failed = {each.name: each for each in asyncio.run(failed_runs(plan))}
    assert (failed["poison"].state, failed["poison"].message) == ("crashed", "killed")
