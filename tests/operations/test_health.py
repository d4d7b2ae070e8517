"""Health checks name each fault with its remedy; a taken port is named before anything starts."""

import os
import socket
import ssl
from contextlib import ExitStack
from datetime import UTC, datetime
from functools import partial
from http.server import BaseHTTPRequestHandler, HTTPServer
from threading import Thread
from types import SimpleNamespace

import pytest
from command_line import worldpose
from service import free_ports

from data_contracts.operations import Arrival, Service, Serving
from flows.cli import options
from flows.cli.project import status
from flows.cli.serve import serve
from flows.orchestration.prefect_api import PrefectApi
from flows.orchestration.prefect_environment import CLIENT_LOGIN
from flows.orchestration.private_cluster import write_certificate
from flows.service import health, layout
from flows.service import serving as supervising
from flows.service.health import _check_inbox, _check_servers, at_prefect, check
from flows.service.layout import StateFolder
from flows.service.match_runs import match_runs_of
from flows.service.plan import Secrets, ServePlan
from flows.web.http_server import require_free_ports
from worldpose.errors import InputError, StoreError


@pytest.fixture
def state(tmp_path):
    return StateFolder(tmp_path / "operations")


def serving(tmp_path, prefect, **services):
    return Serving(
        project=str(tmp_path),
        inbox=str(tmp_path / "inbox"),
        name="healthy",
        prefect=prefect,
        owns_prefect=False,
        services={"serve": Service(pid=os.getpid()), **services},
        started_at=datetime.now(UTC),
    )


def by_part(findings):
    return {finding.part: finding for finding in findings}


def test_what_was_never_started_or_killed_is_said(state, tmp_path):
    (finding,) = check(state)
    assert (finding.part, finding.is_well) == ("serve", False)
    assert "not started" in finding.state
    state.folder.mkdir()
    with state.only_one("serve", wait=False):
        assert [each.state for each in check(state)] == ["it starts"]
    (state.folder / "serve.lock").unlink()
    state.write_serving(serving(tmp_path, "http://127.0.0.1:9/api"))
    (finding,) = check(state)
    assert "killed" in finding.state
    assert not [*state.folder.glob("*.lock")]  # whoever asks may have no right to write
    # Another process can have its number: the lock alone tells that it serves.
    assert match_runs_of(str(tmp_path)) is None
    with state.only_one("serve", wait=False):
        assert match_runs_of(str(tmp_path)) is not None
    assert "worldpose serve" in finding.remedy


def test_every_part_that_is_not_well_says_how_to_mend_it(server, state, tmp_path, monkeypatch):
    dead = Service(pid=2**22 + 1, address="http://127.0.0.1:9")
    state.write_serving(serving(tmp_path, server, pages=dead))
    monkeypatch.setattr(health, "LOW_DISK_GB", 1e9)
    with state.only_one("serve", wait=False):
        found = by_part(check(state))
        assert {part for part, each in found.items() if each.is_well} == {"serve", "prefect"}
        assert "match" in found["deployments"].state
        assert "worker.log" in found["worker of healthy"].remedy
        assert "pages.log" in found["pages"].remedy
        assert "inbox" in found["inbox"].remedy
        assert "worldpose gc" in found["disk"].remedy
        assert all(each.remedy for each in found.values() if not each.is_well)
        # Another login, and without the server: deployments are unknown.
        with monkeypatch.context() as other:
            other.setenv(CLIENT_LOGIN, "worldpose:wrong")
            assert CLIENT_LOGIN in by_part(check(state))["deployments"].remedy
        state.write_serving(serving(tmp_path, "http://127.0.0.1:9/api"))
        (tmp_path / "inbox").mkdir()
        for name, seen in (("a", "taken"), ("b", "refused"), ("c", "refused")):
            state.write_arrival(Arrival(name=name, state=seen, changed_at=datetime.now(UTC)))
        found = by_part(check(state))
        assert "Start the Prefect server" in found["prefect"].remedy
        assert "began 0 s ago" in found["deployments"].remedy  # it may start yet
        assert "Fix prefect first; if it is well" in found["deployments"].remedy
        inbox = found["inbox"]
        assert (inbox.is_well, inbox.state) == (True, "3 known, 2 refused")


def test_a_moved_project_is_refused_before_its_worker_starts(state, tmp_path, monkeypatch):
    there = {"parameters": {"project": "/before/the/move"}}
    monkeypatch.setattr(PrefectApi, "deployment", lambda self, name: there)
    for name in ("problem_at", "require_login", "_require_free_ports"):
        monkeypatch.setattr(supervising, name, lambda _: "")
    own, inbox = serving(tmp_path, "http://127.0.0.1:9/api"), tmp_path / "inbox"
    about = {"project": own.project, "name": own.name, "prefect": own.prefect}
    plan = ServePlan(**about, inbox=inbox, state=state.folder, owns_prefect=False)
    begin = partial(supervising.serve, plan, Secrets("", "", None), lambda: None, print)
    inbox.touch()  # its folders cannot be made, as for want of permission
    with pytest.raises(StoreError, match=r"run again\. Published results are unchanged"):
        begin()
    inbox.unlink()
    with pytest.raises(InputError, match=r"found that of /before/the/move\. .*--name"):
        begin()
    assert not state.logs.exists()
    found = next(at_prefect(state, own.model_copy(update={"owns_prefect": True})))
    assert (found.is_well, "/before/the/move" in found.state) == (False, True)
    assert f"Move it back, or remove {state.folder}" in found.remedy


def test_pages_are_asked_with_their_own_certificate(state, tmp_path):
    write_certificate(tmp_path)
    own, key = tmp_path / "certificate.pem", tmp_path / "key.pem"
    with HTTPServer((HOST, 0), BaseHTTPRequestHandler) as pages:
        tls = ssl.SSLContext(ssl.PROTOCOL_TLS_SERVER)
        tls.load_cert_chain(own, key)
        pages.socket = tls.wrap_socket(pages.socket, server_side=True)
        Thread(target=pages.handle_request, daemon=True).start()
        at = Service(pid=os.getpid(), address=f"https://{HOST}:{pages.server_port}/login")
        served = serving(tmp_path, "http://127.0.0.1:9/api", pages=at)
        served = served.model_copy(update={"certificate": str(own)})
        assert by_part(_check_servers(state, served))["pages"].state.endswith("answers 501")


HOST = "127.0.0.1"
OPTIONS = ("--port", "--metrics-port", "--prefect-port")


@pytest.fixture
def taken():
    with socket.create_server((HOST, 0)) as other:
        yield other.getsockname()[1]


@pytest.mark.parametrize("chosen", [OPTIONS[:1], OPTIONS[1:], OPTIONS])
def test_a_taken_port_is_named_with_the_next_free_one(chosen):
    ports = dict(zip(OPTIONS, free_ports(3), strict=True))
    wanted = {option: (HOST, port) for option, port in ports.items()}
    with ExitStack() as others:
        for option in chosen:
            others.enter_context(socket.create_server((HOST, ports[option])))
        with pytest.raises(InputError) as refusal:
            require_free_ports(wanted)
    said = str(refusal.value)
    assert said.startswith(f"{chosen[0]} {ports[chosen[0]]}: ")
    free = int(said.rsplit(f"with {chosen[0]} ", 1)[1].partition(",")[0])
    assert free > ports[chosen[0]]
    require_free_ports(wanted)


def test_a_port_for_two_parts_is_refused():
    (port,) = free_ports(1)
    with pytest.raises(InputError, match=f"--metrics-port {port}: .*another program"):
        require_free_ports({"--port": (HOST, port), "--metrics-port": (HOST, port)})


def test_a_foreign_address_is_refused_as_one():
    with pytest.raises(InputError, match=r"--port 8571: .*192\.0\.2\.1.*--host"):
        require_free_ports({"--port": ("192.0.2.1", 8571)})


def test_pages_at_a_taken_port_print_no_address(tiny_run, taken):
    answer = worldpose("review", "serve", "--project", tiny_run, "--port", taken)
    assert (answer.code, answer.out) == (1, "")
    assert f"--port {taken}: expected a free port" in answer.err


def test_a_service_with_a_taken_port_starts_nothing(tmp_path, taken):
    ports = ("--port", free_ports(1)[0], "--metrics-port", taken)
    answer = worldpose("serve", "--project", tmp_path / "p", "--inbox", tmp_path / "in", *ports)
    assert (answer.code, answer.out) == (1, "")
    assert f"--metrics-port {taken}: expected a free port" in answer.err
    assert not list((tmp_path / "p").glob("operations/logs/*.log"))


@pytest.mark.timeout(60)
@pytest.mark.parametrize(("command", "more"), [(serve, {"check": True}), (status, {"match": None})])
def test_a_command_says_that_the_disk_of_its_project_does_not_answer(
    command, more, monkeypatch, tmp_path
):
    monkeypatch.setattr(layout, "DISK_SECONDS", 0.5)
    file = tmp_path / "project.json"
    os.mkfifo(file)  # without a writer
    silent = _check_inbox(StateFolder(tmp_path), SimpleNamespace(inbox=str(file)))
    assert (silent.is_well, silent.state) == (False, "its disk does not answer")
    with pytest.raises(InputError, match=r"project.json: .* no answer within 0.5 s"):
        options.command_of(command)(as_json=True, project=str(tmp_path), **more)
    os.close(os.open(file, os.O_RDWR))


def test_a_folder_that_cannot_be_listed_does_not_answer(monkeypatch, tmp_path):
    assert layout.disk_answers(tmp_path)
    gate = tmp_path / "gate"
    os.mkfifo(gate)  # without a writer
    (tmp_path / "ls").write_text(f"#!/bin/sh\nread line < {gate}\n")
    (tmp_path / "ls").chmod(0o755)
    monkeypatch.setenv("PATH", f"{tmp_path}:{os.environ['PATH']}")
    monkeypatch.setattr(layout, "DISK_SECONDS", 0.5)
    assert not layout.disk_answers(tmp_path)
    os.close(os.open(gate, os.O_RDWR))


def test_no_lock_is_made_where_no_disk_is_mounted(state, tmp_path):
    with pytest.raises(FileNotFoundError), state.only_one("versions", wait=True):
        pass
    assert list(tmp_path.iterdir()) == []
