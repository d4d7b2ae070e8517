"""Pose files hold what the release's readers expect."""

import numpy as np
import pytest

from worldpose.body.model import BodyParameters
from worldpose.errors import InputError
from worldpose.formats.joints_file import read_poses, write_poses


@pytest.fixture
def poses():
    rng = np.random.default_rng(0)
    transl = rng.uniform(-50.0, 50.0, (3, 5, 3))
    transl[1, 2] = np.nan
    return BodyParameters(
        rng.standard_normal((3, 1, 10)),
        rng.standard_normal((3, 5, 3)),
        rng.standard_normal((3, 5, 69)),
        transl,
    )


def test_poses_come_back_in_single_precision(poses, tmp_path):
    write_poses(tmp_path / "clip.npz", poses, "open-neutral/2")
    back, body_model = read_poses(tmp_path / "clip.npz")
    assert body_model == "open-neutral/2"
    for name in ("betas", "global_orient", "body_pose", "transl"):
        np.testing.assert_array_equal(
            getattr(back, name), getattr(poses, name).astype(np.float32).astype(np.float64)
        )
    with np.load(tmp_path / "clip.npz") as file:
        assert {name: file[name].shape for name in file.files} == {
            "betas": (3, 10),
            "global_orient": (3, 5, 3),
            "body_pose": (3, 5, 69),
            "transl": (3, 5, 3),
            "body_model": (1,),
        }


def test_a_file_without_an_array_is_refused(tmp_path):
    np.savez(tmp_path / "half.npz", betas=np.zeros((1, 10)))
    with pytest.raises(InputError, match=r"half\.npz"):
        read_poses(tmp_path / "half.npz")
