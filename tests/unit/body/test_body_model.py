from dataclasses import replace

import numpy as np
import pytest

from worldpose.body.model import BodyParameters
from worldpose.errors import InputError
from worldpose.geometry.rigid import Rigid

# The file is in single precision, and the regressors' rows sum to 1 only that well.
SINGLE = 1e-6
# Double precision at tens of metres.
ROUNDING = 1e-12


def test_orientation_turns_about_the_pelvis_and_translation_comes_after(open_body):
    turned = replace(
        BodyParameters.rest(), global_orient=np.array([0.3, -1.0, 2.0]), transl=np.array([9, 8, 7])
    )
    pelvis = open_body.joint_template[0]
    joints = open_body.joints(turned)
    np.testing.assert_allclose(joints[0], pelvis + turned.transl, atol=ROUNDING)
    rotation = Rigid.from_rotvec(turned.global_orient, np.zeros(3)).rotation
    expected = (open_body.joint_template - pelvis) @ rotation.T + pelvis + turned.transl
    np.testing.assert_allclose(joints, expected, atol=ROUNDING)
    expected = (open_body.template - pelvis) @ rotation.T + pelvis + turned.transl
    np.testing.assert_allclose(open_body.vertices(turned), expected, atol=SINGLE)


def test_a_person_with_missing_parameters_is_nan_and_the_others_are_not(open_body, people):
    pose = people.body_pose.copy()
    pose[2] = np.nan
    joints = open_body.joints(replace(people, body_pose=pose))
    vertices = open_body.vertices(replace(people, body_pose=pose))
    assert np.isnan(joints[2, 1:]).any()
    assert np.isnan(vertices[2]).all()
    assert np.isfinite(np.delete(joints, 2, axis=0)).all()
    assert np.isfinite(np.delete(vertices, 2, axis=0)).all()


@pytest.mark.parametrize(
    ("name", "array", "expected"),
    [
        ("body_pose", np.zeros(72), "shape (..., 69)"),
        ("transl", np.zeros((4, 2)), "shape (..., 3)"),
    ],
)
def test_parameters_of_a_wrong_shape_are_refused(name, array, expected):
    with pytest.raises(InputError, match=f"BodyParameters.{name}") as refused:
        replace(BodyParameters.rest(), **{name: array})
    assert refused.value.expected == expected


@pytest.mark.parametrize(
    ("name", "change"),
    [
        ("template", lambda array: array[:100]),
        ("template", lambda array: array * np.nan),
        ("joint_regressor", lambda array: 2.0 * array),
        ("weights", lambda array: 0.0 * array),
        ("parents", lambda array: array[::-1]),
        ("faces", lambda array: array + 6000),
    ],
)
def test_arrays_that_are_no_body_are_refused(open_body, name, change):
    with pytest.raises(InputError, match="body model open-neutral/2"):
        replace(open_body, **{name: change(getattr(open_body, name))})
