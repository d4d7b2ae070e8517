"""Pickles like those of SMPL, with the classes that its authors used; no number is SMPL's."""

import pickle
import sys
from contextlib import contextmanager
from types import ModuleType

import numpy as np
import scipy.sparse


class Ch:
    """Stands for chumpy.ch.Ch: an array and the bookkeeping that it is pickled with."""

    def __init__(self, x):
        self.x = x
        self._dirty_vars = {"x"}
        self._itr = None
        self._depends_on_deps = {}


class Select:
    """Stands for chumpy.reordering.Select: elements picked out of an array."""

    def __init__(self, a, idxs, preferred_shape):
        self.a, self.idxs, self.preferred_shape = a, idxs, preferred_shape


for kind, module in ((Ch, "chumpy.ch"), (Select, "chumpy.reordering")):
    kind.__module__ = module


@contextmanager
def chumpy():
    """While it lasts, chumpy can be imported, as when SMPL's files were written."""
    modules = {name: ModuleType(name) for name in ("chumpy", "chumpy.ch", "chumpy.reordering")}
    modules["chumpy.ch"].Ch = Ch
    modules["chumpy.reordering"].Select = Select
    sys.modules.update(modules)
    try:
        yield
    finally:
        for name in modules:
            del sys.modules[name]


def pickled(content, protocol=2):
    with chumpy():
        return pickle.dumps(content, protocol=protocol)


def smpl_like(arrays):
    """Arrays under SMPL's keys as its files hold them: chumpy, sparse and plain."""
    shapedirs = arrays["shapedirs"].astype(np.float64)
    return {
        **arrays,
        "v_template": Select(
            Ch(arrays["v_template"].ravel()),
            np.arange(arrays["v_template"].size),
            arrays["v_template"].shape,
        ),
        "shapedirs": Ch(shapedirs),
        "J_regressor": scipy.sparse.csc_matrix(arrays["J_regressor"]),
        "J_regressor_prior": scipy.sparse.csc_matrix(arrays["J_regressor"]),
        "weights_prior": Ch(arrays["weights"]),
        "bs_type": "lrotmin",
        "bs_style": "lbs",
        "vert_sym_idxs": np.arange(3),
        "scale": np.float64(1.5),
    }
