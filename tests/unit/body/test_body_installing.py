import json
from dataclasses import replace

import numpy as np
import pytest
from smpl_pickles import pickled, smpl_like
from typer.testing import CliRunner

from flows.cli.app import app
from worldpose.body.body_file import (
    KEYS,
    digest_of_body,
    find_body,
    install_body,
    read_npz_arrays,
    save_body,
)
from worldpose.body.model import BodyParameters
from worldpose.errors import InputError, UsageError


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
    made = install_body(official, folder)
    assert made.name == "smpl-neutral"
    found = find_body("smpl-neutral", folder)
    np.testing.assert_array_equal(found.template, arrays["v_template"])
    np.testing.assert_array_equal(found.shape_directions, arrays["shapedirs"])
    np.testing.assert_array_equal(found.pose_directions, arrays["posedirs"])
    np.testing.assert_array_equal(found.joint_regressor, arrays["J_regressor"])
    np.testing.assert_array_equal(found.weights, arrays["weights"])
    np.testing.assert_array_equal(found.faces, arrays["f"])
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


@pytest.fixture
def file(open_body, tmp_path):
    parents = np.where(open_body.parents < 0, 2**32 - 1, open_body.parents)
    arrays = {
        "v_template": open_body.template,
        "shapedirs": open_body.shape_directions,
        "posedirs": np.zeros((6890, 3, 207)),
        "J_regressor": open_body.joint_regressor,
        "weights": open_body.weights,
        "kintree_table": np.stack([parents, np.arange(24)]),
        "f": open_body.faces,
    }
    path = tmp_path / "SMPL_FEMALE.pkl"
    path.write_bytes(pickled(smpl_like(arrays)))
    return path


def test_body_install_says_where_the_body_is(file, tmp_path):
    folder = tmp_path / "bodies"
    command = ["body", "install", str(file), "--body-folder", str(folder)]
    plain = CliRunner().invoke(app, command)
    assert plain.exit_code == 0
    assert find_body("smpl-female", folder).name == "smpl-female"
    named = CliRunner().invoke(app, [*command, "--name", "mine", "--json"])
    assert json.loads(named.stdout) == {"body_model": "mine", "file": str(folder / "mine.npz")}


def test_another_body_of_the_same_name_is_not_overwritten(official, file, tmp_path):
    install_body(official, tmp_path, "mine")
    before = digest_of_body("mine", tmp_path)
    install_body(official, tmp_path, "mine")
    with pytest.raises(InputError, match=r"mine\.npz: .*--name"):
        install_body(file, tmp_path, "mine")
    assert digest_of_body("mine", tmp_path) == before
    with pytest.raises(InputError, match=r"body model mine.*of SHA-256 0123"):
        find_body("mine", tmp_path, "0123")
