import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from worldpose.geometry.rigid import Rigid, align

# Corners of a box of 6 x 4 x 2 m: no two axes alike.
BOX = np.array([[x, y, z] for x in (-3.0, 3.0) for y in (-2.0, 2.0) for z in (-1.0, 1.0)])


def residuals(source, target, with_scale):
    return np.linalg.norm(
        align(source, target, with_scale=with_scale).apply(source) - target, axis=-1
    )


def test_a_single_point_is_shifted_and_nothing_else():
    motion = align([[1.0, 2.0, 3.0]], [[4.0, 4.0, 4.0]], with_scale=True)
    assert (motion.scale, motion.rotation.tolist()) == (1.0, np.eye(3).tolist())
    assert motion.translation.tolist() == [3.0, 2.0, 1.0]


def test_points_on_a_line_reach_their_targets():
    source = np.outer([0.0, 1.0, 3.0], [1.0, 0.0, 0.0])
    target = 2.0 * np.outer([0.0, 1.0, 3.0], [0.0, 0.6, 0.8]) + 5.0
    motion = align(source, target, with_scale=True)
    # Exact but for rounding of numbers near 10.
    assert motion.scale == pytest.approx(2.0, abs=1e-14)
    np.testing.assert_allclose(motion.apply(source), target, atol=1e-13)
    np.testing.assert_allclose(motion.rotation @ motion.rotation.T, np.eye(3), atol=1e-14)
    assert np.linalg.det(motion.rotation) > 0.0


def test_nothing_in_common_is_nan():
    missing = np.full((4, 3), np.nan)
    motion = align(missing, BOX[:4], with_scale=True)
    assert np.isnan(motion.scale)
    assert np.isnan(motion.apply(BOX)).all()
    assert np.isnan(align(np.empty((0, 3)), np.empty((0, 3)), with_scale=False).scale)


def test_a_mirrored_box_is_turned_onto_its_thinnest_side():
    # A mirror and half a turn make a mirror of any axis; that of the thinnest side costs least:
    # every corner has an error of twice its half of 1 m.
    for axis in range(3):
        mirrored = BOX * np.where(np.arange(3) == axis, -1.0, 1.0)
        np.testing.assert_allclose(residuals(mirrored, BOX, False), 2.0, atol=1e-12)
        # Umeyama's scale is (9 + 4 - 1) / (9 + 4 + 1) = 6/7: the error of the corner (3, 2, 1)
        # is (3/7, 2/7, 13/7).
        expected = np.sqrt(9.0 + 4.0 + 169.0) / 7.0
        np.testing.assert_allclose(residuals(mirrored, BOX, True), expected, atol=1e-12)


def test_missing_points_do_not_count():
    source = BOX + np.array([1.0, 2.0, 3.0])
    target = BOX.copy()
    source[0], target[1] = np.nan, np.nan
    source[2] += np.array([np.nan, 50.0, 0.0])
    motion = align(source, target, with_scale=True)
    np.testing.assert_allclose(motion.translation, [-1.0, -2.0, -3.0], atol=1e-12)


def numbers(low, high):
    return st.tuples(*[st.floats(low, high)] * 3)


@given(turn=numbers(-2.0, 2.0), shift=numbers(-100.0, 100.0), scale=st.floats(0.1, 10.0))
def test_a_known_similarity_is_found(turn, shift, scale):
    rotation = Rigid.from_rotvec(turn, shift).rotation
    target = scale * BOX @ rotation.T + shift
    motion = align(BOX, target, with_scale=True)
    # Rounding of coordinates up to 140 m against a box of metres.
    np.testing.assert_allclose(motion.rotation, rotation, atol=1e-11)
    np.testing.assert_allclose(motion.apply(BOX), target, atol=1e-11)
    rigid = align(BOX, target, with_scale=False)
    np.testing.assert_allclose(rigid.rotation, rotation, atol=1e-11)
    expected = abs(scale - 1.0) * np.linalg.norm(BOX, axis=-1)
    np.testing.assert_allclose(
        np.linalg.norm(rigid.apply(BOX) - target, axis=-1), expected, atol=1e-11
    )
