"""Ports to which processes listen, and whether they answer those who may not ask."""

import socket
import ssl

import psutil


def listening(process):
    """Port to the process that listens to it."""
    found = {}
    for each in [process, *process.children(recursive=True)]:
        try:
            for connection in each.net_connections("inet"):
                if connection.status == psutil.CONN_LISTEN:
                    assert connection.laddr.ip == "127.0.0.1", each.cmdline()
                    found[connection.laddr.port] = each
        except psutil.NoSuchProcess:
            continue
    return found


def says_nothing(port, patience=10.0):
    """Whether a port that is not for people hangs up on those without its certificate or secret.

    One that takes what comes and answers nothing for so many seconds does not hang up.
    """
    with socket.create_connection(("127.0.0.1", port), patience) as plain:
        plain.settimeout(patience)
        plain.sendall(b"GET / HTTP/1.1\r\nHost: 127.0.0.1\r\n\r\n")
        try:
            said = plain.recv(100)
        except TimeoutError:
            return False  # it waits, for an unknown reason
        except OSError:
            said = b""
    # TLS answers with an alert; nothing that speaks HTTP or Dask's protocol does.
    if said and said[:1] != b"\x15":
        return False
    context = ssl.create_default_context()
    context.check_hostname, context.verify_mode = False, ssl.CERT_NONE
    try:
        with (
            socket.create_connection(("127.0.0.1", port), patience) as raw,
            context.wrap_socket(raw) as wrapped,
        ):
            return wrapped.recv(100) == b""
    except TimeoutError:
        return False
    except OSError:
        return True
