import clicking_people as people
import numpy as np
from hypothesis import given
from hypothesis import strategies as st

from worldpose.static_calibration.initialization import (
    camera_from_homography,
)

SIZE = people.SIZE
MIDDLE = np.array([959.5, 539.5])


def pinhole(focal=2100.0, center=(10.0, -60.0, 22.0), aim=(15.0, 0.0, 0.0), roll=0.01):
    return people.pinhole(center, aim, focal, SIZE, roll=roll)


@given(
    focal=st.floats(900, 6000),
    x=st.floats(-40, 40),
    height=st.floats(8, 40),
    aim=st.floats(-40, 40),
    roll=st.floats(-0.05, 0.05),
)
def test_the_camera_in_an_exact_homography_is_found(focal, x, height, aim, roll):
    camera = pinhole(focal, (x, -70.0, height), (aim, 3.0, 0.0), roll)
    pose = camera.cam_from_world
    k = np.array([[focal, 0, MIDDLE[0]], [0, focal, MIDDLE[1]], [0, 0, 1]])
    homography = -3.0 * k @ np.column_stack([pose.rotation[:, :2], pose.translation])
    found = camera_from_homography(homography, SIZE, MIDDLE, (300.0, 20000.0))
    np.testing.assert_allclose(found.focal, focal, rtol=1e-6)
    np.testing.assert_allclose(found.center, camera.center, rtol=1e-5, atol=1e-5)
