"""Spoils a Dask worker that loads this file as its preload, as WORLDPOSE_TEST_SPOIL says.

`hang UNIT`, `die UNIT`: whenever that unit is begun.
"""

import os
import signal
import time

from worldpose.store.store import Store


def dask_setup(worker):
    kind, unit = os.environ["WORLDPOSE_TEST_SPOIL"].split()
    publish = Store.publish

    def spoiled(self, work):
        if work.recipe.name == unit and kind == "hang":
            time.sleep(1e6)
        elif work.recipe.name == unit:
            os.kill(os.getpid(), signal.SIGKILL)
        return publish(self, work)

    Store.publish = spoiled
