"""Solution of small dense normal equations inside compiled kernels."""

from __future__ import annotations

from data_contracts.arrays import Floats
from worldpose.compiled import compile_kernel


@compile_kernel
def solve_in_place(normal: Floats, right: Floats, min_pivot: float) -> float:
    """Replace `right` (n,) by the solution; return the last unknown's information, 0 if singular.

    `normal` (n, n) is positive definite; its lower half is overwritten by the factor L D L^T. Up to
    a pivot of `min_pivot` it counts as singular, and `right` is part of the way to the solution.
    """
    size = len(right)
    for a in range(size):
        for b in range(a):
            for c in range(b):
                normal[a, b] -= normal[a, c] * normal[b, c] * normal[c, c]
            normal[a, b] /= normal[b, b]
        for c in range(a):
            normal[a, a] -= normal[a, c] ** 2 * normal[c, c]
        if not normal[a, a] > min_pivot:
            return 0.0
        for b in range(a):
            right[a] -= normal[a, b] * right[b]
    for a in range(size - 1, -1, -1):
        right[a] /= normal[a, a]
        for b in range(a + 1, size):
            right[a] -= normal[b, a] * right[b]
    return float(normal[size - 1, size - 1])
