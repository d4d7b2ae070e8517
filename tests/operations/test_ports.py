"""A port that another program uses is named before anything is started or printed."""

import socket
from contextlib import ExitStack

import pytest
from command_line import worldpose
from service import free_ports

from flows.web.http_server import require_free_ports
from worldpose.errors import InputError

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
