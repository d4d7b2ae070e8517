"""The command line as tests run it: a process of its own, and what it said."""

import json
import os
import subprocess
import sys
from dataclasses import dataclass

TINY = "tiny-3-1.2s"
"""Id of the match that the fixture `tiny` makes."""

WORLDPOSE = [sys.executable, "-c", "from flows.cli import main; main()"]


@dataclass(frozen=True)
class Answer:
    """Output of a command."""

    code: int
    out: str
    err: str

    @property
    def json(self):
        return json.loads(self.out)


def worldpose(*arguments, timeout=480, environment=None, program=WORLDPOSE):
    """Runs the command line in a process of its own; runs get one worker, a core each."""
    if arguments[0] == "run" and not {"--dask", "--workers", "--help"} & set(arguments):
        arguments += ("--workers", 1)
    done = subprocess.run(
        [*program, *map(str, arguments)],
        capture_output=True,
        text=True,
        timeout=timeout,
        env={**os.environ, **(environment or {})},
    )
    return Answer(done.returncode, done.stdout, done.stderr)


def succeed(*arguments, **keywords):
    """Runs the command line and expects exit code 0."""
    answer = worldpose(*arguments, **keywords)
    assert answer.code == 0, f"{answer.code}\n{answer.out}\n{answer.err}"
    return answer
