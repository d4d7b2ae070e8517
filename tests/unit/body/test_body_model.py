"""The body model against worked examples, its derivatives, folded keypoints; body files."""

import json
from dataclasses import fields, replace

import numpy as np
import pytest
from command_line import invoke
from smpl_pickles import pickled, smpl_like

from worldpose.body.body_file import (
    KEYS,
    digest_of_body,
    find_body,
    install_body,
    load_body,
    read_npz_arrays,
    save_body,
)
from worldpose.body.jacobian import ChainedKeypoints
from worldpose.body.keypoints import BODY25, fold_keypoints, fold_regressor
from worldpose.body.model import BodyParameters
from worldpose.errors import InputError, UsageError


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
    """Every shape has narrower hips by the same share."""
    narrow = find_body("open-neutral/3")
    assert narrow.name == "open-neutral/3"
    np.testing.assert_array_equal(narrow.template, open_body.template)
    before, after = open_body.joint_template, narrow.joint_template
    assert np.linalg.norm(before[1] - before[2]) == pytest.approx(0.230, abs=1e-3)
    assert np.linalg.norm(after[1] - after[2]) == pytest.approx(0.175, abs=1e-6)
    np.testing.assert_allclose(after[1:3].mean(0), before[1:3].mean(0), atol=1e-9)
    others = np.delete(np.arange(24), [1, 2])
    np.testing.assert_array_equal(after[others], before[others])
    ways = [each.joint_directions for each in (open_body, narrow)]
    far = [np.linalg.norm(way[1] - way[2], axis=0) for way in ways]
    np.testing.assert_allclose(far[1] / far[0], 0.175 / 0.2297, rtol=1e-3)


@pytest.mark.parametrize("name", ["yours", "../mine", "", "/mine"])
def test_a_body_that_is_not_installed_is_refused(tmp_path, open_body, name):
    (tmp_path / "bodies").mkdir()
    save_body(tmp_path / "mine.npz", open_body)
    save_body(tmp_path / "bodies" / "other.npz", open_body)
    with pytest.raises(UsageError, match="one of open-neutral/2, open-neutral/3, other"):
        find_body(name, tmp_path / "bodies")


NAMES = ("betas", "global_orient", "body_pose", "transl")
STEP = 1e-6


@pytest.fixture(params=["open_body", "corrected_body"])
def folded(request):
    return fold_keypoints(request.getfixturevalue(request.param), BODY25)


def differences(folded, people, name):
    """Central differences (..., keypoints, 3, parameters)."""
    given = getattr(people, name)
    columns = []
    for column in range(given.shape[-1]):
        step = STEP * np.eye(given.shape[-1])[column]
        up, down = (replace(people, **{name: given + sign * step}) for sign in (1, -1))
        columns.append((folded(up) - folded(down)) / (2.0 * STEP))
    return np.stack(columns, axis=-1)


@pytest.mark.parametrize("name", NAMES[:3])
def test_derivatives_are_those_of_differences(folded, people, name):
    jacobian = ChainedKeypoints.of(folded).differentiate(people)
    # Rounding at 100 m over a step of 1e-6: 1e-8; the step's own error is far below.
    np.testing.assert_allclose(
        getattr(jacobian, name), differences(folded, people, name), atol=5e-8
    )


@pytest.mark.parametrize("angle", [0.0, 1e-4, 0.1001, 3.0])
def test_angles_of_any_size_have_exact_derivatives(folded, angle):
    axis = np.array([0.48, -0.6, 0.64])
    pose = np.zeros((23, 3))
    pose[[0, 3, 8, 16]] = angle * axis
    person = BodyParameters(np.zeros(10), angle * axis, pose.ravel(), np.zeros(3))
    jacobian = ChainedKeypoints.of(folded).differentiate(person)
    np.testing.assert_allclose(jacobian.keypoints, folded(person), atol=1e-14)
    for name in ("global_orient", "body_pose"):
        # Rounding at 1 m over a step of 1e-6, and the step's own error of 1e-12.
        np.testing.assert_allclose(
            getattr(jacobian, name), differences(folded, person, name), atol=2e-9
        )


def test_a_missing_person_is_missing_and_the_next_is_not(open_body, people):
    pose = people.body_pose.copy()
    pose[1] = np.nan
    chained = ChainedKeypoints.of(fold_keypoints(open_body, ("left_wrist",)))
    jacobian = chained.differentiate(replace(people, body_pose=pose))
    assert np.isnan(jacobian.keypoints[1]).all()
    np.testing.assert_array_equal(jacobian.pose[2], chained.differentiate(people).pose[2])


def test_a_vertex_of_a_model_of_another_size_is_refused(open_body):
    cut = replace(
        open_body,
        template=open_body.template[:6000],
        shape_directions=open_body.shape_directions[:6000],
        pose_directions=open_body.pose_directions[:6000],
        joint_regressor=np.full((24, 6000), 1 / 6000),
        weights=open_body.weights[:6000],
        faces=open_body.faces[:0],
    )
    with pytest.raises(InputError, match="6000 vertices"):
        fold_keypoints(cut, ("nose",))
    assert fold_keypoints(cut, ("neck",)).joint_shares[0, 12] == 1.0


@pytest.mark.parametrize(
    ("joints", "vertices"),
    [
        (np.zeros((2, 24)), np.zeros((2, 6890))),
        (np.full((2, 24), 1 / 24), np.zeros((3, 6890))),
        (np.full((2, 23), 1 / 23), np.zeros((2, 6890))),
    ],
)
def test_a_regressor_that_is_no_mean_is_refused(open_body, joints, vertices):
    with pytest.raises(InputError, match="keypoint regressor"):
        fold_regressor(open_body, joints, vertices)


@pytest.fixture(scope="module")
def arrays(open_body, tmp_path_factory):
    """Arrays under SMPL's keys, with correctives that compress well."""
    directions = np.zeros((6890, 3, 207))
    directions[::7, :, ::5] = 0.001
    path = tmp_path_factory.mktemp("arrays") / "body.npz"
    save_body(path, replace(open_body, pose_directions=directions))
    return read_npz_arrays(path, KEYS)


@pytest.fixture(scope="module")
def official(arrays, tmp_path_factory):
    path = tmp_path_factory.mktemp("downloads") / "SMPL_NEUTRAL.pkl"
    path.write_bytes(pickled(smpl_like(arrays)))
    return path


def test_a_pickle_like_smpls_is_installed_and_found(official, arrays, tmp_path, open_body):
    folder = tmp_path / "share" / "bodies"
    assert install_body(official, folder).name == "smpl-neutral"
    found = find_body("smpl-neutral", folder)
    same = {"template": "v_template", "shape_directions": "shapedirs", "faces": "f"}
    same |= {"pose_directions": "posedirs", "joint_regressor": "J_regressor", "weights": "weights"}
    for name, key in same.items():
        np.testing.assert_array_equal(getattr(found, name), arrays[key])
    np.testing.assert_array_equal(found.parents, open_body.parents)
    rest = BodyParameters.rest()
    np.testing.assert_array_equal(found.joints(rest), open_body.joints(rest))


@pytest.mark.parametrize(
    ("changes", "found"),
    [
        ({"v_template": np.zeros((6889, 3))}, "expected shape"),
        ({"weights": np.zeros((6890, 55))}, "weights"),
        ({"v_template": np.linspace(-900.0, 900.0, 6890)[:, None] * [0, 1, 0]}, "of millimetres"),
        ({"posedirs": np.zeros((6890, 3, 0))}, "6890, 0 and 10"),
        ({"shapedirs": np.zeros((6890, 3, 0))}, "6890, 207 and 0"),
        ({"posedirs": "text"}, "posedirs that is not an array"),
    ],
)
def test_arrays_of_another_shape_are_refused(arrays, tmp_path, changes, found):
    (tmp_path / "other.pkl").write_bytes(pickled({**arrays, **changes}))
    with pytest.raises(InputError, match=found) as refused:
        install_body(tmp_path / "other.pkl", tmp_path / "bodies")
    assert "other.pkl" in str(refused.value)
    assert not (tmp_path / "bodies").exists()


@pytest.mark.parametrize(
    ("change", "found"),
    [
        (lambda a: {"v_template": a["v_template"][:, [0, 2, 1]]}, r"\+x, \+z, \+y"),
        (lambda a: {"v_template": a["v_template"] * [-1, 1, 1]}, r"-x, \+y, \+z"),
        (lambda a: {"v_template": a["v_template"] * [1, -1, -1]}, r"\+x, -y, -z"),
        (lambda a: {"shapedirs": 1e3 * a["shapedirs"]}, "shapedirs: .* by up to"),
    ],
)
def test_a_body_in_other_axes_or_units_is_refused(arrays, tmp_path, change, found):
    (tmp_path / "other.pkl").write_bytes(pickled({**arrays, **change(arrays)}))
    with pytest.raises(InputError, match=found):
        install_body(tmp_path / "other.pkl", tmp_path / "bodies")


@pytest.mark.parametrize(
    "name", ["open-neutral/2", "open-neutral-smpl", "../up", "Capital", ".hidden"]
)
def test_a_name_that_cannot_be_a_file_is_refused(official, tmp_path, name):
    with pytest.raises(UsageError, match="--name"):
        install_body(official, tmp_path, name)


def test_another_body_of_the_same_name_is_not_overwritten(official, arrays, tmp_path):
    install_body(official, tmp_path, "mine")
    before = digest_of_body("mine", tmp_path)
    install_body(official, tmp_path, "mine")
    (tmp_path / "other.pkl").write_bytes(pickled({**arrays, "posedirs": 2.0 * arrays["posedirs"]}))
    with pytest.raises(InputError, match=r"mine\.npz: .*--name"):
        install_body(tmp_path / "other.pkl", tmp_path, "mine")
    assert digest_of_body("mine", tmp_path) == before
    with pytest.raises(InputError, match=r"body model mine.*of SHA-256 0123"):
        find_body("mine", tmp_path, "0123")


def test_body_install_says_where_the_body_is(official, tmp_path):
    folder = tmp_path / "bodies"
    command = ["body", "install", official, "--body-folder", folder]
    assert invoke(*command).exit_code == 0
    assert find_body("smpl-neutral", folder).name == "smpl-neutral"
    named = invoke(*command, "--name", "mine", "--json")
    assert json.loads(named.stdout) == {"body_model": "mine", "file": str(folder / "mine.npz")}
