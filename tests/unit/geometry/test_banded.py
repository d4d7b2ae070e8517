"""The block-banded solver against dense linear algebra."""

import numpy as np
import pytest

from worldpose.body_fitting.poses import factor
from worldpose.body_fitting.residuals import UNKNOWNS
from worldpose.errors import DegenerateError
from worldpose.geometry.optimize.arrow import ArrowFactor, ArrowSystem
from worldpose.geometry.optimize.banded import BandedFactor
from worldpose.geometry.optimize.covariance import invert_free


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


def arrow(frames=5, size=3, shared=4, seed=0):
    """A system, its dense matrix, and the dense gradient."""
    rng = np.random.default_rng(seed)
    system = ArrowSystem.zeros(frames, size, shared)
    count = frames * size
    dense = np.zeros((count + shared, count + shared))
    for t in range(frames):
        for back in range(min(3, frames - t)):
            block = rng.standard_normal((size, size))
            if back == 0:
                block = block + block.T + 30.0 * np.eye(size)
            system.blocks[back, t] = block
            rows = slice((t + back) * size, (t + back + 1) * size)
            columns = slice(t * size, (t + 1) * size)
            dense[rows, columns], dense[columns, rows] = block, block.T
    system.border[:] = rng.standard_normal(system.border.shape)
    corner = rng.standard_normal((shared, shared))
    system.corner[:] = corner @ corner.T + 30.0 * np.eye(shared)
    dense[:count, count:] = system.border.reshape(count, shared)
    dense[count:, :count] = dense[:count, count:].T
    dense[count:, count:] = system.corner
    return system, dense


@pytest.mark.parametrize("damping", [0.0, 0.3])
def test_the_solution_is_that_of_the_dense_matrix(damping):
    system, dense = arrow()
    rng = np.random.default_rng(1)
    own, corner = rng.standard_normal((5, 3, 2)), rng.standard_normal((4, 2))
    frames, shared = ArrowFactor.of(system, damping).solve(own, corner)
    dense[np.diag_indices_from(dense)] *= 1.0 + damping
    expected = np.linalg.solve(dense, np.concatenate([own.reshape(-1, 2), corner]))
    np.testing.assert_allclose(frames.reshape(-1, 2), expected[:-4], atol=1e-13)
    np.testing.assert_allclose(shared, expected[-4:], atol=1e-13)


def test_covariances_are_blocks_of_the_dense_inverse():
    system, dense = arrow()
    inverse = np.linalg.inv(dense)
    factor = ArrowFactor.of(system)
    assert factor.determined
    shared = factor.shared_covariance()
    np.testing.assert_allclose(shared, inverse[-4:, -4:], atol=1e-14)
    blocks = inverse[:-4, :-4].reshape(5, 3, 5, 3)[range(5), :, range(5)]
    np.testing.assert_allclose(factor.frame_covariance(shared), blocks, atol=1e-14)


def test_free_parameters_of_different_units_are_inverted():
    units = np.array([1e-6, 1.0, 1e6])
    matrix = np.array([[2.0, 0.5, 0.0], [0.5, 1.0, 0.0], [0.0, 0.0, 1.0]]) * np.outer(units, units)
    found = invert_free(matrix, np.array([True, True, False]))
    expected = np.array([[1.0, -0.5], [-0.5, 2.0]]) / 1.75 / np.outer(units, units)[:2, :2]
    np.testing.assert_allclose(found[:2, :2], expected, rtol=1e-14)
    assert not found[2].any() and not found[:, 2].any()
