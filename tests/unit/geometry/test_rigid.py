"""Rigid motions, and alignments of known points."""

import cv2
import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from worldpose.errors import InputError
from worldpose.geometry.rigid import Rigid, align

# Matrix products of unit-size numbers: a few roundings of 1.1e-16 each.
ROUNDING = 1e-14

coordinates = st.floats(-100.0, 100.0)
vectors = st.tuples(coordinates, coordinates, coordinates).map(np.array)
angles = st.floats(-1.0, 1.0)
rotvecs = st.tuples(angles, angles, angles).map(np.array)


@given(rotvecs)
def test_rotation_vector_equals_opencv_and_comes_back(rotvec):
    transform = Rigid.from_rotvec(rotvec, np.zeros(3))
    np.testing.assert_allclose(transform.rotation, cv2.Rodrigues(rotvec)[0], atol=ROUNDING)
    # Angles stay below sqrt(3) < pi, where the vector is unique.
    np.testing.assert_allclose(transform.rotvec, rotvec, atol=ROUNDING)


@pytest.mark.parametrize("axis", [[0.0, -1.0, 0.0], [0.6, 0.0, 0.8]])
@pytest.mark.parametrize("below", [0.0, 1e-12, 1e-3])
def test_rotation_vector_survives_half_turns(axis, below):
    transform = Rigid.from_rotvec((np.pi - below) * np.array(axis), np.zeros(3))
    again = Rigid.from_rotvec(transform.rotvec, np.zeros(3))
    np.testing.assert_allclose(again.rotation, transform.rotation, atol=ROUNDING)
    # sin(angle / 2) comes out within rounding of 1, and its slope there is what limits the angle.
    np.testing.assert_allclose(np.linalg.norm(transform.rotvec), np.pi - below, atol=ROUNDING)


@pytest.mark.parametrize("size", [0.0, 1e-300, 1e-12, 1e-8, 1e-5])
def test_tiny_rotations_keep_their_digits(size):
    rotvec = size * np.array([1.0, -2.0, 3.0])
    found = Rigid.from_rotvec(rotvec, np.zeros(3)).rotvec
    # The matrix holds the sine itself, so the relative precision is that of float64.
    np.testing.assert_allclose(found, rotvec, rtol=ROUNDING, atol=0.0)


@given(rotvecs, vectors, vectors)
def test_tangent_update_has_the_documented_derivative(rotvec, translation, point):
    transform = Rigid.from_rotvec(rotvec, translation)
    x, y, z = transform.apply(point[None])[0]
    expected = np.hstack([[[0.0, z, -y], [-z, 0.0, x], [y, -x, 0.0]], np.eye(3)])
    h = 1e-6
    steps = h * np.eye(6)
    found = (
        transform.retract(steps).apply(point[None]) - transform.retract(-steps).apply(point[None])
    )[:, 0].T / (2.0 * h)
    # Central differences at 300 m: 300 h^2 / 6 from the third derivative, and rounding of
    # 300 * 1e-16 * a few / h.
    np.testing.assert_allclose(found, expected, atol=1e-6)


@pytest.mark.parametrize(
    ("make", "expected", "found"),
    [
        (lambda: Rigid(np.eye(4), np.zeros(3)), r"\(\.\.\., 3, 3\)", r"\(4, 4\)"),
        (lambda: Rigid(np.eye(3), np.zeros((3, 1))), r"\(\.\.\., 3\)", r"\(3, 1\)"),
        (lambda: Rigid(np.zeros((2, 3, 3)), np.zeros((4, 3))), "broadcast", r"\(2,\) and \(4,\)"),
        (lambda: Rigid.identity().apply(np.zeros(3)), r"\(\.\.\., n, 3\)", r"\(3,\)"),
        (lambda: Rigid.identity().retract(np.zeros(3)), r"\(\.\.\., 6\)", r"\(3,\)"),
        (lambda: Rigid.from_rotvec(np.eye(4), np.zeros(3)), r"\(\.\.\., 3\)", r"\(4, 4\)"),
    ],
)
def test_wrong_shapes_are_refused_with_both_shapes(make, expected, found):
    with pytest.raises(InputError, match=expected + ".*" + found):
        make()


@given(rotvecs, vectors, rotvecs, vectors, vectors)
def test_composition_inverse_and_application_agree(r1, t1, r2, t2, point):
    c_from_b, b_from_a = Rigid.from_rotvec(r1, t1), Rigid.from_rotvec(r2, t2)
    through = c_from_b.apply(b_from_a.apply(point[None]))
    # Coordinates reach 500 m: 500 times the unit rounding of a few products.
    np.testing.assert_allclose((c_from_b @ b_from_a).apply(point[None]), through, atol=1e-12)
    np.testing.assert_allclose(
        (c_from_b @ b_from_a).inverse().apply(through), point[None], atol=1e-12
    )


# Corners of a box of 6 x 4 x 2 m: no two axes alike.
BOX = np.array([[x, y, z] for x in (-3.0, 3.0) for y in (-2.0, 2.0) for z in (-1.0, 1.0)])


def test_a_mirrored_box_is_turned_onto_its_thinnest_side():
    # A mirror and half a turn make a mirror of any axis; that of the thinnest side costs least:
    # every corner has an error of twice its half of 1 m. Umeyama's scale is
    # (9 + 4 - 1) / (9 + 4 + 1) = 6/7: the error of the corner (3, 2, 1) is (3/7, 2/7, 13/7).
    for axis in range(3):
        mirrored = BOX * np.where(np.arange(3) == axis, -1.0, 1.0)
        for scaled, expected in ((False, 2.0), (True, np.sqrt(9.0 + 4.0 + 169.0) / 7.0)):
            found = align(mirrored, BOX, with_scale=scaled).apply(mirrored)
            np.testing.assert_allclose(np.linalg.norm(found - BOX, axis=-1), expected, atol=1e-12)


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
