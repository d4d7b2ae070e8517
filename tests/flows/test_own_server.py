"""Costs that a run with its own Prefect server avoids."""

import dataclasses
import http.client
import os
import sqlite3
import ssl
import subprocess
import sys
import time
from contextlib import closing
from pathlib import Path
from urllib.parse import urlsplit

import psutil
import pytest
from distributed import Client, Security
from listeners import listening, says_nothing

from flows.orchestration import prefect_environment
from flows.orchestration.prefect_environment import (
    AUTHORITIES,
    CLIENT_LOGIN,
    DATABASE_FILE,
    SERVER_LOGIN,
    authorization,
    begin_database,
    keep_database,
    local_cluster_options,
    one_authority,
    prefect_server,
    without_secrets,
)
from flows.orchestration.private_cluster import PrivateCluster
from flows.service.child import PARTS
from flows.service.plan import METRICS_TOKEN, ServePlan, secrets_of
from flows.service.serving import environment_of


@pytest.fixture
def kept(tmp_path, monkeypatch):
    """Where the empty database is kept, of which there is none yet."""
    file = tmp_path / "installation" / "prefect.db"
    monkeypatch.setattr(prefect_environment, "kept_database", lambda: file)
    monkeypatch.delenv("PREFECT_API_URL", raising=False)
    return file


def tables(database):
    with closing(sqlite3.connect(database)) as opened:
        assert opened.execute("pragma integrity_check").fetchone() == ("ok",)
        return set(opened.execute("select type, name, sql from sqlite_master"))


@pytest.mark.slow
def test_a_server_answers_its_run_alone_and_later_ones_begin_with_its_database(kept, monkeypatch):
    for name in ("PREFECT_API_URL", CLIENT_LOGIN, SERVER_LOGIN):  # of a server of other tests
        monkeypatch.delenv(name, raising=False)
    with prefect_server(is_local=True) as wait_until_ready:
        wait_until_ready()
        made = tables(Path(os.environ["PREFECT_HOME"]) / DATABASE_FILE)
        login = require_answers_for_its_run_alone()
    assert CLIENT_LOGIN not in os.environ
    assert len(made) > 50
    assert [file.name for file in kept.parent.iterdir()] == [kept.name]
    with prefect_server(is_local=True) as wait_until_ready:
        assert (
            tables(Path(os.environ["PREFECT_HOME"]) / DATABASE_FILE) == made
        )  # before the server is up
        assert os.environ[CLIENT_LOGIN] != login
        wait_until_ready()
    assert tables(kept) == made


def require_answers_for_its_run_alone():
    """Ask the server of this process with right and wrong headers; return the right login."""
    api, login = os.environ["PREFECT_API_URL"], os.environ[CLIENT_LOGIN]
    assert SERVER_LOGIN not in os.environ
    address = urlsplit(api)

    def ask(**headers):
        connection = http.client.HTTPConnection(address.hostname, address.port, timeout=60)
        connection.request("POST", "/api/flow_runs/filter", "{}", {**headers})
        return connection.getresponse().status

    right = {"Authorization": authorization(login), "Content-Type": "application/json"}
    assert (ask(**right), ask()) == (200, 401)
    assert ask(Authorization=authorization(f"{login}x")) == 401
    assert ask(**right, Host="evil.example") == 421
    assert ask(**right, Origin="http://evil.example") == 403
    return login


def test_a_killed_run_leaves_no_folder_of_its_server(kept):
    run = "import os, time; from flows.orchestration.prefect_environment import prefect_server as s"
    run += "\nwith s() as wait:\n wait()\n print(os.environ['PREFECT_HOME'], flush=True)"
    with subprocess.Popen(
        [sys.executable, "-c", f"{run}\n time.sleep(600)"], stdout=subprocess.PIPE, text=True
    ) as killed:
        home = Path(killed.stdout.readline().strip())
        assert (home / DATABASE_FILE).is_file()
        killed.kill()
    deadline = time.monotonic() + 60
    while home.exists() and time.monotonic() < deadline:
        time.sleep(0.1)
    assert not home.exists()


def test_a_prefect_server_without_a_login_does_not_start():
    server = [sys.executable, "-m", "flows.orchestration.prefect_server", "--host", "0.0.0.0"]
    environment = without_secrets(os.environ)
    said = subprocess.run(server, env=environment, capture_output=True, text=True, timeout=300)
    assert said.returncode != 0
    assert SERVER_LOGIN in said.stderr
    assert "openssl" in said.stderr


def test_secrets_go_to_the_parts_that_need_them(tmp_path, monkeypatch):
    database = "PREFECT_API_DATABASE_CONNECTION_URL"
    secret = "WORLDPOSE_ALERT_URL WORLDPOSE_ALERT_MAIL AWS_ACCESS_KEY_ID AWS_SECRET_ACCESS_KEY"
    secret += f" GITHUB_TOKEN PGPASSWORD WORLDPOSE_REVIEW_TOKEN {database}"
    secret += " MYSQL_PWD GH_PAT SLACK_HOOK"  # names that tell nothing of secrets
    given = {name: f"of {name}" for name in secret.split()}
    harmless = {"AWS_REGION": "eu", "TOKENIZERS_PARALLELISM": "false", "LC_ALL": "C.UTF-8"}
    cloud = [name for name in os.environ if name.startswith("AWS_")]
    for name in (CLIENT_LOGIN, SERVER_LOGIN, METRICS_TOKEN, *cloud):
        monkeypatch.delenv(name, raising=False)
    for name, value in {**given, **harmless}.items():
        monkeypatch.setenv(name, value)
    plan = ServePlan(
        project=str(tmp_path), inbox=tmp_path, state=tmp_path / "state", prefect="http://x/api"
    )
    everywhere = environment_of(plan)
    assert everywhere.keys().isdisjoint({*given, CLIENT_LOGIN, SERVER_LOGIN, METRICS_TOKEN})
    assert everywhere.items() >= harmless.items()
    monkeypatch.setenv("WORLDPOSE_PASS_VARIABLES", "SLACK_HOOK, GH_PAT")
    assert environment_of(plan).keys() & given.keys() == {"SLACK_HOOK", "GH_PAT"}
    monkeypatch.delenv("WORLDPOSE_PASS_VARIABLES")
    secrets = secrets_of(plan, "pages' token")
    login, metrics = secrets.prefect, secrets.metrics
    cloud = {name: value for name, value in given.items() if name.startswith("AWS")}
    region = {"AWS_REGION": "eu"}
    alerts = {name: value for name, value in given.items() if "ALERT" in name}
    client, pages = {CLIENT_LOGIN: login}, {"WORLDPOSE_REVIEW_TOKEN": "pages' token"}
    expected = {
        "prefect": {SERVER_LOGIN: login, database: given[database], **pages},
        "worker": client,
        "watch": {**client, **alerts, METRICS_TOKEN: metrics},
        "pages": {**client, **pages},
    }
    assert {part: secrets.of(part, plan) for part in PARTS} == expected
    # Those who read and write the store need its key; the bucket's only who copies from it.
    on_s3 = plan.model_copy(update={"project": "s3://projects/x"})
    bucket = plan.model_copy(update={"bucket": "s3://arriving"})
    stored = {part: {**cloud, **region} for part in PARTS if part != "prefect"} | {"prefect": {}}
    assert {part: secrets.of(part, on_s3) for part in PARTS} == {
        part: {**values, **stored[part]} for part, values in expected.items()
    }
    assert secrets.of("worker", bucket) == client
    assert secrets.of("watch", bucket).items() >= cloud.items()
    # The same at the next start; renewed if others could read it.
    assert secrets_of(plan, "") == dataclasses.replace(secrets, pages="")
    (tmp_path / "state" / "secrets" / "prefect").chmod(0o640)
    (tmp_path / "state" / "secrets" / "metrics").unlink()
    (tmp_path / "state" / "secrets" / "metrics").symlink_to("prefect")
    renewed = secrets_of(plan, "")
    assert len({login, metrics, renewed.prefect, renewed.metrics}) == 4
    assert (tmp_path / "state" / "secrets" / "prefect").stat().st_mode & 0o777 == 0o600


def test_own_workers_serve_their_run_alone():
    before = listening(psutil.Process())
    with PrivateCluster(**local_cluster_options(1)) as cluster, Client(cluster) as client:
        assert client.submit(sum, [1, 2]).result() == 3
        address = cluster.scheduler_address
        plain = {"timeout": 5, "set_as_default": False}
        with pytest.raises(OSError, match="TLS certificate does not match"):
            Client(address, security=Security.temporary(), **plain)
        with pytest.raises(OSError):
            Client(address.replace("tls://", "tcp://"), **plain)
        # Scheduler, nanny and worker listen, each with TLS.
        ports = listening(psutil.Process()).keys() - before.keys()
        assert len(ports) == 3
        assert all(map(says_nothing, ports))


def test_one_authority_is_read_by_those_on_this_machine_who_talk_plainly(tmp_path, monkeypatch):
    monkeypatch.delenv(AUTHORITIES, raising=False)
    file = one_authority(tmp_path)[AUTHORITIES]
    assert len(ssl.create_default_context(cafile=file).get_ca_certs()) == 1
    own = {"prefect": "http://127.0.0.1:4200/api"}
    plan = ServePlan(project=str(tmp_path), inbox=tmp_path, state=tmp_path, **own)
    assert AUTHORITIES in environment_of(plan)
    # Workers elsewhere do not see the file, and another's server may be one with TLS.
    for other in ({"dask": "tcp://far:8786"}, {"owns_prefect": False}):
        assert AUTHORITIES not in environment_of(plan.model_copy(update=other))
    monkeypatch.setenv(AUTHORITIES, "/of/somebody.pem")
    assert one_authority(tmp_path)[AUTHORITIES] == "/of/somebody.pem"


def test_a_database_is_copied_and_kept_only_where_there_is_none_and_a_place(tmp_path, kept):
    keep_database(tmp_path)  # there is none: it is elsewhere
    assert not kept.exists()
    kept.parent.mkdir()
    kept.write_bytes(b"empty")
    (tmp_path / DATABASE_FILE).write_bytes(b"full")
    assert not begin_database(tmp_path)
    assert (tmp_path / DATABASE_FILE).read_bytes() == b"full"
    assert not begin_database(tmp_path / "copied")
    files = [at / DATABASE_FILE for at in (tmp_path, tmp_path / "copied")]
    assert [file.stat().st_mode & 0o777 for file in files] == [0o600, 0o600]
    kept.unlink()
    kept.parent.rmdir()
    kept.parent.touch()  # a file where the folder should be: every server makes its own
    keep_database(tmp_path)
    assert begin_database(tmp_path / "another")
    assert (tmp_path / "another" / DATABASE_FILE).stat().st_mode & 0o777 == 0o600
