from dataclasses import fields, replace

import numpy as np
import pytest

from worldpose.body.body_file import KEYS, find_body, load_body, read_npz_arrays, save_body
from worldpose.body.model import BodyParameters
from worldpose.errors import InputError, UsageError
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


def rewritten(path, body, **changes):
    """The body's file with some arrays changed or, where None, left out."""
    save_body(path, body)
    arrays = {**read_npz_arrays(path, (*KEYS, "name")), **changes}
    np.savez(path, **{key: array for key, array in arrays.items() if array is not None})
    return path


def test_a_saved_body_comes_back(tmp_path, corrected_body):
    save_body(tmp_path / "body.npz", corrected_body)
    back = load_body(tmp_path / "body.npz")
    assert back.name == corrected_body.name
    for field in fields(back)[1:]:
        # The fixture's numbers are in single precision, so nothing is lost.
        np.testing.assert_array_equal(
            getattr(back, field.name), getattr(corrected_body, field.name), err_msg=field.name
        )
    assert [path.name for path in tmp_path.iterdir()] == ["body.npz"]


@pytest.mark.parametrize(
    ("changes", "found"),
    [
        ({"weights": None}, "no array named weights"),
        ({"weights": np.zeros((24, 6890))}, "weights"),
        ({"v_template": np.array([["text"]])}, "v_template of shape"),
        ({"kintree_table": np.zeros((0, 24), int)}, "parents"),
        ({"kintree_table": np.zeros((2, 24), int)}, "parents"),
        ({"f": np.array([{"a": 1}], dtype=object)}, "cannot be read"),
    ],
)
def test_a_file_that_is_no_body_is_refused(tmp_path, open_body, changes, found):
    path = rewritten(tmp_path / "body.npz", open_body, **changes)
    with pytest.raises(InputError, match=found) as refused:
        load_body(path)
    assert str(path) in str(refused.value)


def test_the_narrow_open_body_differs_in_the_hip_joints_alone(open_body):
    narrow = find_body("open-neutral/3")
    assert narrow.name == "open-neutral/3"
    np.testing.assert_array_equal(narrow.template, open_body.template)
    before, after = open_body.joint_template, narrow.joint_template
    assert np.linalg.norm(before[1] - before[2]) == pytest.approx(0.230, abs=1e-3)
    assert np.linalg.norm(after[1] - after[2]) == pytest.approx(0.175, abs=1e-6)
    np.testing.assert_allclose(after[1:3].mean(0), before[1:3].mean(0), atol=1e-9)
    others = np.delete(np.arange(24), [1, 2])
    np.testing.assert_array_equal(after[others], before[others])
    # Every shape has narrower hips by the same share.
    far = [
        np.linalg.norm(body.joint_directions[1] - body.joint_directions[2], axis=0)
        for body in (open_body, narrow)
    ]
    np.testing.assert_allclose(far[1] / far[0], 0.175 / 0.2297, rtol=1e-3)


@pytest.mark.parametrize("name", ["yours", "../mine", "", "/mine"])
def test_a_body_that_is_not_installed_is_refused(tmp_path, open_body, name):
    (tmp_path / "bodies").mkdir()
    save_body(tmp_path / "mine.npz", open_body)
    save_body(tmp_path / "bodies" / "other.npz", open_body)
    with pytest.raises(UsageError, match="one of open-neutral/2, open-neutral/3, other"):
        find_body(name, tmp_path / "bodies")
