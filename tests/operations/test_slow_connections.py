"""Slow or silent clients do not block the pages for others."""

import http.client
import os
import resource
import socket
import subprocess
import sys
import time
from contextlib import contextmanager

from page_client import TOKEN
from service import free_ports
from websockets.sync.client import connect

from worldpose.store.store import Store

HALF_HEADERS = b"GET /api/health HTTP/1.1\r\nHost: 127.0.0.1\r\n"
HALF_BODY = (
    b"POST /api/login HTTP/1.1\r\nHost: 127.0.0.1\r\nContent-Type: application/json\r\n"
    b"Content-Length: 1000\r\n\r\n{"
)

LIMIT = 3.0
"""Time for a request to come [s], less than the pages give: a test waits for its end."""
LIMITED = f"""
from flows.web import http_server
http_server.REQUEST_SECONDS = {LIMIT}
"""
PAGES = f"{LIMITED}from flows.cli import main; main()"
ECHO = (
    LIMITED
    + """
import sys
from flows.web.http_server import serve_http

async def app(scope, receive, send):
    if scope["type"] == "http":
        while (await receive()).get("more_body"):
            pass
        await send({"type": "http.response.start", "status": 200, "headers": []})
        await send({"type": "http.response.body"})
        return
    await receive()
    await send({"type": "websocket.accept"})
    while (message := await receive())["type"] == "websocket.receive":
        await send({"type": "websocket.send", "text": message["text"]})

options = {"ws": "auto", "lifespan": "off", "max_connections": 32}
serve_http(app, host="127.0.0.1", port=int(sys.argv[1]), **options)
"""
)


@contextmanager
def pages(tmp_path, files):
    """The port of a process that serves pages and may have so many files open; its log."""
    Store.create(tmp_path / "project")
    (port,) = free_ports(1)
    log = tmp_path / "pages.log"
    served = ["review", "serve", "--port", port, "--project", tmp_path / "project"]
    command = [sys.executable, "-c", PAGES, *served]

    def limit():
        resource.setrlimit(resource.RLIMIT_NOFILE, (files, files))

    with log.open("wb") as output:
        server = subprocess.Popen(
            list(map(str, command)),
            env={**os.environ, "WORLDPOSE_REVIEW_TOKEN": TOKEN},
            stdout=output,
            stderr=output,
            preexec_fn=limit,
        )
    try:
        deadline = time.monotonic() + 300
        while ask(port) != 200:
            assert server.poll() is None, log.read_text()
            assert time.monotonic() < deadline
            time.sleep(0.2)
        yield port, log
    finally:
        server.terminate()
        server.wait(60)


def ask(port, path="/api/health"):
    connection = http.client.HTTPConnection("127.0.0.1", port, timeout=30)
    try:
        connection.request("GET", path)
        return connection.getresponse().status
    except OSError:
        return None
    finally:
        connection.close()


def open_many(port, count):
    """So many connections, by turns silent, with half of the headers, and with half of a body."""
    opened = []
    for number in range(count):
        each = socket.socket()
        each.setblocking(False)
        each.connect_ex(("127.0.0.1", port))
        opened.append([each, (b"", HALF_HEADERS, HALF_BODY)[number % 3]])
    return opened


def send_first(opened):
    for pair in opened:
        try:
            pair[1] = pair[1][pair[0].send(pair[1]) :] if pair[1] else b""
        except OSError:
            continue  # not connected yet, or closed again


def still_open(opened):
    """How many the server has not closed."""
    left = 0
    for each, _ in opened:
        try:
            left += each.recv(1 << 16) != b""
        except BlockingIOError:
            left += 1
        except OSError:
            continue
    return left


def attack(port, count, seconds):
    """Seconds per request of another client while so many connections are open."""
    opened = open_many(port, count)
    took, end = [], time.monotonic() + seconds
    try:
        while time.monotonic() < end:
            send_first(opened)
            began = time.monotonic()
            assert ask(port) == 200
            took.append(time.monotonic() - began)
            time.sleep(0.05)
        return took, still_open(opened)
    finally:
        for each, _ in opened:
            each.close()


def test_slow_connections_are_closed_and_others_are_served(tmp_path):
    """In small: 300 of them, at a process that may have 128 files open, which gives 32."""
    with pages(tmp_path, 128) as (port, log):
        size = log.stat().st_size
        took, left = attack(port, 300, LIMIT + 3.0)
        assert left <= 32
        assert len(took) > 10
        told = log.read_text(errors="replace")[size:]
        assert "connections were closed" in told
        assert len(told.splitlines()) < 5, told
        assert "Traceback" not in told
        assert 0.8 * LIMIT < send_byte_by_byte(port) < 45.0


def send_byte_by_byte(port):
    """Seconds until the server closes the connection of a body that comes slowly."""
    began = time.monotonic()
    with socket.create_connection(("127.0.0.1", port)) as slow:
        slow.sendall(HALF_BODY)
        slow.settimeout(1.0)
        while time.monotonic() - began < 60:
            try:
                slow.sendall(b" ")
                if slow.recv(1000) == b"":
                    break
            except TimeoutError:
                continue
            except OSError:
                break
    return time.monotonic() - began


def test_a_web_socket_may_be_silent_beside_slow_connections(tmp_path):
    (port,) = free_ports(1)
    server = subprocess.Popen([sys.executable, "-c", ECHO, str(port)])
    try:
        deadline = time.monotonic() + 120
        while ask(port) != 200:
            assert time.monotonic() < deadline
            time.sleep(0.2)
        with connect(f"ws://127.0.0.1:{port}/") as web_socket:
            _, left = attack(port, 100, LIMIT + 3.0)
            assert left <= 32
            web_socket.send("still here")
            assert web_socket.recv(30) == "still here"
    finally:
        server.terminate()
        server.wait(60)
