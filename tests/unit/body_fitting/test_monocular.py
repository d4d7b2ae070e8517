"""Files of methods of one picture: their names, shapes and conventions."""

import numpy as np
import pytest

from worldpose.body_fitting.monocular import read_monocular
from worldpose.errors import InputError
from worldpose.geometry import Rigid

VECTORS = np.random.default_rng(0).normal(0.0, 0.4, (3, 24, 3))
MATRICES = Rigid.from_rotvec(VECTORS, np.zeros(3)).rotation
CROP = {"box_center": np.array([[10.0, 20.0], [30.0, 40.0], [50.0, 60.0]])}

LAYOUTS = {
    "4DHumans": {
        "global_orient": MATRICES[:, :1],
        "body_pose": MATRICES[:, 1:],
        "pred_cam": np.ones((3, 3)),
        "box_size": np.ones(3),
        **CROP,
    },
    "HybrIK": {
        "pred_thetas": MATRICES.reshape(3, 216),
        "bbox": np.array(
            [[0.0, 0.0, 20.0, 40.0], [20.0, 20.0, 40.0, 60.0], [40.0, 50.0, 60.0, 70]]
        ),
    },
    "SMPL in vectors": {
        "global_orient": VECTORS[:, 0],
        "body_pose": VECTORS[:, 1:].reshape(3, 69),
        **CROP,
    },
    "SMPL in one": {"poses": VECTORS.reshape(3, 72), **CROP},
}


def written(tmp_path, arrays):
    path = tmp_path / "estimates.npz"
    np.savez(path, **arrays)
    return path


@pytest.mark.parametrize("layout", LAYOUTS)
def test_turns_and_crops_are_the_same_whatever_the_method(tmp_path, layout):
    found = read_monocular(written(tmp_path, LAYOUTS[layout] | {"frame": np.array([4, 4, 7])}))
    np.testing.assert_allclose(found.rotations, MATRICES, atol=1e-12)
    np.testing.assert_array_equal(found.center, CROP["box_center"])
    np.testing.assert_array_equal(found.frame, [4, 4, 7])
    assert found.cropped


def test_a_place_before_the_whole_picture_is_projected(tmp_path):
    arrays = {
        "poses": VECTORS.reshape(3, 72),
        "transl": np.array([[0.0, 0.0, 10.0], [1.0, 0.0, 10.0], [0.0, -2.0, 20.0]]),
        "focal_length": np.array(1000.0),
        "img_size": np.array([1921, 1081]),
    }
    found = read_monocular(written(tmp_path, arrays))
    assert not found.cropped
    np.testing.assert_allclose(found.center, [[960.0, 540.0], [1060.0, 540.0], [960.0, 440.0]])
    np.testing.assert_array_equal(found.frame, [0, 1, 2])


@pytest.mark.parametrize(
    ("change", "says"),
    [
        ({"box_center": None}, "a crop"),
        ({"body_pose": None}, "body_pose"),
        ({"body_pose": np.zeros((3, 21, 3))}, "23 joints"),
        ({"global_orient": np.zeros((2, 3))}, "2 and 3"),
        ({"frame": np.zeros(5)}, "3 frames"),
    ],
)
def test_files_that_lack_something_are_refused_with_its_name(tmp_path, change, says):
    arrays = {**LAYOUTS["SMPL in vectors"], **change}
    path = written(tmp_path, {name: array for name, array in arrays.items() if array is not None})
    with pytest.raises(InputError, match=says) as told:
        read_monocular(path)
    assert str(path) in str(told.value)


def test_pickled_objects_are_not_loaded(tmp_path):
    path = tmp_path / "estimates.npz"
    np.savez(path, poses=np.array([{"a": 1}], dtype=object))
    with pytest.raises(InputError, match="Python objects, which are never loaded"):
        read_monocular(path)
