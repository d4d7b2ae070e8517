"""A stranger's path: one command, a match in the inbox, a question, a verdict, the result."""

import json
import os
import shutil
import signal
import socket
import subprocess
import time
import urllib.error
import urllib.request
from http.cookiejar import CookieJar
from http.server import BaseHTTPRequestHandler, HTTPServer
from threading import Thread

import psutil
import pytest
from command_line import WORLDPOSE, succeed, worldpose

from worldpose.store import Store

pytestmark = pytest.mark.slow  # a Prefect server, a worker, and a match from end to end

TOKEN = "a token of twenty-four.."
PATIENCE = 900.0
"""What a step may take on two busy cores [s]; it takes a tenth on idle ones."""
SLOWEST = 30.0
"""What one answer may take on two busy cores [s]."""
MOST_TROUBLES = 2
"""Answers of a wait that may be late or say that SQLite's one writer was busy."""


def free_ports(count):
    probes = [socket.create_server(("127.0.0.1", 0)) for _ in range(count)]
    ports = [probe.getsockname()[1] for probe in probes]
    for probe in probes:
        probe.close()
    return ports


class Served:
    """A project that `worldpose serve` serves."""

    def __init__(self, folder, webhook):
        self.environment = {}
        self.project = folder / "project"
        self.webhook = webhook
        self.ports = dict(zip(("prefect", "pages", "metrics"), free_ports(3), strict=True))
        self.said = folder / "said.txt"
        self.process = None

    def begin(self):
        arguments = {
            "--project": self.project,
            "--prefect-port": self.ports["prefect"],
            "--port": self.ports["pages"],
            "--metrics-port": self.ports["metrics"],
            "--quiet": 3,
            "--sweep": 1,
            "--disk-gb": 1e9,  # more than there is: an alert that is sure to come
        }
        environment = {
            **{name: value for name, value in os.environ.items() if name != "PREFECT_API_URL"},
            "WORLDPOSE_REVIEW_TOKEN": TOKEN,
            "WORLDPOSE_ALERT_URL": self.webhook,
            **self.environment,
        }
        begun = self.said.read_text().count("Ctrl-C ends it") if self.said.exists() else 0
        options = [str(each) for pair in arguments.items() for each in pair]
        with self.said.open("ab") as output:
            self.process = subprocess.Popen(
                [*WORLDPOSE, "serve", *options],
                stdout=output,
                stderr=subprocess.STDOUT,
                env=environment,
                start_new_session=True,
            )

        def is_up():
            assert self.process.poll() is None, self.explain()
            return self.said.read_text().count("Ctrl-C ends it") > begun

        wait_until(is_up, self.explain)

    def end(self, number=signal.SIGTERM):
        """End it, and give how many of its processes are left."""
        family = [psutil.Process(self.process.pid)]
        family += family[0].children(recursive=True)
        self.process.send_signal(number)
        self.process.wait(60)
        _, left = psutil.wait_procs(family, timeout=20)
        return len(left)

    def ask(self, path, body=None):
        """Prefect's own API."""
        return fetch(f"http://127.0.0.1:{self.ports['prefect']}/api{path}", body)

    def runs(self, name):
        return self.ask("/flow_runs/filter", {"flow_runs": {"name": {"any_": [name]}}})

    def check(self):
        return worldpose("serve", "--check", "--project", self.project, "--json")

    def explain(self):
        logs = sorted((self.project / "operations" / "logs").glob("*.log"))
        return "\n".join(f"{log}:\n{log.read_text()[-1500:]}" for log in [self.said, *logs])


class Browser:
    """Somebody who has logged in to the pages."""

    def __init__(self, served):
        self.base = f"http://127.0.0.1:{served.ports['pages']}"
        self.opener = urllib.request.build_opener(urllib.request.HTTPCookieProcessor(CookieJar()))
        self.secret = ""
        self.ask("/api/login", {"who": "Ada", "token": TOKEN})
        self.secret = self.ask("/api/session")["form_secret"]

    def ask(self, path, body=None):
        headers = {"x-form-secret": self.secret} if self.secret else {}
        return fetch(self.base + path, body, headers, self.opener)

    def approve_all(self, match):
        """How many questions were approved."""
        reviews = self.ask(f"/api/matches/{match}")["reviews"]
        waiting = [each["id"] for each in reviews if each["state"] == "waits"]
        if waiting:
            said = {"verdict": "approve", "seen": dict.fromkeys(waiting, "waits")}
            self.ask(f"/api/matches/{match}/decisions", {"reviews": waiting, **said})
        return len(waiting)


def fetch(address, body=None, headers=None, opener=None):
    data = None if body is None else json.dumps(body).encode()
    headers = {"content-type": "application/json", **(headers or {})}
    request = urllib.request.Request(address, data, headers)
    with (opener or urllib.request.build_opener()).open(request, timeout=SLOWEST) as answer:
        content = answer.read()
    kind = answer.headers["content-type"]
    return json.loads(content) if kind.startswith("application/json") else content.decode()


def wait_until(is_so, explain=str):
    deadline = time.monotonic() + PATIENCE
    troubles = []
    while True:
        try:
            found = is_so()
        except (TimeoutError, urllib.error.URLError) as error:
            found = None
            troubles.append(error)
            is_busy = not isinstance(error, urllib.error.HTTPError) or error.code >= 500
            assert is_busy and len(troubles) <= MOST_TROUBLES, f"{troubles}\n{explain()}"
        if found:
            return found
        assert time.monotonic() < deadline, explain()
        time.sleep(2.0)


@pytest.fixture
def webhook():
    """The address of a server that keeps what is posted to it, and what it has kept."""
    kept = []

    class Handler(BaseHTTPRequestHandler):
        def do_POST(self):
            length = int(self.headers["content-length"])
            kept.append(json.loads(self.rfile.read(length)))
            self.send_response(204)
            self.end_headers()

        def log_message(self, *arguments):
            pass

    server = HTTPServer(("127.0.0.1", 0), Handler)
    Thread(target=server.serve_forever, daemon=True).start()
    yield f"http://127.0.0.1:{server.server_port}/secret-path", kept
    server.shutdown()
    server.server_close()


@pytest.fixture
def served(tmp_path, webhook):
    service = Served(tmp_path, webhook[0])
    yield service
    if service.process is not None and service.process.poll() is None:
        service.end(signal.SIGKILL)


@pytest.mark.timeout(3600)
def test_a_match_in_the_inbox_becomes_a_result_with_one_command(served, webhook, tmp_path, capsys):
    succeed("simulate", "--scenario", "tiny", "--duration", 0.5, "--out", tmp_path / "match")
    name = "tiny-0-0.5s"
    times = {}
    began = time.monotonic()

    def note(what):
        times[what] = round(time.monotonic() - began, 1)

    served.begin()
    note("everything answers")
    healthy = served.check()
    assert (healthy.code, healthy.json["healthy"]) == (0, True), healthy.out
    # A copy with a link that leads out of it is refused; the good one is taken.
    shutil.copytree(tmp_path / "match", served.project / "inbox" / "urgent" / "hostile")
    (served.project / "inbox" / "urgent" / "hostile" / "stills" / "x").symlink_to("/etc/passwd")
    shutil.copytree(tmp_path / "match", served.project / "inbox" / "good")
    note("match in the inbox")
    wait_until(lambda: served.runs(name), served.explain)
    note("run at Prefect")
    browser = Browser(served)
    store = Store.open(str(served.project))

    wait_until(lambda: served.runs(name)[0]["state_name"] == "Suspended", served.explain)
    note("first question")
    # Everything is killed while the run waits, and goes on when begun again.
    assert served.end(signal.SIGKILL) == 0
    assert served.check().code == 1
    served.begin()
    note("killed and begun again")
    browser = Browser(served)
    assert browser.approve_all(name) > 0
    note("approved")

    # Killed while the run is at work: begun again it goes on by itself.
    wait_until(lambda: served.runs(name)[0]["state_name"] == "Running", served.explain)
    assert served.end(signal.SIGTERM) == 0
    served.begin()
    note("ended at work and begun again")
    browser = Browser(served)

    def is_done():
        browser.approve_all(name)
        (run,) = served.runs(name)
        # Between the two it is "Crashed" for a moment, until it begins again.
        assert run["state_name"] != "Failed", run["state"]["message"]
        return run["state_name"] == "Completed"

    wait_until(is_done, served.explain)
    note("result")
    record = store.run(name)
    assert (record.state, record.failed, record.waiting) == ("complete", (), ())
    assert record.figures["body_fitting/clip"]["bodies"] > 0

    status = browser.ask("/api/status")
    assert [match["state"] for match in status["matches"]] == ["complete"]
    arrivals = {each["name"]: each for each in status["arrivals"]}
    assert arrivals["good"]["flow_run"] == served.runs(name)[0]["id"]
    assert arrivals["urgent/hostile"]["state"] == "refused"
    assert "is a link" in arrivals["urgent/hostile"]["reason"]
    assert served.project.joinpath("inbox", "good", "match.yaml").is_file()
    figures = fetch(f"http://127.0.0.1:{served.ports['metrics']}/metrics")
    assert 'worldpose_matches{state="complete"} 1.0' in figures
    assert fetch(f"http://127.0.0.1:{served.ports['prefect']}/").startswith("<!")

    # A release is begun in Prefect's dashboard, as this call of it does.
    deployment = served.ask("/deployments/name/release/worldpose")["id"]
    given = {"match_id": name, "name": "v1", "licence": "for tests"}
    begun = served.ask(f"/deployments/{deployment}/create_flow_run", {"parameters": given})
    wait_until(
        lambda: served.ask(f"/flow_runs/{begun['id']}")["state_name"] == "Completed",
        served.explain,
    )
    released = served.project / "releases" / name
    assert json.loads((released / "v1" / "manifest.json").read_text())["release"] == "v1"
    assert "body_fitting" in (released / "v1-report.html").read_text()
    note("release")

    # The inbox is also gone through on schedule, and the webhook was told, each matter once.
    scheduled = {"flow_runs": {"tags": {"any_": ["auto-scheduled"]}, "name": {"any_": ["inbox"]}}}
    wait_until(lambda: served.ask("/flow_runs/filter", scheduled), served.explain)
    wait_until(lambda: {"disk_low", "arrival_refused"} <= {each["alert"] for each in webhook[1]})
    texts = [each["text"] for each in webhook[1] if each["alert"] == "arrival_refused"]
    assert len(texts) == len(set(texts))
    secrets = (TOKEN, "secret-path")
    for file in (served.project / "operations").rglob("*"):
        if file.is_file():
            assert not any(secret.encode() in file.read_bytes() for secret in secrets), file
    assert served.end(signal.SIGINT) == 0
    assert served.check().code == 1
    with capsys.disabled():
        print(f"\nseconds since the command: {times}")


@pytest.mark.timeout(3600)
def test_prefect_keeps_runs_that_wait_in_postgres(served, postgres, tmp_path):
    address, ask = postgres
    served.environment["PREFECT_API_DATABASE_CONNECTION_URL"] = address
    served.begin()
    assert served.check().json["healthy"], served.explain()
    names = ask("select name from flow order by name").split()
    assert names == ["finetune", "ingest", "match", "release", "reprocess"]
    small = ("--duration", 0.2, "--cameras", 3, "--players", 2, "--no-stills", "--no-video")
    folder = tmp_path / "small"
    succeed("simulate", "--scenario", "tiny", *small, "--out", folder)
    # One click far off is asked about, as soon as that camera is calibrated.
    clicks = folder / "annotations" / "static_calibration" / "cam01.json"
    clicked = json.loads(clicks.read_text())
    clicked["points"][0]["xy"][0] += 150.0
    clicks.write_text(json.dumps(clicked))
    shutil.copytree(folder, served.project / "inbox" / "small")
    query = "select state_name from flow_run where name like 'tiny-0-%'"
    wait_until(lambda: ask(query) in ("Suspended", "Failed", "Crashed"), served.explain)
    assert ask(query) == "Suspended"
    assert served.end() == 0


def test_a_second_service_of_a_project_and_an_absent_server_are_refused(tmp_path):
    from flows.operations.layout import StateFolder

    project = tmp_path / "project"
    state = StateFolder(project / "operations")
    with state.only_one("serve", wait=False):
        answer = worldpose("serve", "--project", project)
        assert answer.code == 2
        assert "another process" in answer.err
    absent = {"PREFECT_API_URL": f"http://127.0.0.1:{free_ports(1)[0]}/api"}
    answer = worldpose("serve", "--project", project, environment=absent)
    assert answer.code == 2
    assert "running Prefect server" in answer.err
    with pytest.raises(urllib.error.URLError):
        fetch(absent["PREFECT_API_URL"])
