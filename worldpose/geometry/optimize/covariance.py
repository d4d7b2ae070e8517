"""Covariance and information of parameters whose units differ by many powers of ten."""

from __future__ import annotations

import numpy as np

from data_contracts.arrays import Flags, Floats


def invert_free(matrix: Floats, free: Flags) -> Floats:
    """Return the inverse of the free rows and columns of a symmetric matrix, 0 elsewhere.

    The free parameters are scaled to a diagonal of 1 first.

    Args:
        matrix: (n, n), positive definite in the free parameters.
        free: (n,) mask of the free parameters.

    Raises:
        numpy.linalg.LinAlgError: the free part is singular.
    """
    block = np.ix_(free, free)
    size = np.sqrt(np.diag(matrix)[free])
    scale = np.outer(size, size)
    inverse = np.zeros_like(matrix)
    inverse[block] = np.linalg.inv(matrix[block] / scale) / scale
    return 0.5 * (inverse + inverse.T)
