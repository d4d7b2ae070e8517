"""Other users of the machine, and web pages that an operator visits, get nothing from `serve`."""

import base64
import json
import shutil
import signal
import time

import psutil
import pytest
from listeners import listening, says_nothing
from service import TOKEN, Served, request, wait_until
from websockets.sync.client import connect

pytestmark = [pytest.mark.slow, pytest.mark.timeout(1800)]

ALERT, CLOUD, OTHER = "alert-secret-1", "cloud-secret-2", "another-secret-3"
FORM = ("/login", "/login/page.js", "/login/page.css")
OPEN = {
    "prefect": {"/api/health", "/api/ready", *FORM},
    "pages": {"/api/health", *FORM},
    "metrics": {"/health"},
}
"""What answers without a login: that a server is up, and the form to log in with. The files of
Prefect's dashboard, which are the same everywhere, too."""
REFUSALS = (401, 403, 421)


@pytest.fixture(scope="module")
def served(tmp_path_factory):
    service = Served(tmp_path_factory.mktemp("served"), f"http://127.0.0.1:9/{ALERT}")
    service.environment = {
        "AWS_ACCESS_KEY_ID": CLOUD,
        "AWS_SECRET_ACCESS_KEY": CLOUD,
        "GITHUB_TOKEN": OTHER,
    }
    service.begin()
    yield service
    if service.process.poll() is None:
        service.end(signal.SIGKILL)


@pytest.fixture
def pwned(tmp_path):
    file = tmp_path / "PWNED"
    return file, f'/bin/sh -c "id > {file}; env >> {file}"'


def basic(login):
    return {"authorization": f"Basic {base64.b64encode(login.encode()).decode()}"}


def strangers(login):
    return {
        "no login": {},
        "wrong login": basic("worldpose:wrong"),
        "login of another kind": {"authorization": f"Bearer {login}"},
        "foreign origin": {"origin": "http://evil.example", **basic(login)},
        "no origin": {"origin": "null", **basic(login)},
        "rebound name": {"host": "evil.example", **basic(login)},
        "name behind a user": {"host": "evil@127.0.0.1", **basic(login)},
        "another site's request": {"sec-fetch-site": "cross-site", **basic(login)},
        "another port's request": {"sec-fetch-site": "same-site", **basic(login)},
    }


def scheduled(command=None):
    job = {} if command is None else {"job_variables": {"command": command}}
    return {"state": {"type": "SCHEDULED"}, **job}


def deployment_of(served, flow="ingest"):
    return served.ask(f"/deployments/name/{flow}/worldpose-{flow}")


def settle(served, runs):
    wait = ("SCHEDULED", "PENDING", "RUNNING")

    def ended():
        found = [served.ask(f"/flow_runs/{run}")["state"] for run in runs]
        return found if all(state["type"] not in wait for state in found) else None

    return wait_until(ended, served.explain)


def runs_by_request(served):
    """Return the ids of requested runs; the schedule plans its own at any time."""
    runs = served.ask("/flow_runs/filter", {"limit": 200})
    return {run["id"] for run in runs if not run["auto_scheduled"]}


def test_a_stranger_can_begin_no_run(served, pwned):
    file, command = pwned
    deployment = deployment_of(served)["id"]
    before = runs_by_request(served)
    port = served.ports["prefect"]
    path = f"/api/deployments/{deployment}/create_flow_run"
    for who, headers in strangers(served.secret("prefect")).items():
        status, answered, _ = request(port, "POST", path, headers, scheduled(command))
        assert status in REFUSALS, who
        assert "access-control-allow-origin" not in answered, who
        # The preflight request of a browser.
        asking = {
            "origin": "http://evil.example",
            "access-control-request-method": "POST",
            "access-control-request-headers": "content-type,authorization",
            **headers,
        }
        status, answered, _ = request(port, "OPTIONS", path, asking)
        assert status in REFUSALS, who
        assert "access-control-allow-origin" not in answered, who
    assert runs_by_request(served) == before
    time.sleep(5.0)
    assert not file.exists(), file.read_text()


def test_every_address_of_every_port_asks_for_a_login(served):
    port = served.ports["prefect"]
    schema = served.ask("/openapi.json")
    asked = 0
    for path, methods in schema["paths"].items():
        place = "/api" + path.removeprefix("/api").replace("{", "").replace("}", "")
        for method in methods:
            status, _, _ = request(port, method.upper(), place, {}, {} if method != "get" else None)
            if place in OPEN["prefect"]:
                assert status == 200, place
            else:
                assert status == 401, (method, place)
            asked += 1
    assert asked > 150
    for place in ("/api/metrics", "/api/docs", "/api/admin/settings", "/api/no-such-place"):
        assert request(port, "GET", place)[0] == 401, place
    for place in ("/api/matches", "/api/status", "/status", "/api/session", "/assets/x"):
        assert request(served.ports["pages"], "GET", place)[0] == 401, place
    figures = served.ports["metrics"]
    assert request(figures, "GET", "/metrics")[0] == 401
    assert request(figures, "GET", "/metrics", {"authorization": "Bearer wrong"})[0] == 401
    assert "worldpose_matches" in served.figures()
    for name, number in served.ports.items():
        for place in OPEN[name]:
            assert request(number, "GET", place)[0] == 200, place
            assert request(number, "GET", place, {"host": "evil.example"})[0] == 421, place
            assert request(number, "GET", place, {"host": "evil@127.0.0.1"})[0] == 421, place


@pytest.mark.parametrize("path", ["events/in", "events/out", "logs/out"])
def test_no_web_socket_opens_to_a_stranger(served, path):
    address = f"ws://127.0.0.1:{served.ports['prefect']}/api/{path}"
    login = served.secret("prefect")
    good = {"subprotocols": ["prefect"], "open_timeout": 30}
    for origin in ("http://evil.example", "null"):
        with pytest.raises(Exception, match="403"):
            connect(address, origin=origin, **good)
    with pytest.raises(Exception, match="403"):
        connect(address, open_timeout=30)
    for token in (None, "worldpose:wrong"):
        with connect(address, **good) as opened:
            opened.send(json.dumps({"type": "auth", "token": token}))
            with pytest.raises(Exception, match="1008"):
                opened.recv(30)
    with connect(address, **good) as opened:
        opened.send(json.dumps({"type": "auth", "token": login}))
        assert json.loads(opened.recv(30)) == {"type": "auth_success"}


def test_a_run_chooses_neither_command_nor_code_nor_environment(served, pwned):
    """Also those who have the login run nothing but what was installed."""
    file, command = pwned
    port, login = served.ports["prefect"], basic(served.secret("prefect"))
    deployment = deployment_of(served)
    path = f"/api/deployments/{deployment['id']}/create_flow_run"
    for variables in (
        {"command": command},
        {"env": {"PREFECT__FLOW_ENTRYPOINT": "os.system", "PYTHONPATH": "/tmp"}},
        {"working_dir": "/tmp"},
    ):
        body = {"state": {"type": "SCHEDULED"}, "job_variables": variables}
        assert request(port, "POST", path, login, body)[0] in (409, 422), variables

    # With a pool that takes all of it, as one of an earlier version does.
    template = {
        "job_configuration": {"command": "{{ command }}", "env": "{{ env }}"},
        "variables": {
            "type": "object",
            "properties": {
                "command": {"type": "string", "default": command},
                "env": {"type": "object"},
            },
        },
    }
    for pool in ("worldpose", "worldpose-arrivals"):
        changed = {"base_job_template": template}
        assert request(port, "PATCH", f"/api/work_pools/{pool}", login, changed)[0] == 204
    time.sleep(20.0)  # the worker has read the pools again
    refused = [
        served.ask(f"/deployments/{deployment['id']}/create_flow_run", scheduled(command))["id"]
    ]
    # Another deployment, which brings its code, or names other code that is there.
    shell = {"prefect.deployments.steps.run_shell_script": {"script": command}}
    for number, other in enumerate(
        (
            {"pull_steps": [shell], "entrypoint": "flows.service.deployed.ingest"},
            {"entrypoint": "subprocess.getoutput", "parameters": {"cmd": command}},
            {"entrypoint": f"{file.parent}/evil.py:evil"},
        )
    ):
        made = served.ask(
            "/deployments/",
            {
                "name": f"other-{number}",
                "flow_id": deployment["flow_id"],
                "work_pool_name": "worldpose-arrivals",
                **other,
            },
        )
        begun = served.ask(f"/deployments/{made['id']}/create_flow_run", scheduled())
        refused.append(begun["id"])
    # Parameters that are not a run's to choose, or of no such kind.
    plan = {**deployment["parameters"]["plan"], "project": "/another"}
    begun = served.ask(
        f"/deployments/{deployment['id']}/create_flow_run",
        {"parameters": {"plan": plan}, **scheduled()},
    )
    *states, of_plan = settle(served, [*refused, begun["id"]])
    # Recovery may see a plan that is not the service's first; then its own scan replaces the run.
    if of_plan["type"] == "CANCELLED":
        assert "options of the service have changed" in of_plan["message"]
    else:
        states.append(of_plan)
    assert {state["type"] for state in states} == {"FAILED"}
    assert all("worker refused" in state["message"] for state in states)
    assert not file.exists(), file.read_text()

    # An installed deployment that was changed runs what was installed.
    changed = {"pull_steps": [shell], "entrypoint": "subprocess.getoutput"}
    assert request(port, "PATCH", f"/api/deployments/{deployment['id']}", login, changed)[0] == 204
    begun = served.ask(f"/deployments/{deployment['id']}/create_flow_run", scheduled())
    (state,) = settle(served, [begun["id"]])
    assert state["type"] == "COMPLETED", state
    assert not file.exists(), file.read_text()


def arguments_of(process):
    try:
        return process.cmdline()
    except psutil.Error:  # it has ended
        return []


def secrets_in(process):
    try:
        values = " ".join(process.environ().values())
    except psutil.Error:
        return set()
    return {secret for secret in (TOKEN, ALERT, CLOUD, OTHER) if secret in values}


def test_nothing_that_listens_answers_a_stranger_also_while_a_match_runs(served, small_match):
    family = psutil.Process(served.process.pid)
    assert set(listening(family)) >= set(served.ports.values())
    shutil.copytree(small_match, served.project / "inbox" / "small")
    runs = {}

    def has_workers():
        """Until a run has Dask's scheduler and workers."""
        found = listening(family)
        for each in family.children(recursive=True):
            command = " ".join(arguments_of(each))
            if "run_process" in command or "multiprocessing" in command:
                runs.setdefault(each.pid, secrets_in(each))
        # Besides the three servers: the scheduler and its nannies, and a worker.
        owners = {process.pid for process in found.values()}
        return len(owners) > 4

    deadline = time.monotonic() + 600
    while not has_workers():
        assert time.monotonic() < deadline, served.explain()
        time.sleep(0.3)
    try:
        now = listening(family)
        others = set(now) - set(served.ports.values())
        assert len(others) >= 3  # a scheduler, a nanny, a worker
        for port in others:
            assert says_nothing(port), (port, arguments_of(now[port]))
        assert runs
        assert set().union(*runs.values()) == set()
    finally:
        shutil.rmtree(served.project / "inbox" / "small")
    parts = {
        part: secrets_in(psutil.Process(service["pid"]))
        for part, service in json.loads((served.project / "operations" / "serve.json").read_text())[
            "services"
        ].items()
        if part != "serve"
    }
    assert parts == {"prefect": {TOKEN}, "worker": set(), "watch": {ALERT}, "pages": {TOKEN}}


def test_secrets_that_are_kept_are_for_this_user_alone(served):
    folder = served.project / "operations" / "secrets"
    assert folder.stat().st_mode & 0o777 == 0o700
    for name in ("prefect", "metrics"):
        assert (folder / name).stat().st_mode & 0o777 == 0o600
        assert len(served.secret(name)) >= 32
        assert served.secret(name) not in served.said.read_text()
    # Other users of the machine read the arguments of every process.
    for process in psutil.Process(served.process.pid).children(recursive=True):
        command = " ".join(arguments_of(process))
        for secret in (TOKEN, served.secret("prefect"), served.secret("metrics")):
            assert secret not in command
