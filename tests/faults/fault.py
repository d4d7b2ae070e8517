"""Kills or blocks a process where a test says so.

A Dask worker loads this file as its preload. WORLDPOSE_TEST_FAULT holds the plan as JSON. With
`point`, the process dies at this commit point, once over all processes: `skip` visits of each
process before, and `struck` is a file that is made then. With `unit`, the process hangs or dies, as
`how` says, whenever that unit is begun.
"""

import json
import os
import signal
import time
from pathlib import Path

from worldpose.store.blobs import install_fault_hook
from worldpose.store.store import Store


def install():
    plan = json.loads(os.environ["WORLDPOSE_TEST_FAULT"])
    if "unit" in plan:
        spoil_unit(plan)
        return
    visits = []

    def strike(point):
        visits.append(point)
        if point != plan["point"] or visits.count(point) <= plan.get("skip", 0):
            return
        try:
            Path(plan["struck"]).touch(exist_ok=False)
        except FileExistsError:
            return
        os.kill(os.getpid(), signal.SIGKILL)

    install_fault_hook(strike)


def spoil_unit(plan):
    publish = Store.publish

    def spoiled(self, work):
        if work.recipe.name == plan["unit"]:
            if plan["how"] == "die":
                os.kill(os.getpid(), signal.SIGKILL)
            time.sleep(1e6)
        return publish(self, work)

    Store.publish = spoiled


def dask_setup(worker):
    install()
