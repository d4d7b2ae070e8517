import cv2
import numpy as np

from data_contracts.cameras import CameraCalibration
from worldpose.cameras import Camera
from worldpose.release import write_static_camera

CALIBRATION = CameraCalibration(
    id="north",
    image_size=(1920, 1080),
    focal_px=(2000.0, 2010.0),
    principal_point_px=(955.0, 541.0),
    distortion=(-0.1, 0.02, 0.001, -0.002, 0.003),
    rotation=((1.0, 0.0, 0.0), (0.0, 0.0, -1.0), (0.0, 1.0, 0.0)),
    translation=(1.0, 5.0, 60.0),
)


def test_shapes_and_types_are_those_of_the_release(tmp_path):
    write_static_camera(tmp_path / "north.npz", CALIBRATION)
    with np.load(tmp_path / "north.npz", allow_pickle=False) as file:
        assert {name: (file[name].shape, file[name].dtype.str) for name in file} == {
            "K": ((1, 3, 3), "<f8"),
            "k": ((1, 5), "<f8"),
            "R": ((1, 3, 3), "<f8"),
            "t": ((1, 3), "<f8"),
        }


def test_opencv_projects_with_it_as_the_camera_does(tmp_path):
    write_static_camera(tmp_path / "north.npz", CALIBRATION)
    points = np.array([[0.0, 0.0, 0.0], [10.0, 5.0, 1.8], [-12.0, -8.0, 1.0]])
    with np.load(tmp_path / "north.npz", allow_pickle=False) as file:
        rotation = cv2.Rodrigues(file["R"][0])[0]
        pixels = cv2.projectPoints(points, rotation, file["t"][0], file["K"][0], file["k"][0])[0]
    # Two float64 implementations of one formula, with values of a thousand pixels.
    np.testing.assert_allclose(
        pixels[:, 0], Camera.from_calibration(CALIBRATION).project(points), atol=1e-9
    )
