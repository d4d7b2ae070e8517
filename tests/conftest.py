"""Fixtures that tests of the whole system share: one match, one project, one Prefect server."""

import fcntl
import importlib
import json
import multiprocessing.util
import os
import shutil
import threading
import urllib.request
from http.server import BaseHTTPRequestHandler, ThreadingHTTPServer
from pathlib import Path

import command_line
import pytest
from command_line import succeed
from hypothesis import settings
from warm_process import STAGES

from flows.orchestration.prefect_environment import local_cluster_options, prefect_server

# multiprocessing keeps its sockets in the first folder that it gets: not in that of a test, which
# is removed after it.
multiprocessing.util.get_temp_dir()

# How long a case takes says how busy a machine is.
settings.register_profile("untimed", deadline=None, max_examples=50)
settings.load_profile("untimed")


@pytest.fixture(scope="session")
def server():
    """The address of one Prefect API for all tests that do not test starting one.

    Their runs compute on one standing Dask worker.
    """
    from distributed import LocalCluster  # late: many test runs need no cluster

    before = dict(os.environ)
    options = {**local_cluster_options(1), "host": "127.0.0.1"}
    stages = [f"tasks.{name}" for name in STAGES]
    options["preload"] = ["tasks.preload", "prefect_dask", *stages, "flows.match"]
    with prefect_server(is_local=True) as wait_until_ready, LocalCluster(**options) as cluster:
        # Before the scheduler, a thread of this process, would do it while it receives the first
        # task: on busy cores it then did not answer for so long that its clients gave up.
        for name in options["preload"][1:]:
            importlib.import_module(name)
        wait_until_ready()
        around = command_line.surroundings()
        command_line.shared.update(dask=cluster.scheduler_address, surroundings=around)
        yield os.environ["PREFECT_API_URL"]
        command_line.shared.clear()
    os.environ.clear()
    os.environ.update(before)


def make_once(tmp_path_factory, name, make):
    """A folder that `make` fills, which the processes of one test run share; read only."""
    own = tmp_path_factory.getbasetemp()
    folder = (own.parent if "PYTEST_XDIST_WORKER" in os.environ else own) / f"shared-{name}"
    folder.mkdir(exist_ok=True)
    with (folder / "lock").open("w") as lock:
        fcntl.flock(lock, fcntl.LOCK_EX)  # released when the file is closed
        if not (folder / "made").exists():
            make(folder / name)
            (folder / "made").touch()
    return folder / name


@pytest.fixture(scope="session")
def tiny(tmp_path_factory):
    """A small synthetic match folder with truth; read only."""
    tiny = ("--scenario", "tiny", "--seed", 3, "--duration", 1.2, "--no-stills")
    return make_once(
        tmp_path_factory, "tiny", lambda folder: succeed("simulate", *tiny, "--out", folder)
    )


@pytest.fixture(scope="session")
def tiny_run(server, tiny, tmp_path_factory):
    """A project in which `tiny` has been run once; read only."""
    return make_once(
        tmp_path_factory,
        "worldpose-data",
        lambda project: succeed("run", tiny, "--project", project),
    )


@pytest.fixture(scope="session")
def ingested(server, tiny, tmp_path_factory):
    """A project whose only run of `tiny` ended after its first stage; read only."""
    return make_once(
        tmp_path_factory,
        "ingested",
        lambda project: succeed("run", tiny, "--project", project, "--until", "ingest"),
    )


@pytest.fixture
def project_copy(tiny_run, tmp_path):
    """A copy of that project, to be changed."""
    return Path(shutil.copytree(tiny_run, tmp_path / "worldpose-data"))


def one_at_a_time(application):
    """S3 decides which of two writers of a new file was first; moto may let both be."""
    deciding = threading.Lock()

    def answer(environment, start):
        with deciding:
            return list(application(environment, start))

    return answer


@pytest.fixture(scope="session")
def bucket():
    """The URL of a bucket in an S3 server on loopback."""
    from moto.server import ThreadedMotoServer  # late: most tests need no such server
    from werkzeug.serving import WSGIRequestHandler

    # Connections that stay open halve the time of a request.
    WSGIRequestHandler.protocol_version = "HTTP/1.1"
    server = ThreadedMotoServer(ip_address="127.0.0.1", port=0, verbose=False)
    server.start()
    server._server.app = one_at_a_time(server._server.app)
    host, port = server.get_host_and_port()
    endpoint = f"http://{host}:{port}"
    make = urllib.request.Request(f"{endpoint}/projects", method="PUT")
    with urllib.request.urlopen(make), pytest.MonkeyPatch.context() as patch:
        patch.setenv("AWS_ENDPOINT_URL", endpoint)
        patch.setenv("AWS_ACCESS_KEY_ID", "test")
        patch.setenv("AWS_SECRET_ACCESS_KEY", "test")
        patch.setenv("AWS_REGION", "us-east-1")
        yield "s3://projects"
    server.stop()


@pytest.fixture
def webhook():
    """A server that keeps posts and answers with the status codes in `codes`, then with 204.

    `posted` has content types and bodies, those of JSON read; `asked` has paths and logins.
    """

    class Handler(BaseHTTPRequestHandler):
        protocol_version = "HTTP/1.1"

        def do_POST(self):
            body, kind = (
                self.rfile.read(int(self.headers["content-length"])),
                self.headers["content-type"],
            )
            self.server.posted.append((kind, json.loads(body) if "json" in kind else body))
            self.server.asked.append((self.path, self.headers["authorization"]))
            self.send_response(self.server.codes.pop(0) if self.server.codes else 204)
            self.send_header("content-length", "0")
            self.end_headers()

        def log_message(self, *arguments):
            pass

    server = ThreadingHTTPServer(("127.0.0.1", 0), Handler)
    server.posted, server.asked, server.codes = [], [], []
    server.base = f"http://127.0.0.1:{server.server_port}"
    server.address = f"{server.base}/hook?token=secret"
    threading.Thread(target=server.serve_forever, daemon=True).start()
    yield server
    server.shutdown()
    server.server_close()
