import numpy as np
import pytest

from data_contracts.cameras import CameraCalibration
from worldpose.errors import InputError
from worldpose.formats.archives import write_archive
from worldpose.formats.release_cameras import read_camera, write_static_camera

CALIBRATION = CameraCalibration(
    id="north",
    image_size=(1920, 1080),
    focal_px=(2000.0, 2010.0),
    principal_point_px=(955.0, 541.0),
    distortion=(-0.1, 0.02, 0.001, -0.002, 0.003),
    rotation=((1.0, 0.0, 0.0), (0.0, 0.0, -1.0), (0.0, 1.0, 0.0)),
    translation=(1.0, 5.0, 60.0),
)


def test_what_was_written_is_read_again(tmp_path):
    write_static_camera(tmp_path / "north.npz", CALIBRATION)
    camera = read_camera(tmp_path / "north.npz", (1920, 1080))
    assert camera.batch_shape == ()
    assert camera.to_calibration("north") == CALIBRATION


def moving(rows=3):
    """Arrays of a camera that zooms."""
    k = np.tile(np.eye(3), (rows, 1, 1))
    k[:, 0, 0] = k[:, 1, 1] = 2000.0 + 10.0 * np.arange(rows)
    k[:, :2, 2] = 960.0, 540.0
    return {
        "K": k,
        "k": np.zeros((rows, 5)),
        "R": np.tile(np.array(CALIBRATION.rotation), (rows, 1, 1)),
        "t": np.tile(np.array([1.0, 5.0, 60.0]), (rows, 1)),
    }


def test_a_moving_camera_has_one_row_a_frame(tmp_path):
    write_archive(tmp_path / "clip.npz", moving())
    camera = read_camera(tmp_path / "clip.npz")
    assert camera.batch_shape == (3,)
    assert camera.focal[:, 1].tolist() == [2000.0, 2010.0, 2020.0]
    assert camera.image_size[0].tolist() == [1920, 1080]


@pytest.mark.parametrize(
    ("middle", "size"), [((960.0, 600.0), (1920, 1080)), ((639.5, 359.5), (1280, 720))]
)
def test_a_principal_point_off_alike_along_both_axes_tells_the_size(tmp_path, middle, size, caplog):
    arrays = moving()
    arrays["K"][:, :2, 2] = middle
    write_archive(tmp_path / "clip.npz", arrays)
    assert read_camera(tmp_path / "clip.npz").image_size[0].tolist() == [*size]
    assert ("the middle of about 1280 x 720 px" in caplog.text) == (size == (1280, 720))


@pytest.mark.parametrize(
    ("member", "index", "value", "message"),
    [
        ("K", (1, 0, 1), 3.0, r"K\[1\]: expected \[\[fx, 0, cx\]"),
        ("K", (2, 1, 1), -5.0, r"K\[2\]: .* positive focal lengths"),
        ("K", (0, 2, 2), 2.0, r"K\[0\]"),
        ("R", (1, 0, 0), 1.1, r"R\[1\]: expected an orthonormal matrix"),
    ],
)
def test_numbers_that_are_no_camera_are_refused(tmp_path, member, index, value, message):
    arrays = moving()
    arrays[member][index] = value
    write_archive(tmp_path / "clip.npz", arrays)
    with pytest.raises(InputError, match=message):
        read_camera(tmp_path / "clip.npz")


def test_rows_must_agree_and_exist(tmp_path):
    write_archive(
        tmp_path / "clip.npz", {**moving(), "R": moving()["R"][:1], "t": np.zeros((1, 3))}
    )
    with pytest.raises(InputError, match=r"clip\.npz: R: expected shape"):
        read_camera(tmp_path / "clip.npz")
    write_archive(tmp_path / "clip.npz", moving(0))
    with pytest.raises(InputError, match="one row, or one a frame"):
        read_camera(tmp_path / "clip.npz")
