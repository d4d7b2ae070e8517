"""The command line as tests run it: a process of its own, and what it said.

A command is a fork of a process that has imported its modules, see `warm_process.py`, and a run
computes on a standing Dask worker of the fixture `server`. Where a test gives an environment, a
program or a number of workers, and where no Prefect server is shared, the command is a new process
with all its own machines, as users start it.
"""

import json
import os
import subprocess
import sys
import tempfile
from dataclasses import dataclass
from pathlib import Path

from warm_process import WarmProcess

TINY = "tiny-3-1.2s"
"""Id of the match that the fixture `tiny` makes."""

WORLDPOSE = [sys.executable, "-c", "from flows.cli import main; main()"]
MACHINES = {"--dask", "--workers", "--help"}
"""Options of commands that bring their own machines, or need none."""
COMPUTING = {"run", "reprocess", "evaluate", "finetune", "serve"}

TAKEN_OVER = (
    *("WORLDPOSE_", "PREFECT_", "DASK_", "OTEL_", "OPENLINEAGE_"),
    *("HOME", "XDG_", "HF_", "SSL_", "PATH", "PYTHON"),
)
"""Beginnings of the variables that a worker's results or access depend on."""

shared = {}
"""`dask`, the address of the shared scheduler, and the `surroundings` in which it was started."""
warm = WarmProcess()


@dataclass(frozen=True)
class Answer:
    """Output of a command."""

    code: int
    out: str
    err: str

    @property
    def json(self):
        return json.loads(self.out)


def surroundings(arguments=()):
    """Environment that workers inherit from the process that starts them."""
    at_bucket = any(str(each).startswith("s3:") for each in arguments)
    taken = ("AWS_", *TAKEN_OVER) if at_bucket else TAKEN_OVER
    kept = {name: value for name, value in os.environ.items() if name.startswith(taken)}
    return {**kept, "folder": str(Path.cwd())}


def worldpose(*arguments, timeout=480, environment=None, program=None):
    """Runs the command line; runs get one worker, a core each."""
    alone = environment is not None or program is not None
    if arguments[0] in COMPUTING and not MACHINES & set(arguments):
        alone = alone or not shared or surroundings(arguments) != shared["surroundings"]
        if arguments[0] in ("run", "reprocess") and not alone:
            arguments += ("--dask", shared["dask"])
        elif arguments[0] == "run":
            arguments += ("--workers", 1)
    elif arguments[0] in COMPUTING:
        alone = True
    texts = list(map(str, arguments))
    if not alone and warm.is_used.acquire(blocking=False):
        try:
            return _run_warm(texts, timeout)
        finally:
            warm.is_used.release()
    done = subprocess.run(
        [*(program or WORLDPOSE), *texts],
        capture_output=True,
        text=True,
        timeout=timeout,
        env={**os.environ, **(environment or {})},
    )
    return Answer(done.returncode, done.stdout, done.stderr)


def _run_warm(arguments, timeout):
    with tempfile.NamedTemporaryFile() as out, tempfile.NamedTemporaryFile() as err:
        request = {
            "arguments": arguments,
            "environment": dict(os.environ),
            "folder": str(Path.cwd()),
            "out": out.name,
            "err": err.name,
        }
        code = warm.run(request, timeout)
        return Answer(code, *(Path(file.name).read_text() for file in (out, err)))


def invoke(*words, **keywords):
    """The command line in this process, which takes no seconds to start; Typer's result."""
    from typer.testing import CliRunner  # late: most tests need neither

    from flows.cli.app import app

    return CliRunner().invoke(app, list(map(str, words)), **keywords)


def succeed(*arguments, **keywords):
    """Runs the command line and expects exit code 0."""
    answer = worldpose(*arguments, **keywords)
    assert answer.code == 0, f"{answer.code}\n{answer.out}\n{answer.err}"
    return answer
