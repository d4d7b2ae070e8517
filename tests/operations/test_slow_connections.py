"""Slow or silent clients block neither pages nor Prefect's web sockets for others."""

import http.client
import socket
import subprocess
import sys
import time

from service import free_ports
from websockets.sync.client import connect

HALF_HEADERS = b"GET /api/health HTTP/1.1\r\nHost: 127.0.0.1\r\n"
HALF_BODY = (
    b"POST /api/login HTTP/1.1\r\nHost: 127.0.0.1\r\nContent-Type: application/json\r\n"
    b"Content-Length: 1000\r\n\r\n{"
)
LIMIT = 2.0
"""Time for a request to come [s], less than servers give: the test waits for its end."""
SERVER = f"""
import logging, resource, sys
from flows.web import http_server
resource.setrlimit(resource.RLIMIT_NOFILE, (128, 128))
http_server.REQUEST_SECONDS = {LIMIT}
logging.basicConfig()

async def app(scope, receive, send):
    if scope["type"] == "http":
        while (await receive()).get("more_body"):
            pass
        await send({{"type": "http.response.start", "status": 200, "headers": []}})
        await send({{"type": "http.response.body"}})
        return
    await receive()
    await send({{"type": "websocket.accept"}})
    while (message := await receive())["type"] == "websocket.receive":
        await send({{"type": "websocket.send", "text": message["text"]}})

port = int(sys.argv[1])
http_server.serve_http(app, host="127.0.0.1", port=port, ws="auto", lifespan="off")
"""


def ask(port):
    connection = http.client.HTTPConnection("127.0.0.1", port, timeout=30)
    try:
        connection.request("GET", "/api/health")
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
    """Answers to another client while so many connections are open, and how many stay open."""
    opened = open_many(port, count)
    answers, end = 0, time.monotonic() + seconds
    try:
        while time.monotonic() < end:
            send_first(opened)
            assert ask(port) == 200
            answers += 1
            time.sleep(0.05)
        return answers, still_open(opened)
    finally:
        for each, _ in opened:
            each.close()


def send_byte_by_byte(port):
    began = time.monotonic()
    with socket.create_connection(("127.0.0.1", port)) as slow:
        slow.sendall(HALF_BODY)
        slow.settimeout(0.3)
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


def test_slow_connections_are_closed_and_others_are_served(tmp_path):
    """In small: 300 of them, at a process that may have 128 files open, which gives 32."""
    (port,), log = free_ports(1), tmp_path / "server.log"
    with log.open("wb") as output:
        command = [sys.executable, "-c", SERVER, str(port)]
        server = subprocess.Popen(command, stdout=output, stderr=output)
    try:
        deadline = time.monotonic() + 300
        while ask(port) != 200:
            assert server.poll() is None and time.monotonic() < deadline, log.read_text()
            time.sleep(0.2)
        with connect(f"ws://127.0.0.1:{port}/") as web_socket:  # it may be silent
            answers, left = attack(port, 300, LIMIT + 1.5)
            assert left <= 32
            assert answers > 10
            web_socket.send("still here")
            assert web_socket.recv(30) == "still here"
        told = log.read_text(errors="replace")
        assert "connections were closed" in told and "Traceback" not in told
        assert len(told.splitlines()) < 5, told
        assert 0.8 * LIMIT < send_byte_by_byte(port) < 45.0
    finally:
        server.terminate()
        server.wait(60)
