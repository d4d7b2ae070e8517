"""Notes every attempt to look up or reach anything but this machine, and refuses it."""

import os
import socket
from pathlib import Path

LOOPBACK = {"127.0.0.1", "::1", "localhost", "0.0.0.0", "", None}
NOTES = os.environ["WORLDPOSE_TEST_NOTES"]


def refuse(what):
    with Path(NOTES).open("a") as notes:
        notes.write(f"{what}\n")
    raise OSError(f"refused by the test: {what}")


connect, connect_ex, look_up = socket.socket.connect, socket.socket.connect_ex, socket.getaddrinfo


def is_local(address):
    return not isinstance(address, tuple) or address[0] in LOOPBACK


socket.socket.connect = lambda self, address: (
    connect(self, address) if is_local(address) else refuse(address)
)
socket.socket.connect_ex = lambda self, address: (
    connect_ex(self, address) if is_local(address) else refuse(address)
)


def getaddrinfo(host, *arguments, **keywords):
    name = host.decode() if isinstance(host, bytes) else host
    if name in LOOPBACK or name == socket.gethostname():
        return look_up(host, *arguments, **keywords)
    return refuse(host)


socket.getaddrinfo = getaddrinfo
