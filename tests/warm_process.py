"""A process that has imported what commands need, and becomes one command after another.

    python tests/warm_process.py < REQUESTS > ANSWERS

An import takes most commands longer than their work. For each request, a line of JSON, this process
forks; the child takes over arguments, environment, folder and output files, and runs the command
line as if it had been started with them. The answers are its process id, and then its exit code.
"""

import atexit
import gc
import importlib
import json
import os
import signal
import subprocess
import sys
import threading
from select import select

STAGES = ("ingest", "static_calibration", "tracking", "triangulation", "body_fitting", "filtering")
"""Some of the stages, which import most of the others' modules."""
MODULES = (
    *("flows.match", "prefect_dask", "flows.iterate", "flows.cli.app", "zarr", "xarray"),
    *(f"tasks.{stage}" for stage in STAGES),
)
"""Not `flows.cli.console`, which looks at the terminal while it is imported."""


class WarmProcess:
    """The process, as tests see it."""

    def __init__(self):
        self.process = None
        self.is_used = threading.Lock()

    def run(self, request, timeout):
        """Run a command and return its exit code."""
        if self.process is None or self.process.poll() is not None:
            self.process = subprocess.Popen(
                [sys.executable, __file__],
                stdin=subprocess.PIPE,
                stdout=subprocess.PIPE,
                bufsize=0,
                env={**os.environ, "DO_NOT_TRACK": "1"},
            )
            atexit.register(self.process.communicate)  # which closes its input
        self.process.stdin.write(json.dumps(request).encode() + b"\n")
        pid = int(self.process.stdout.readline())
        if not select([self.process.stdout], [], [], timeout)[0]:
            os.kill(pid, signal.SIGKILL)
            self.process.stdout.readline()
            raise subprocess.TimeoutExpired(request["arguments"], timeout)
        return int(self.process.stdout.readline())


def take_over(request):
    """Become the requested process."""
    for number, name, flags in (
        (0, os.devnull, os.O_RDONLY),
        (1, request["out"], os.O_WRONLY),
        (2, request["err"], os.O_WRONLY),
    ):
        file = os.open(name, flags)
        os.dup2(file, number)
        os.close(file)
    os.environ.clear()
    os.environ.update(request["environment"])
    os.chdir(request["folder"])
    sys.argv = ["worldpose", *request["arguments"]]
    # Prefect reads the environment when it is imported.
    importlib.import_module("prefect.context").refresh_global_settings_context()


def main():
    gc.disable()
    for name in MODULES:
        importlib.import_module(name)
    gc.freeze()
    gc.enable()
    answers = os.dup(1)  # not inherited by programs
    os.dup2(2, 1)
    while line := sys.stdin.buffer.readline():
        pid = os.fork()
        if pid == 0:
            os.close(answers)
            take_over(json.loads(line))
            importlib.import_module("flows.cli").main()
            return
        os.write(answers, f"{pid}\n".encode())
        _, status = os.waitpid(pid, 0)
        os.write(answers, f"{os.waitstatus_to_exitcode(status)}\n".encode())


if __name__ == "__main__":
    main()
