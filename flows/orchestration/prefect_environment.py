"""Prefect's environment for this project: no telemetry, and a server of each run's own.

With PREFECT_API_URL set, runs use that server and appear in its dashboard. Otherwise a run starts
its own server on loopback for its duration. Only this module reads and sets the environment; it
must be called before Prefect is imported.
"""

from __future__ import annotations

import base64
import os
import re
import secrets
import shutil
import socket
import sqlite3
import ssl
import subprocess
import sys
import tempfile
import time
import urllib.error
import urllib.request
from collections.abc import Callable, Iterable, Iterator, Mapping
from contextlib import closing, contextmanager, suppress
from importlib.metadata import version
from pathlib import Path
from typing import Any
from urllib.parse import urlsplit

import certifi

from worldpose.cache_folder import user_cache
from worldpose.errors import InputError, WorldposeError

DATABASE_FILE = "prefect.db"
"""Name of the database file in PREFECT_HOME."""
RUN_HOME = "worldpose-prefect-"
"""Begin of the name of PREFECT_HOME of a server that lasts as long as its run."""
START_SECONDS = 120.0
"""The very first start creates Prefect's database, which took 15 s on two busy cores."""

ALWAYS = {"DO_NOT_TRACK": "1", "PREFECT_SERVER_ANALYTICS_ENABLED": "false"}
AUTHORITIES = "PREFECT_API_SSL_CERT_FILE"
LOOPBACK = "127.0.0.1,localhost"
"""Addresses that bypass proxies."""
LOOPBACK_NAMES = ("127.0.0.1", "localhost", "::1")
SERVER_LOGIN = "PREFECT_SERVER_API_AUTH_STRING"
"""Login that a Prefect server requires of its clients, as USER:PASSWORD."""
CLIENT_LOGIN = "PREFECT_API_AUTH_STRING"
"""Login of clients at a Prefect server."""
CLOUD_LOGIN = "PREFECT_API_KEY"
"""Login of clients at Prefect Cloud."""
DATABASE = (
    "PREFECT_API_DATABASE_CONNECTION_URL",
    "PREFECT_API_DATABASE_PASSWORD",
    "PREFECT_SERVER_DATABASE_CONNECTION_URL",
    "PREFECT_SERVER_DATABASE_PASSWORD",
)
"""Logins of a Prefect server at its database."""
_SECRET = re.compile(
    r"TOKENS?(?![A-Z])|SECRET|PASSW|PASSPHRASE|CREDENTIAL|AUTH_STRING|(API|ACCESS|PRIVATE)_?KEY|"
    r"(CONNECTION|DATABASE|WEBHOOK)_URL|^WORLDPOSE_ALERT",
    re.IGNORECASE,
)
"""Names of variables of our own parts and libraries that hold a secret, or lead to one."""
_ALLOWED = re.compile(
    r"PATH|HOME|USER|LOGNAME|SHELL|TERM|LANG|LANGUAGE|TZ|TE?MP|TMPDIR|PWD|HOSTNAME|VIRTUAL_ENV|"
    r"(HTTPS?|NO|ALL)_PROXY|DO_NOT_TRACK|AWS_(DEFAULT_)?REGION|AWS_ENDPOINT_URL.*|AWS_CA_BUNDLE|"
    r"(REQUESTS_CA|CURL_CA)_BUNDLE|SSL_CERT_(FILE|DIR)|TOKENIZERS_PARALLELISM|MPLCONFIGDIR|"
    r"(PYTHON|LC_|XDG_|LD_|DYLD_|CONDA_|COV|MALLOC_|GLIBC_|CUDA_|NVIDIA_|NCCL_|HIP_|ROCR_|OMP_|"
    r"KMP_|MKL_|OPENBLAS_|VECLIB_|BLIS_|NUMBA_|NUMEXPR_|OPENCV_|TORCH|PYTORCH_|HF_|SLURM_|"
    r"KUBERNETES_|DASK_|PREFECT_|OTEL_|OPENLINEAGE_|WORLDPOSE_).*",
    re.IGNORECASE,
)
"""Names of variables that runs may need; `PASSED` adds others."""
PASSED = "WORLDPOSE_PASS_VARIABLES"
"""Variable with the names of further variables that runs get, separated by commas."""
UNLESS_GIVEN = {
    # The server gets every line; the terminal has our own progress and failures.
    "PREFECT_LOGGING_EXTRA_LOGGERS": "worldpose",
    "PREFECT_LOGGING_HANDLERS_CONSOLE_LEVEL": "CRITICAL",
}
SERVED = {
    "PREFECT_FLOWS_HEARTBEAT_FREQUENCY": "30",  # heartbeat; the minimum value
    "PREFECT_WORKER_QUERY_SECONDS": "2",
    "PREFECT_SERVER_METRICS_ENABLED": "true",
    "PREFECT_SERVER_DATABASE_TIMEOUT": "60",  # SQLite accepts one writer at a time
    "PREFECT_SERVER_UI_SHOW_PROMOTIONAL_CONTENT": "false",
    "PREFECT_LOGGING_TO_API_WHEN_MISSING_FLOW": "ignore",  # serving processes are not runs
    # Dask closes a restarted worker that takes longer than this: 15 s, a slow machine's start.
    "DASK_DISTRIBUTED__DEPLOY__LOST_WORKER_TIMEOUT": str(START_SECONDS),
}
"""Defaults of serving processes."""
EMBEDDED = {
    # Used by automations and blocks, which a run's own server does not have.
    "PREFECT_API_BLOCKS_REGISTER_ON_START": "false",
    "PREFECT_SERVER_SERVICES_TRIGGERS_ENABLED": "false",
}
"""Defaults of a server that lasts as long as its run."""


def new_login() -> str:
    """Return a random login for a Prefect server, in the format of its variables."""
    return f"worldpose:{secrets.token_urlsafe(24)}"


def authorization(login: str) -> str:
    """Return the Authorization header of an HTTP client's login at a Prefect server."""
    return f"Basic {base64.b64encode(login.encode()).decode()}"


def without_secrets(environment: Mapping[str, str], keep: Iterable[str] = ()) -> dict[str, str]:
    """Return the variables of an environment that runs may need, without those that hold secrets.

    `keep` names variables that a child needs; a name that ends with `*` is a prefix.
    """
    kept = (*keep, *(name.strip() for name in environment.get(PASSED, "").split(",")))
    begins = tuple(name[:-1] for name in kept if name.endswith("*"))
    return {
        name: value
        for name, value in environment.items()
        if name in kept
        or (begins and name.startswith(begins))
        or (_ALLOWED.fullmatch(name) and not _SECRET.search(name))
    }


def served_environment(api: str, home: Path | None) -> dict[str, str]:
    """Return the environment of the processes of `worldpose serve`, without secrets.

    `home` is the database folder of our own Prefect server; None = an external server.
    """
    port = urlsplit(api).port or 80
    own = {} if home is None else {"PREFECT_HOME": str(home), "PREFECT_SERVER_API_PORT": str(port)}
    given = {
        name: os.environ.get(name, value) for name, value in {**UNLESS_GIVEN, **SERVED}.items()
    }
    # The dashboard uses the API of the server that it came from, whatever its name and port.
    origins = {"PREFECT_SERVER_CORS_ALLOWED_ORIGINS": api.removesuffix("/api")}
    pages = {"PREFECT_API_URL": api, "PREFECT_UI_API_URL": "/api", **origins}
    return {**without_secrets(os.environ), **ALWAYS, **given, **_without_proxy(), **own, **pages}


def _without_proxy() -> dict[str, str]:
    """Return the variables that exempt this machine from proxies."""
    names = ("NO_PROXY", "no_proxy")
    return {name: ",".join(filter(None, [os.environ.get(name), LOOPBACK])) for name in names}


def one_authority(folder: Path) -> dict[str, str]:
    """Return the environment of processes that use Prefect over plain HTTP only: no CA checks.

    Prefect reads every certificate authority twice for each task, which takes 34 ms of CPU time;
    from a file with one of them it reads one. Workers must see the folder too.
    """
    end = b"-----END CERTIFICATE-----\n"
    first = Path(certifi.where()).read_bytes().partition(end)
    file = folder / "authority.pem"
    file.write_bytes(first[0] + first[1])
    return {AUTHORITIES: os.environ.get(AUTHORITIES, str(file))}


def served_cluster() -> dict[str, Any]:
    """Return a deployment's `DaskTaskRunner` options, which `worldpose serve` sets for its worker.

    WORLDPOSE_DASK is the address of a running scheduler; without it a run starts WORLDPOSE_WORKERS
    worker processes on its machine, one per core by default.
    """
    address = os.environ.get("WORLDPOSE_DASK")
    if address:
        return {"address": address}
    return {
        "cluster_class": "flows.orchestration.private_cluster.PrivateCluster",
        "cluster_kwargs": local_cluster_options(int(os.environ.get("WORLDPOSE_WORKERS") or 0)),
    }


def local_cluster_options(workers: int) -> dict[str, Any]:
    """Return Dask's options for worker processes on this machine; 0 = one per core."""
    return {
        "n_workers": workers or os.cpu_count() or 1,
        "threads_per_worker": 1,
        "memory_limit": 0,  # a limit of one worker's share would kill a long clip's only task
        "dashboard_address": "127.0.0.1:0",
        "silence_logs": "CRITICAL",
        # A unit that ends its worker is given up by itself; units queued with it are not at fault.
        "scheduler_kwargs": {"allowed_failures": 100, "dashboard": False},
        # A worker would sample its own stack a hundred times per second.
        "config": {"distributed.worker.profile.enabled": False},
    }


def has_server() -> bool:
    """Return whether an external Prefect server is configured, which outlives its runs."""
    return bool(os.environ.get("PREFECT_API_URL"))


@contextmanager
def prefect_server(*, is_local: bool = False) -> Iterator[Callable[[], None]]:
    """Set up environment and server for Prefect; yield a function that waits for its API.

    Prefect, which takes seconds to import, can then be imported while its server starts. The
    function raises WorldposeError if our own server does not answer. Its database lasts as long as
    it does. `is_local` says that all its clients see this machine's files. InputError if a given
    server does not answer.
    """
    given = {name: os.environ.get(name, value) for name, value in UNLESS_GIVEN.items()}
    with _environment({**ALWAYS, **given, **_without_proxy()}):
        address = os.environ.get("PREFECT_API_URL")
        if address:
            _require_answer(address)
            yield lambda: None
            return
        with (
            tempfile.TemporaryDirectory(prefix=RUN_HOME) as home,
            _environment({"PREFECT_HOME": home}),
            _environment(one_authority(Path(home)) if is_local else {}),
            _environment({CLIENT_LOGIN: new_login()}),
            _embedded_server(Path(home)) as (address, wait_until_ready),
            _environment({"PREFECT_API_URL": address}),
        ):
            yield wait_until_ready


@contextmanager
def _environment(values: Mapping[str, str]) -> Iterator[None]:
    before = {name: os.environ.get(name) for name in values}
    os.environ.update(values)
    try:
        yield
    finally:
        for name, value in before.items():
            if value is None:
                os.environ.pop(name, None)
            else:
                os.environ[name] = value


@contextmanager
def _embedded_server(home: Path) -> Iterator[tuple[str, Callable[[], None]]]:
    is_first, log = begin_database(home), home / "server.log"
    with socket.create_server(("127.0.0.1", 0)) as listening, log.open("wb") as output:
        address = f"http://127.0.0.1:{listening.getsockname()[1]}/api"
        # The server ends when its standard input closes, so a killed run leaves none behind. It
        # inherits a socket rather than a port, which another process could take in between.
        server = subprocess.Popen(
            [
                sys.executable,
                "-m",
                "flows.orchestration.prefect_server",
                "--socket",
                str(listening.fileno()),
            ],
            stdin=subprocess.PIPE,
            stdout=output,
            stderr=subprocess.STDOUT,
            pass_fds=[listening.fileno()],
            env={
                **EMBEDDED,
                **without_secrets(os.environ, keep=DATABASE),
                SERVER_LOGIN: os.environ[CLIENT_LOGIN],
                "PREFECT_SERVER_CORS_ALLOWED_ORIGINS": address.removesuffix("/api"),
            },
            start_new_session=True,  # Ctrl-C is for the run, which then ends its server
        )

    def wait_until_ready() -> None:
        _wait_until_healthy(server, address, log)
        if is_first:
            keep_database(home)

    try:
        yield address, wait_until_ready
    finally:
        server.kill()
        server.communicate()


def _wait_until_healthy(server: subprocess.Popen[bytes], address: str, log: Path) -> None:
    """Return when the embedded server answers."""
    deadline = time.monotonic() + START_SECONDS
    while server.poll() is None and time.monotonic() < deadline:
        if not problem_at(f"{address}/health"):
            return
        time.sleep(0.1)
    said = log.read_text(errors="replace")[-2000:]
    raise WorldposeError(f"Prefect's embedded server did not start. It said:\n{said}")


def _require_answer(address: str) -> None:
    if problem_at(f"{address}/health"):
        raise InputError(
            f"PREFECT_API_URL={address}",
            expected="a running Prefect server",
            found="no answer",
            todo="Start the server, or unset PREFECT_API_URL to run without one.",
        )
    require_login(address)


def require_login(address: str) -> None:
    """Raise InputError if a Prefect server requires another login than this process has."""
    login, key = os.environ.get(CLIENT_LOGIN), os.environ.get(CLOUD_LOGIN)
    headers = {"authorization": f"Bearer {key}"} if key else {}
    if login:
        headers = {"authorization": authorization(login)}
    request = urllib.request.Request(f"{address}/admin/version", headers=headers)
    try:
        urllib.request.build_opener().open(request, timeout=5).close()
    except urllib.error.HTTPError as error:
        if error.code in (401, 403):
            raise InputError(
                CLIENT_LOGIN,
                expected=f"the login of the Prefect server at {address}",
                found="another" if headers else "none",
                todo=f"Set it to the value of {SERVER_LOGIN} at that server.",
            ) from None
    except (OSError, ValueError):
        return  # the next request reports why it does not answer


def problem_at(address: str, certificate: str | None = None) -> str:
    """Return why a server does not answer with 200 within seconds; empty if it does.

    Proxies are only asked about other machines. `certificate` is the file of that server's own
    certificate, which can be self-signed, and for another name than that of `address`.
    """
    is_here = urlsplit(address).hostname in LOOPBACK_NAMES
    handlers: list[urllib.request.BaseHandler] = [urllib.request.ProxyHandler({})] * is_here
    if certificate is not None:
        try:
            trust = ssl.create_default_context(cafile=certificate)
        except OSError as error:
            return f"its certificate {certificate} cannot be read: {error}"
        trust.check_hostname = False
        trust.verify_flags |= ssl.VERIFY_X509_PARTIAL_CHAIN
        handlers.append(urllib.request.HTTPSHandler(context=trust))
    try:
        opener = urllib.request.build_opener(*handlers)
        with opener.open(address, timeout=5) as answer:
            return "" if answer.status == 200 else f"{address} answers {answer.status}"
    except urllib.error.HTTPError as error:
        return f"{address} answers {error.code}"
    except (OSError, ValueError) as error:
        return f"{address} does not answer: {getattr(error, 'reason', error)}"


def begin_database(home: Path) -> bool:
    """Copy an empty database to `home`, PREFECT_HOME of a server that will be started.

    Prefect creates one with a hundred migrations, which takes as long as the rest of its start. The
    first one of a version is kept in the user's cache. Its files are for this account alone: SQLite
    gives the rights of the database to its log. Return whether the server must create the first one
    of its version there, to be kept then; StoreError if `home` is not writable.
    """
    # Imported here and below: with them, the server's process would import numba and scipy.
    from worldpose.formats.files import whole_file
    from worldpose.store.blobs import storage_errors

    kept, database = kept_database(), home / DATABASE_FILE
    if database.exists() and database.stat().st_size:
        for file in home.glob(f"{DATABASE_FILE}*"):
            file.chmod(0o600)
        return False
    with storage_errors(str(database)):
        home.mkdir(parents=True, exist_ok=True)
        if kept is None or not os.access(kept, os.R_OK):
            database.touch(0o600)
            return True
        with whole_file(database) as draft:
            draft.touch(0o600)
            try:
                shutil.copyfile(kept, draft)
            except OSError as error:  # a copy error names the source file first, whichever failed
                raise OSError(error.errno, error.strerror) from error
    return False


def keep_database(home: Path) -> None:
    """Keep a copy of the unused database that a server has created in `home`."""
    from worldpose.formats.files import whole_file

    kept, database = kept_database(), home / DATABASE_FILE
    if kept is None or not database.exists() or not database.stat().st_size:
        return  # no home, or the environment names another database
    # If the cache is not writable, every project creates its own.
    with (
        suppress(OSError, sqlite3.Error),
        whole_file(kept) as draft,
        closing(sqlite3.connect(database)) as made,
        closing(sqlite3.connect(draft)) as copy,
    ):
        made.backup(copy)


def kept_database() -> Path | None:
    """Return the path of the kept empty database of this Prefect version; None without a home."""
    cache = user_cache()
    return None if cache is None else cache / "worldpose" / f"prefect-{version('prefect')}.db"
