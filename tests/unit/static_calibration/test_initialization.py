import clicking_people as people
import numpy as np
from hypothesis import given
from hypothesis import strategies as st

from worldpose.static_calibration.initialization import camera_from_homography


@given(
    focal=st.floats(900, 6000),
    x=st.floats(-40, 40),
    height=st.floats(8, 40),
    aim=st.floats(-40, 40),
    roll=st.floats(-0.05, 0.05),
)
def test_the_camera_in_an_exact_homography_is_found(focal, x, height, aim, roll):
    camera = people.pinhole((x, -70.0, height), (aim, 3.0, 0.0), focal, people.SIZE, roll=roll)
    pose = camera.cam_from_world
    middle = camera.principal_point
    k = np.array([[focal, 0, middle[0]], [0, focal, middle[1]], [0, 0, 1]])
    homography = -3.0 * k @ np.column_stack([pose.rotation[:, :2], pose.translation])
    found = camera_from_homography(homography, people.SIZE, middle, (300.0, 20000.0))
    np.testing.assert_allclose(found.focal, focal, rtol=1e-6)
    np.testing.assert_allclose(found.center, camera.center, rtol=1e-5, atol=1e-5)
