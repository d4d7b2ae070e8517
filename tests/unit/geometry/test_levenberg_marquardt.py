"""Numerical tools: Levenberg-Marquardt, banded systems, and rasters."""

from dataclasses import dataclass

import numpy as np
import pytest

from worldpose.body_fitting.poses import factor
from worldpose.body_fitting.residuals import UNKNOWNS
from worldpose.errors import DegenerateError
from worldpose.geometry.boxes import box_areas, box_iou
from worldpose.geometry.optimize.arrow import ArrowFactor, ArrowSystem
from worldpose.geometry.optimize.banded import BandedFactor
from worldpose.geometry.optimize.covariance import invert_free
from worldpose.geometry.optimize.levenberg_marquardt import Damping, minimize
from worldpose.geometry.rasters import Samples, Surface, cover_triangles, draw_triangles, resolve


@dataclass(frozen=True)
class Point:
    x: np.ndarray
    cost: float


def find_minimum(state, step, iterations=200, **course):
    course = Damping(**{"start": 1e-3, "decrease": 5.0, "lowest": 1e-12, **course})

    def settled(before, after):
        return abs(before.cost - after.cost) <= 1e-14 * before.cost

    return minimize(state, step, course, iterations, settled)


def dense(residuals, jacobian):
    """Return the start of a dense problem, and its damped step."""

    def at(x):
        return Point(x, float((residuals(x) ** 2).sum()))

    def step(point, damping):
        j, r = jacobian(point.x), residuals(point.x)
        normal = j.T @ j
        normal = normal + damping * np.diag(np.diag(normal))
        return at(point.x - np.linalg.lstsq(normal, j.T @ r, rcond=None)[0])

    return at, step


def test_the_minimum_of_rosenbrocks_function_is_at_one_one():
    at, step = dense(
        lambda x: np.array([10.0 * (x[1] - x[0] ** 2), 1.0 - x[0]]),
        lambda x: np.array([[-20.0 * x[0], 10.0], [-1.0, 0.0]]),
    )
    found = find_minimum(at(np.array([-1.2, 1.0])), step)
    np.testing.assert_allclose(found.state.x, [1.0, 1.0], atol=1e-9)
    assert all(
        later < earlier for earlier, later in zip(found.costs, found.costs[1:], strict=False)
    )


def test_a_singular_problem_moves_along_what_its_residuals_determine():
    # Only x + y = 2 is observed.
    at, step = dense(lambda x: np.array([x[0] + x[1] - 2.0]), lambda x: np.array([[1.0, 1.0]]))
    found = find_minimum(at(np.array([3.0, 1.0])), step)
    assert found.state.x.sum() == pytest.approx(2.0, abs=1e-9)
    assert np.isfinite(found.state.x).all()


@pytest.mark.parametrize("cost", [np.inf, np.nan, 5.0])
def test_a_step_that_is_not_better_is_damped_up_to_the_limit(cost):
    asked = []

    def step(point, damping):
        asked.append(damping)
        return Point(point.x + 1.0, cost)

    start = Point(np.zeros(1), 4.0)
    found = find_minimum(start, step, start=1.0, highest=100.0)
    assert found.state is start and not found.converged and found.costs == (4.0,)
    # The next, 512, is beyond the limit.
    assert asked == [1.0, 8.0, 64.0] and found.iterations == 3


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


FACES = np.array([[0, 1, 2], [0, 2, 3]], dtype=np.int32)
"""Of a rectangle whose corners go down first, as a camera has what faces it."""


def rectangle(left, top, right, bottom, depth=10.0):
    corners = [(left, top), (left, bottom), (right, bottom), (right, top)]
    return np.column_stack([corners, np.broadcast_to(depth, 4)]).astype(np.float32)


def test_a_mask_has_the_pixels_whose_middles_are_covered_whichever_way_triangles_face():
    for faces in (FACES, np.ascontiguousarray(FACES[:, ::-1])):
        mask = np.zeros((5, 5), dtype=np.uint8)
        mask[2, 2] = 1
        cover_triangles(rectangle(0.8, 1.8, 3.2, 3.2), faces, 2, mask)
        expected = np.zeros((5, 5))
        expected[2:4, 1:4] = 2
        expected[2, 2] = 3
        np.testing.assert_array_equal(mask, expected)


def test_half_a_pixel_has_half_its_samples_and_mixes_with_what_is_behind():
    samples, still = Samples.empty(0, 0, 3, 3), rectangle(1.0, 0.5, 1.5, 1.5)
    surface = Surface(
        faces=FACES,
        backs=np.zeros(2, dtype=bool),
        texels=np.zeros((4, 2), dtype=np.float32),
        textures=np.full((2, 1, 1, 3), 200, dtype=np.uint8),
        opened=still,
        closed=still,
        light=np.ones(4, dtype=np.float32),
    )
    # Across, samples lie 0.125 and 0.375 px to both sides of the middle.
    assert draw_triangles(surface, np.zeros(4, dtype=np.float32), 0, samples) == 2
    picture = np.full((3, 3, 3), 100, dtype=np.uint8)
    persons, seen = np.full((3, 3), -1, dtype=np.int16), np.zeros(1, dtype=np.int64)
    resolve(samples.who, samples.color, picture, persons, seen)
    expected = np.full((3, 3), 100)
    expected[1, 1] = 150
    np.testing.assert_array_equal(picture[..., 0], expected)
    assert (seen.tolist(), np.flatnonzero(persons == 0).tolist()) == ([2], [4])


def test_intersection_over_union_of_every_pair():
    # Two squares of 4 that share 2: 2 of 6.
    found = box_iou(np.array([[0.0, 0, 2, 2]]), np.array([[1.0, 0, 3, 2], [5, 5, 6, 6]]))
    np.testing.assert_allclose(found, [[1 / 3, 0.0]])


def test_boxes_without_area_and_missing_boxes_share_nothing():
    flat, reversed_box = [1.0, 1, 1, 1], [2.0, 2, 0, 0]
    boxes = np.array([flat, reversed_box, [np.nan] * 4, [0.0, 0, 2, 2]])
    assert box_iou(boxes, boxes).tolist() == np.diag([0.0, 0, 0, 1]).tolist()
    assert box_areas(boxes[[0, 1, 3]]).tolist() == [0.0, 0.0, 4.0]
