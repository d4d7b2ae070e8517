"""Spoils a Dask worker that loads this file as its preload, as WORLDPOSE_TEST_SPOIL says.

`hang UNIT`, `die UNIT`: whenever that unit is begun. `half`: results are published manifest first,
and slowly. `own`: each process computes bytes of its own. The latter two are what the checks of a
store are there to find.
"""

import os
import signal
import time

import numpy as np

from worldpose.store.blobs import LocalBlobs
from worldpose.store.store import Store
from worldpose.store.writer import ResultWriter


def strike_at(name, strike):
    publish = Store.publish

    def spoiled(self, work):
        if work.recipe.name == name:
            strike()
        return publish(self, work)

    Store.publish = spoiled


def publish_half(self, folder, prefix, manifest_name, manifest):
    """Manifest first: killed in between, it leaves a result that can be read and is not whole."""
    target = self.root / prefix
    if (target / manifest_name).exists():
        return False
    target.mkdir(parents=True, exist_ok=True)
    (target / manifest_name).write_bytes(manifest)
    for path in sorted(folder.rglob("*")):
        if path.is_file():
            time.sleep(0.3)
            place = target / path.relative_to(folder)
            place.parent.mkdir(parents=True, exist_ok=True)
            place.write_bytes(path.read_bytes())
    return True


def write_own(write):
    def spoiled(self, layout, arrays, coordinates=None, attributes=None):
        spoilt = {name: np.array(values) for name, values in arrays.items()}
        for values in spoilt.values():
            if values.dtype.kind == "f" and values.size:
                values.flat[0] += 1e-9 * os.getpid()
        return write(self, layout, spoilt, coordinates, attributes)

    return spoiled


def spoil(how):
    kind, _, unit = how.partition(" ")
    if kind == "hang":
        strike_at(unit, lambda: time.sleep(1e6))
    elif kind == "die":
        strike_at(unit, lambda: os.kill(os.getpid(), signal.SIGKILL))
    elif kind == "half":
        LocalBlobs.publish_tree = publish_half
    elif kind == "own":
        ResultWriter.write = write_own(ResultWriter.write)
    else:
        raise ValueError(how)


def dask_setup(worker):
    spoil(os.environ["WORLDPOSE_TEST_SPOIL"])
