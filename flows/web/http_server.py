"""An HTTP server that slow clients cannot fill: deadlines, and a bound on open connections."""

from __future__ import annotations

import asyncio
import logging
import resource
import socket
import sys
import time
from contextlib import suppress
from dataclasses import dataclass, field
from threading import Lock
from typing import Any, Final

import h11
import uvicorn
from uvicorn.protocols.http.h11_impl import H11Protocol

from worldpose.errors import UsageError

REQUEST_SECONDS: Final = 10.0
"""In which a client has to send the headers of a request, and again its body."""
ANSWER_SECONDS: Final = 60.0
"""In which a client has to take some of an answer."""
MAX_CONNECTIONS: Final = 200
"""Open at a time; for one more the oldest is closed that has not sent its request."""
ACCEPTED_SHARE: Final = 8
"""This part of the limit is accepted at a time, before others are read from."""
QUEUE: Final = 2048
"""Connections that the system keeps until they are accepted."""
LOG_SECONDS: Final = 60.0
"""Between two log lines about connections that were closed."""

LOG = logging.getLogger("worldpose.pages")


@dataclass
class _Connection:
    """One that is open.

    Attributes:
        socket: of it.
        deadline: when it is closed unless its client has done its part by then, on the clock that
            only goes forward [s]; None while the server is at work on an answer.
    """

    socket: socket.socket
    deadline: float | None


@dataclass
class Connections:
    """The open connections of a server, of which those that wait too long for clients are closed.

    Attributes:
        limit: how many may be open.
    """

    limit: int = MAX_CONNECTIONS
    _open: dict[Any, _Connection] = field(default_factory=dict)
    _lock: Lock = field(default_factory=Lock)
    _closed: int = 0
    _told: float = float("-inf")

    def __post_init__(self) -> None:
        files, _ = resource.getrlimit(resource.RLIMIT_NOFILE)
        if files != resource.RLIM_INFINITY:
            self.limit = max(1, min(self.limit, files // 4))

    def admit(self, connection: socket.socket, address: object) -> None:
        """Take in a new connection; where there are too many, close the oldest that waits."""
        with self._lock:
            self._open[address] = _Connection(connection, time.monotonic() + REQUEST_SECONDS)
            if len(self._open) <= self.limit:
                return
            self._forget_closed()
            waiting = (at for at, each in self._open.items() if each.deadline is not None)
            if len(self._open) > self.limit:
                self._close(next(waiting, address))

    def wait(self, address: object, seconds: float = REQUEST_SECONDS) -> None:
        """From now on the client has to do its part within so long [s]."""
        with self._lock:
            if address in self._open:
                self._open[address].deadline = time.monotonic() + seconds

    def work(self, address: object) -> None:
        """From now on the server is at work on an answer."""
        with self._lock:
            if address in self._open:
                self._open[address].deadline = None

    def sweep(self) -> None:
        """Close the connections whose clients let their deadline pass; called every second."""
        with self._lock:
            self._forget_closed()
            now = time.monotonic()
            for address, each in list(self._open.items()):
                if each.deadline is not None and each.deadline < now:
                    self._close(address)
            if self._closed and now - self._told > LOG_SECONDS:
                LOG.warning(
                    "%s connections were closed: no whole request came within %g s, or more than "
                    "%s were open",
                    *(self._closed, REQUEST_SECONDS, self.limit),
                )
                self._closed, self._told = 0, now

    def _close(self, address: object) -> None:
        """End a connection in both directions; whoever reads from it then closes its file."""
        self._closed += 1
        with suppress(OSError):  # its client was quicker
            self._open.pop(address).socket.shutdown(socket.SHUT_RDWR)

    def _forget_closed(self) -> None:
        for address in [at for at, each in self._open.items() if each.socket.fileno() == -1]:
            del self._open[address]


class _Listener(socket.socket):
    """A listening socket whose connections are counted as they are accepted."""

    connections: Connections

    def accept(self) -> tuple[socket.socket, Any]:
        connection, address = super().accept()
        self.connections.admit(connection, address)
        return connection, address


class _Protocol(H11Protocol):
    """HTTP/1.1, which tells for whom each connection waits."""

    connections_open: Connections
    _address: object = None
    _phase: object = None
    _is_upgraded = False

    def connection_made(self, transport: asyncio.Transport) -> None:  # type: ignore[override]
        super().connection_made(transport)
        self._address = transport.get_extra_info("peername")
        self._note()

    def data_received(self, data: bytes) -> None:
        super().data_received(data)
        self._note()

    def handle_websocket_upgrade(self, event: h11.Request) -> None:
        """Hand the connection on; a WebSocket may be silent for as long as it wants."""
        super().handle_websocket_upgrade(event)
        self._is_upgraded = True
        self.connections_open.work(self._address)

    def on_response_complete(self) -> None:
        super().on_response_complete()
        self._note()

    def pause_writing(self) -> None:
        super().pause_writing()
        self._phase = None
        self.connections_open.wait(self._address, ANSWER_SECONDS)

    def resume_writing(self) -> None:
        super().resume_writing()
        self._note()

    def _note(self) -> None:
        """Begin a deadline where a phase begins; further bytes of the same do not prolong it."""
        if self._is_upgraded:
            return
        cycle = self.cycle
        is_answering = cycle is not None and not cycle.response_complete
        is_working = is_answering and not cycle.more_body
        phase = (cycle, is_answering, is_working)
        if phase != self._phase:
            self._phase = phase
            if is_working:
                self.connections_open.work(self._address)
            else:
                self.connections_open.wait(self._address)


class _Server(uvicorn.Server):
    """uvicorn with a short accept loop, a long queue, and a sweep every second."""

    def __init__(self, config: uvicorn.Config, connections: Connections) -> None:
        super().__init__(config)
        self.connections = connections

    async def startup(self, sockets: list[socket.socket] | None = None) -> None:
        await super().startup(sockets)
        for each in sockets or []:
            # asyncio accepts as many in one turn as it was told to queue: more than there are
            # files, where that is the length of the queue.
            each.listen(QUEUE)

    async def on_tick(self, counter: int) -> bool:
        if counter % 10 == 0:  # of a tenth of a second each
            self.connections.sweep()
        return await super().on_tick(counter)


def serve_http(
    app: Any,  # noqa: ANN401
    *,
    host: str,
    port: int,
    max_connections: int = MAX_CONNECTIONS,
    **options: Any,  # noqa: ANN401
) -> None:
    """Serve an ASGI application until this process is told to end.

    Args:
        app: the application.
        host: name or address to listen at.
        port: 0 = one that is free.
        max_connections: open at a time, and no more than a quarter of the files that this process
            may open.
        options: further ones of `uvicorn.Config`.

    Raises:
        UsageError: the port is taken, or the host is none of this machine.
    """
    connections = Connections(max_connections)
    protocol = type("Protocol", (_Protocol,), {"connections_open": connections})
    config = uvicorn.Config(
        app,
        http=protocol,
        loop="asyncio",
        backlog=max(1, connections.limit // ACCEPTED_SHARE),
        access_log=False,
        log_level="error",  # a line for each request that is none would fill the disk
        **{"ws": "none", **options},
    )
    listeners = _listeners(host, port, connections)
    server = _Server(config, connections)
    server.run(sockets=listeners)
    if not server.started:
        sys.exit(f"{host}, port {port}: the server did not start; its log says why")


def _listeners(host: str, port: int, connections: Connections) -> list[socket.socket]:
    """Sockets at all addresses of a name."""
    listeners: list[socket.socket] = []
    try:
        found = socket.getaddrinfo(host, port, type=socket.SOCK_STREAM, flags=socket.AI_PASSIVE)
        for family, kind, protocol, _, address in dict.fromkeys(found):
            listener = _Listener(family, kind, protocol)
            listeners.append(listener)
            listener.connections = connections
            listener.setblocking(False)
            listener.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 1)
            if family == socket.AF_INET6:
                listener.setsockopt(socket.IPPROTO_IPV6, socket.IPV6_V6ONLY, 1)
            listener.bind(address)
            listener.listen(QUEUE)
    except OSError as error:
        for each in listeners:
            each.close()
        raise UsageError(
            f"{host}, port {port}",
            expected="an address of this machine and a port that is free",
            found=error.strerror or str(error),
            todo="Choose another with --port, or end what listens there.",
        ) from error
    return listeners
