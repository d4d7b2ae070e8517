"""The block-banded solver against dense linear algebra."""

import numpy as np
import pytest

from worldpose.body_fitting.poses import factor
from worldpose.body_fitting.residuals import UNKNOWNS
from worldpose.errors import DegenerateError
from worldpose.geometry.optimize.banded import BandedFactor


def banded(frames, size, rng):
    """Lower blocks of a random positive definite matrix, and that matrix."""
    blocks = rng.standard_normal((3, frames, size, size))
    dense = np.zeros((frames, size, frames, size))
    for back in range(3):
        for t in range(frames - back):
            dense[t + back, :, t] = blocks[back, t]
            dense[t, :, t + back] = blocks[back, t].T
        blocks[back, frames - back :] = 0.0
    for t in range(frames):
        # A heavy diagonal makes it positive definite.
        blocks[0, t] = blocks[0, t] + blocks[0, t].T + 12.0 * size * np.eye(size)
        dense[t, :, t] = blocks[0, t]
    return blocks, dense.reshape(frames * size, frames * size)


@pytest.mark.parametrize("frames", [1, 2, 3, 7])
def test_solutions_equal_those_of_the_dense_matrix(frames):
    rng = np.random.default_rng(frames)
    blocks, dense = banded(frames, 5, rng)
    right = rng.standard_normal((frames, 5, 2))
    factor = BandedFactor.of(blocks)
    assert factor.determined
    expected = np.linalg.solve(dense, right.reshape(-1, 2)).reshape(right.shape)
    # Well-conditioned: rounding alone.
    np.testing.assert_allclose(factor.solve(right), expected, atol=1e-13)


@pytest.mark.parametrize("frames", [1, 2, 6])
def test_diagonal_blocks_of_the_inverse_equal_the_dense_ones(frames):
    blocks, dense = banded(frames, 4, np.random.default_rng(9))
    inverse = np.linalg.inv(dense).reshape(frames, 4, frames, 4)
    expected = inverse[np.arange(frames), :, np.arange(frames)]
    np.testing.assert_allclose(BandedFactor.of(blocks).inverse_blocks(), expected, atol=1e-14)


def test_a_matrix_that_is_not_positive_definite_is_told():
    blocks, _ = banded(4, 3, np.random.default_rng(1))
    blocks[0, 2, 1, 1] = -1.0
    assert not BandedFactor.of(blocks).determined


def test_a_system_that_rounding_spoils_is_degenerate_and_no_error_of_ours():
    blocks = np.zeros((3, 2, UNKNOWNS, UNKNOWNS))
    blocks[0] = -1e300 * np.eye(UNKNOWNS)
    with pytest.raises(DegenerateError, match="settings of body_fitting"):
        factor(blocks)
