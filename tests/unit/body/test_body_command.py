import json

import numpy as np
import pytest
from smpl_pickles import pickled, smpl_like
from typer.testing import CliRunner

from flows.cli.app import app
from worldpose.body.body_file import find_body


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
