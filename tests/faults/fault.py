"""Kills the process at a named commit point, once.

A Dask worker loads this file as its preload; `python tests/faults/fault.py ARGS` runs the command
line with it. WORLDPOSE_TEST_FAULT holds the plan as JSON: the point, how many of its visits in
a process to skip, whether the whole process group dies, and a file that is made when the fault has
struck, so that it strikes once over all processes.
"""

import json
import os
import signal
import sys
from pathlib import Path

from worldpose.store.blobs import install_fault_hook


def install():
    plan = json.loads(os.environ["WORLDPOSE_TEST_FAULT"])
    struck = Path(plan["struck"])
    visits = 0

    def strike(point):
        nonlocal visits
        if point != plan["point"]:
            return
        visits += 1
        if visits <= plan.get("skip", 0):
            return
        try:
            struck.touch(exist_ok=False)
        except FileExistsError:
            return
        if plan.get("whole_group"):
            os.killpg(0, signal.SIGKILL)
        os.kill(os.getpid(), signal.SIGKILL)

    install_fault_hook(strike)


def dask_setup(worker):
    install()


if __name__ == "__main__":
    from flows.cli import main

    install()
    sys.argv = ["worldpose", *sys.argv[1:]]
    main()
