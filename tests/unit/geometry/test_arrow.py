"""Arrow systems and scaled inverses against dense linear algebra."""

import numpy as np
import pytest

from worldpose.geometry.optimize.arrow import ArrowFactor, ArrowSystem
from worldpose.geometry.optimize.covariance import invert_free


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
