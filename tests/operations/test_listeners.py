"""A port that answers without a login is found, whatever it speaks."""

import socket
import ssl
import subprocess
import sys
import time
from contextlib import contextmanager
from http.server import BaseHTTPRequestHandler, HTTPServer
from threading import Thread

import psutil
import pytest
from distributed import Security
from listeners import listening, says_nothing


class Plain(BaseHTTPRequestHandler):
    """Answers any client."""

    def do_GET(self):
        self.send_response(404)
        self.end_headers()

    def log_message(self, *arguments):
        pass


@contextmanager
def answering(handle):
    """The port at which each connection is handed to a function."""
    with socket.create_server(("127.0.0.1", 0)) as server:

        def serve():
            while True:
                try:
                    connection, _ = server.accept()
                except OSError:
                    return
                Thread(target=handle, args=[connection], daemon=True).start()

        Thread(target=serve, daemon=True).start()
        yield server.getsockname()[1]


def test_an_http_server_without_a_login_is_found():
    with HTTPServer(("127.0.0.1", 0), Plain) as server:
        Thread(target=server.serve_forever, daemon=True).start()
        assert not says_nothing(server.server_port)
        server.shutdown()


def test_a_port_that_takes_anything_and_is_silent_is_found():
    def swallow(connection):
        while connection.recv(100):
            pass

    with answering(swallow) as port:
        assert not says_nothing(port, patience=1.0)


def test_a_port_that_hangs_up_is_none():
    with answering(lambda connection: connection.recv(100) and connection.close()) as port:
        assert says_nothing(port)


def test_listening_ports_are_found_and_have_to_be_of_this_machine():
    here = psutil.Process()
    with socket.create_server(("127.0.0.1", 0)) as own:
        assert own.getsockname()[1] in listening(here)
    with socket.create_server(("0.0.0.0", 0)), pytest.raises(AssertionError):
        listening(here)


def test_a_dask_scheduler_without_a_certificate_is_found(tmp_path):
    with socket.create_server(("127.0.0.1", 0)) as probe:
        port = probe.getsockname()[1]
    command = [sys.executable, "-m", "distributed.cli.dask_scheduler", "--host", "127.0.0.1"]
    options = ["--port", str(port), "--no-dashboard"]
    scheduler = subprocess.Popen([*command, *options], stderr=subprocess.DEVNULL, cwd=tmp_path)
    try:
        deadline = time.monotonic() + 120
        with socket.socket() as probe:
            while probe.connect_ex(("127.0.0.1", port)) != 0:
                assert time.monotonic() < deadline
                time.sleep(0.2)
        assert not says_nothing(port)
    finally:
        scheduler.terminate()
        scheduler.wait(60)


@pytest.mark.parametrize("asks", [True, False])
def test_tls_counts_where_it_asks_for_a_certificate(asks):
    context = Security.temporary().get_listen_args("scheduler")["ssl_context"]
    context.verify_mode = ssl.CERT_REQUIRED if asks else ssl.CERT_NONE

    def greet(connection):
        try:
            with context.wrap_socket(connection, server_side=True) as wrapped:
                wrapped.sendall(b"welcome")
        except OSError:
            connection.close()

    with answering(greet) as port:
        assert says_nothing(port) is asks
