"""HTTP server with deadlines for slow clients and a limit on open connections."""

from __future__ import annotations

import asyncio
import errno
import logging
import resource
import socket
import sys
import time
from collections.abc import Callable, Mapping
from contextlib import ExitStack, suppress
from dataclasses import dataclass, field
from typing import Any, Final

import h11
import uvicorn
from uvicorn.protocols.http.h11_impl import H11Protocol

from worldpose.errors import InputError

REQUEST_SECONDS: Final = 10.0
"""Deadline for the headers of a request, and again for its body."""
ANSWER_SECONDS: Final = 60.0
"""Deadline for a client to read some of a response."""
MAX_CONNECTIONS: Final = 200
"""Open connections; beyond it the oldest one without a complete request is closed."""
ACCEPTED_SHARE: Final = 8
"""A loop iteration accepts at most this fraction of the limit before other reads."""
QUEUE: Final = 2048
"""Connections that the operating system queues until they are accepted."""
LOG_SECONDS: Final = 60.0
"""Interval between two log lines about closed connections."""

LOG = logging.getLogger("worldpose.pages")


@dataclass
class _Connection:
    """An open connection.

    It is closed at the deadline of the monotonic clock unless its client acts [s]; None while the
    server computes a response.
    """

    socket: socket.socket
    deadline: float | None


@dataclass
class Connections:
    """Open connections of a server; connections whose clients are too slow are closed.

    Only the event loop of the server calls it.
    """

    limit: int = MAX_CONNECTIONS
    _open: dict[Any, _Connection] = field(default_factory=dict)
    _closed: int = 0
    _told: float = float("-inf")

    def __post_init__(self) -> None:
        files, _ = resource.getrlimit(resource.RLIMIT_NOFILE)
        if files != resource.RLIM_INFINITY:
            self.limit = max(1, min(self.limit, files // 4))

    def admit(self, connection: socket.socket, address: object) -> None:
        """Register a connection; beyond the limit, close the oldest that waits for its client."""
        self._open[address] = _Connection(connection, time.monotonic() + REQUEST_SECONDS)
        if len(self._open) <= self.limit:
            return
        self._forget_closed()
        waiting = (at for at, each in self._open.items() if each.deadline is not None)
        if len(self._open) > self.limit:
            self._close(next(waiting, address))

    def expect(self, address: object, seconds: float | None) -> None:
        """Start a deadline for the client of a connection [s]; None while the server computes."""
        if address in self._open:
            deadline = None if seconds is None else time.monotonic() + seconds
            self._open[address].deadline = deadline

    def sweep(self) -> None:
        """Close the connections whose deadline has passed; called every second."""
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
        """Shut a connection down in both directions; its reader then closes the file."""
        self._closed += 1
        with suppress(OSError):  # the client has closed it already
            self._open.pop(address).socket.shutdown(socket.SHUT_RDWR)

    def _forget_closed(self) -> None:
        for address in [at for at, each in self._open.items() if each.socket.fileno() == -1]:
            del self._open[address]


class _Listener(socket.socket):
    """Listening socket that registers each accepted connection."""

    connections: Connections

    def accept(self) -> tuple[socket.socket, Any]:
        connection, address = super().accept()
        self.connections.admit(connection, address)
        return connection, address


class _Protocol(H11Protocol):
    """HTTP/1.1 protocol that reports whether a connection waits for its client or the server."""

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
        """Pass the connection on without a deadline: a WebSocket can be silent for any time."""
        super().handle_websocket_upgrade(event)
        self._is_upgraded = True
        self.connections_open.expect(self._address, None)

    def on_response_complete(self) -> None:
        super().on_response_complete()
        self._note()

    def pause_writing(self) -> None:
        super().pause_writing()
        self._phase = None
        self.connections_open.expect(self._address, ANSWER_SECONDS)

    def resume_writing(self) -> None:
        super().resume_writing()
        self._note()

    def _note(self) -> None:
        """Start a deadline when a phase begins; further bytes of the phase do not extend it."""
        if self._is_upgraded:
            return
        cycle = self.cycle
        is_answering = cycle is not None and not cycle.response_complete
        is_working = is_answering and not cycle.more_body
        phase = (cycle, is_answering, is_working)
        if phase != self._phase:
            self._phase = phase
            self.connections_open.expect(self._address, None if is_working else REQUEST_SECONDS)


class _Server(uvicorn.Server):
    """uvicorn with a short accept loop, a long queue, and a check of deadlines every second."""

    def __init__(self, config: uvicorn.Config, connections: Connections) -> None:
        super().__init__(config)
        self.connections = connections

    async def startup(self, sockets: list[socket.socket] | None = None) -> None:
        await super().startup(sockets)
        for each in sockets or []:
            # asyncio accepts as many connections per loop iteration as its backlog: more than there
            # are file descriptors if that is the length of the queue.
            each.listen(QUEUE)

    async def on_tick(self, counter: int) -> bool:
        if counter % 10 == 0:  # every tenth tick of 0.1 s
            self.connections.sweep()
        return await super().on_tick(counter)


def serve_http(
    app: Any,  # noqa: ANN401
    *,
    host: str,
    port: int,
    max_connections: int = MAX_CONNECTIONS,
    announce: Callable[[], None] = lambda: None,
    **options: Any,  # noqa: ANN401
) -> None:
    """Serve an ASGI application until this process receives a signal to end.

    Port 0 is any free one; `announce` is called when it is ours, and before it is served. Open
    connections are also limited to a quarter of the files that this process can open; options are
    further ones of `uvicorn.Config`. InputError if the port is taken, or the host is not an address
    of this machine.
    """
    connections = Connections(max_connections)
    protocol = type("Protocol", (_Protocol,), {"connections_open": connections})
    config = uvicorn.Config(
        app,
        http=protocol,
        loop="asyncio",
        backlog=max(1, connections.limit // ACCEPTED_SHARE),
        access_log=False,
        proxy_headers=False,  # any account of this machine could name another address as its own
        log_level="error",  # a line per malformed request would fill the disk
        **{"ws": "none", **options},
    )
    listeners = _listeners(host, port, connections)
    announce()
    server = _Server(config, connections)
    server.run(sockets=list[socket.socket](listeners))
    if not server.started:
        sys.exit(f"{host}, port {port}: the server did not start; its log says why")


def _listeners(host: str, port: int, connections: Connections) -> list[_Listener]:
    """Open listening sockets at all addresses of a name."""
    with ExitStack() as opened:
        try:
            listeners = _listen(opened, host, port)
        except OSError as error:
            raise _port_error("--port", host, port, error) from error
        for each in listeners:
            each.connections = connections
        opened.pop_all()
    return listeners


def require_free_ports(wanted: Mapping[str, tuple[str, int]]) -> None:
    """Raise InputError unless a process can listen at all ports, by the option that names them.

    A port may be taken or wanted twice, or a host not an address of this machine.
    """
    with ExitStack() as opened:
        for option, (host, port) in wanted.items():
            try:
                _listen(opened, host, port)
            except OSError as error:
                raise _port_error(option, host, port, error) from error


def _listen(opened: ExitStack, host: str, port: int) -> list[_Listener]:
    """Listen at all addresses of a name until the stack is closed; return the sockets."""
    listeners = []
    found = socket.getaddrinfo(host, port, type=socket.SOCK_STREAM, flags=socket.AI_PASSIVE)
    for family, kind, protocol, _, address in dict.fromkeys(found):
        listener = opened.enter_context(_Listener(family, kind, protocol))
        listener.setblocking(False)
        listener.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 1)
        if family == socket.AF_INET6:
            listener.setsockopt(socket.IPPROTO_IPV6, socket.IPV6_V6ONLY, 1)
        listener.bind(address)
        listener.listen(QUEUE)  # with SO_REUSEADDR others could bind it again before
        listeners.append(listener)
    return listeners


def _port_error(option: str, host: str, port: int, error: OSError) -> InputError:
    """Return the error about a port that cannot be listened at, with the next free one."""
    free = next((each for each in range(port + 1, 65536) if _is_free(host, each)), None)
    if error.errno != errno.EADDRINUSE or free is None:
        return InputError(
            f"{option} {port}",
            expected=f"an address of this machine and a port that this user may open at {host}",
            found=error.strerror or str(error),
            todo="Choose another address with --host, or another port.",
        )
    return InputError(
        f"{option} {port}",
        expected=f"a free port at {host}",
        found="one at which another program listens",
        todo=f"Choose the next free one with {option} {free}, or end that program.",
    )


def _is_free(host: str, port: int) -> bool:
    with ExitStack() as opened, suppress(OSError):
        return bool(_listen(opened, host, port))
    return False
