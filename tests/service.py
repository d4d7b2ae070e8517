"""A project served by `worldpose serve`, and a client."""

import http.client
import json
import os
import signal
import socket
import subprocess
import time
import urllib.error
import urllib.request
from http.cookiejar import CookieJar

import psutil
from command_line import WORLDPOSE, worldpose

from flows.orchestration.prefect_environment import authorization

TOKEN = "a token of twenty-four.."
PATIENCE = 900.0
"""Maximum time of a step on two busy cores [s]; a tenth on idle ones."""
SLOWEST = 30.0
"""Maximum time of one answer on two busy cores [s]."""
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
        self.options = {}
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
            "--settle-time": 3,
            "--poll-interval": 1,
            "--disk-gb": 1e9,  # more than there is: an alert that is sure to come
            **self.options,
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

    def secret(self, name):
        """The service's secrets for `prefect` and `metrics`."""
        return (self.project / "operations" / "secrets" / name).read_text().strip()

    def ask(self, path, body=None):
        """Prefect's own API."""
        headers = {"authorization": authorization(self.secret("prefect"))}
        for _ in range(MOST_TROUBLES):
            try:
                return fetch(f"http://127.0.0.1:{self.ports['prefect']}/api{path}", body, headers)
            except urllib.error.HTTPError as error:
                if error.code != 503:  # SQLite's one writer was busy; Prefect's clients try again
                    raise
                time.sleep(2.0)
        return fetch(f"http://127.0.0.1:{self.ports['prefect']}/api{path}", body, headers)

    def figures(self):
        """Return the metrics that Prometheus scrapes."""
        headers = {"authorization": f"Bearer {self.secret('metrics')}"}
        return fetch(f"http://127.0.0.1:{self.ports['metrics']}/metrics", headers=headers)

    def runs(self, name):
        """Return Prefect's runs whose names begin with `name`, usually a match."""
        return self.ask("/flow_runs/filter", {"flow_runs": {"name": {"like_": f"{name}, "}}})

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


def request(port, method, path, headers=None, body=None):
    """Status, headers and content of any request at all."""
    connection = http.client.HTTPConnection("127.0.0.1", port, timeout=30)
    given = {"host": f"127.0.0.1:{port}", **(headers or {})}
    content = None if body is None else json.dumps(body)
    if body is not None:
        given.setdefault("content-type", "application/json")
    connection.request(method, path, content, given)
    answer = connection.getresponse()
    found = answer.status, {k.lower(): v for k, v in answer.getheaders()}, answer.read()
    connection.close()
    return found


def fetch(address, body=None, headers=None, opener=None):
    data = None if body is None else json.dumps(body).encode()
    headers = {"content-type": "application/json", **(headers or {})}
    request = urllib.request.Request(address, data, headers)
    with (opener or urllib.request.build_opener()).open(request, timeout=SLOWEST) as answer:
        content = answer.read()
    kind = answer.headers["content-type"]
    return json.loads(content) if kind.startswith("application/json") else content.decode()


def wait_until(is_so, explain=str, pause=2.0):
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
        time.sleep(pause)
