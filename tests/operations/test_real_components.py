"""Prefect on Postgres, the store on S3, Dask as processes of their own: the bytes of any run."""

import subprocess
import sys
import uuid

import pytest
from command_line import TINY, succeed
from service import free_ports, wait_until
from store_comparison import compare_stores

from flows.orchestration.prefect_environment import (
    CLIENT_LOGIN,
    SERVER_LOGIN,
    new_login,
    problem_at,
    served_environment,
)
from flows.service.plan import ServePlan
from worldpose.store.integrity import verify
from worldpose.store.store import Store

LOGIN = new_login()


@pytest.fixture
def prefect_on_postgres(postgres, tmp_path):
    api = f"http://127.0.0.1:{free_ports(1)[0]}/api"
    plan = ServePlan(project="none", inbox=tmp_path, state=tmp_path, prefect=api)
    environment = served_environment(api, tmp_path / "prefect")
    environment["PREFECT_API_DATABASE_CONNECTION_URL"] = postgres[0]
    environment[SERVER_LOGIN] = LOGIN
    program = [sys.executable, "-m", "flows.service.child", "prefect", plan.model_dump_json()]
    server = subprocess.Popen(program, stdin=subprocess.PIPE, env=environment)
    wait_until(lambda: not problem_at(f"{api}/health"))
    yield api
    server.stdin.close()  # it ends with its standard input
    server.wait(60)


@pytest.mark.slow
@pytest.mark.timeout(1800)
def test_real_components_give_the_bytes_of_an_embedded_run(
    bucket, prefect_on_postgres, dask, postgres, tiny, tiny_run
):
    project = f"{bucket}/{uuid.uuid4().hex}"
    environment = {"PREFECT_API_URL": prefect_on_postgres, CLIENT_LOGIN: LOGIN}
    succeed(
        *("run", tiny, "--project", project, "--dask", dask[0]),
        timeout=1500,
        environment=environment,
    )
    assert compare_stores(Store.open(project), Store.open(str(tiny_run))) == []
    assert verify(Store.open(project)) == ()
    ask = postgres[1]
    assert ask("select name, state_name from flow_run") == f"{TINY}|Completed"
    # The server takes in the workers' events a moment later.
    ended = "select count(*) > 0 and bool_and(state_name = 'Completed') from task_run"
    wait_until(lambda: ask(ended) == "t")
