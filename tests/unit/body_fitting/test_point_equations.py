"""Sums over points are those of whole matrices, though most of their numbers are left out."""

import numpy as np
import pytest

from worldpose.body_fitting.point_equations import accumulate_points, invert_symmetric, propagate

POINTS, SIZE = 5, 36


def moving_points(frames, rng):
    """Derivatives of points that move with the first unknowns and a few of the others."""
    rows = rng.normal(size=(frames, POINTS, 3, SIZE))
    moves = rng.random((POINTS, SIZE)) < 0.3
    moves[:, :3] = True
    rows *= moves[:, None]
    # By chance a point does not move with an unknown in one frame.
    rows[0, 0, :, 1] = 0.0
    return rows


def spreads(frames, rng):
    roots = rng.normal(size=(frames, POINTS, 3, 3))
    return roots @ roots.swapaxes(-1, -2) + np.eye(3)


@pytest.mark.parametrize("frames", [1, 7])
def test_blocks_and_gradient_are_those_of_whole_products(frames):
    rng = np.random.default_rng(frames)
    rows, own, force = (
        moving_points(frames, rng),
        spreads(frames, rng),
        rng.normal(size=(frames, POINTS, 3)),
    )
    one, two = rng.normal(size=(2, frames, POINTS))
    one[-1] = two[-2:] = 0.0
    one[0, 1] = two[0, 2] = 0.0
    blocks, gradient = accumulate_points(rows, own, one, two, force)
    np.testing.assert_allclose(gradient, np.einsum("tpai,tpa->ti", rows, force), atol=1e-12)
    whole = np.einsum("tpai,tpab,tpbj->tij", rows, own, rows)
    np.testing.assert_allclose(np.tril(blocks[0]), np.tril(whole), atol=1e-11)
    for ahead, weight in ((1, one), (2, two)):
        expected = np.zeros((frames, SIZE, SIZE))
        for t in range(frames - ahead):
            expected[t] = np.einsum("p,pai,paj->ij", weight[t], rows[t + ahead], rows[t])
        np.testing.assert_allclose(blocks[ahead], expected, atol=1e-12)


def test_covariances_and_inverses_are_those_of_whole_matrices():
    rng = np.random.default_rng(0)
    rows = moving_points(4, rng)
    roots = rng.normal(size=(4, SIZE, SIZE))
    covariance = roots @ roots.swapaxes(-1, -2)
    expected = np.einsum("tpai,tij,tpbj->tpab", rows, covariance, rows)
    np.testing.assert_allclose(propagate(rows, covariance), expected, rtol=1e-10, atol=1e-10)
    matrices = spreads(4, rng)
    np.testing.assert_allclose(invert_symmetric(matrices), np.linalg.inv(matrices), rtol=1e-9)
