"""Bodies are painted where the camera projects them, the nearest on top."""

import io

import matplotlib.image
import numpy as np
import pytest

from worldpose.body.body_file import load_open_body
from worldpose.body.model import BodyParameters
from worldpose.geometry.cameras import Camera
from worldpose.geometry.rigid import Rigid
from worldpose.reports.bodies import crowded_part, paint_bodies, plot_bodies


def camera_at(height=10.0, away=40.0):
    """Looking along +y at the centre spot from behind the touch line."""
    center = np.array([0.0, -away, height])
    forward = -center / np.linalg.norm(center)
    right = np.array([1.0, 0.0, 0.0])
    rotation = np.stack([right, np.cross(forward, right), forward])
    return Camera(
        focal=np.array([1500.0, 1500.0]),
        principal_point=np.array([639.5, 359.5]),
        distortion=np.array([0.1, 0.0, 0.0, 0.0, 0.0]),
        cam_from_world=Rigid(rotation, -rotation @ center),
        image_size=np.array([1280, 720]),
    )


def square(x, y, size=1.0):
    """An upright square (4, 3) [m] that faces -y, and its two triangles."""
    corners = np.array([[0, 0, 0], [size, 0, 0], [size, 0, size], [0, 0, size]], dtype=float)
    return corners + np.array([x, y, 0.0])


FACES = np.array([[0, 1, 2], [0, 2, 3]])


def test_a_triangle_is_painted_where_it_is_and_nowhere_else():
    camera = camera_at()
    canvas = np.zeros((720, 1280, 3), dtype=np.uint8)
    body = square(0.0, 0.0)
    paint_bodies(canvas, camera, body[None], FACES, np.array([[1.0, 0.0, 0.0]]))
    painted = np.argwhere(canvas[..., 0] > 0)[:, ::-1]
    corners = camera.project(body)
    # Corners are rounded to a sixteenth of a pixel; smooth borders reach two pixels out.
    np.testing.assert_allclose(painted.min(axis=0), corners.min(axis=0), atol=2.2)
    np.testing.assert_allclose(painted.max(axis=0), corners.max(axis=0), atol=2.2)
    assert (canvas[..., 0] >= canvas[..., 1]).all()


def test_the_nearer_body_hides_the_farther_whatever_their_order():
    camera = camera_at()
    bodies = np.stack([square(-0.5, 0.0), square(-0.5, 3.0)])
    colors = np.array([[1.0, 0.0, 0.0], [0.0, 0.0, 1.0]])
    (middle,) = np.rint(camera.project(bodies[0].mean(axis=0)[None])).astype(int)
    for order in ([0, 1], [1, 0]):
        canvas = np.zeros((720, 1280, 3), dtype=np.uint8)
        paint_bodies(canvas, camera, bodies[order], FACES, colors[order])
        red, _, blue = canvas[middle[1], middle[0]]
        assert red > blue


def test_a_thin_body_has_a_solid_rim():
    camera = camera_at()
    canvas = np.full((720, 1280, 3), 100, dtype=np.uint8)
    body = square(0.0, 0.0)
    paint_bodies(canvas, camera, body[None], FACES, np.array([[1.0, 0.0, 0.0]]), opacity=0.5)
    rim = (canvas == [255, 0, 0]).all(-1)
    (x, y), (right, _) = np.rint(camera.project(body[[0, 1]])).astype(int)
    side = right - x
    # Four sides, one pixel wide.
    assert rim.sum() == pytest.approx(4 * side, abs=12)
    inside = canvas[y - side // 2, x + side // 2]
    assert 100 < inside[0] < 255
    assert inside[1] == inside[2] == 50


def test_what_faces_away_is_not_painted():
    canvas = np.zeros((720, 1280, 3), dtype=np.uint8)
    paint_bodies(canvas, camera_at(), square(0, 0)[None], FACES[:, ::-1], np.ones((1, 3)))
    assert not canvas.any()


def test_the_part_with_most_people_is_shown():
    camera = camera_at()
    bodies = np.stack([square(-8.0, 0.0), square(5.0, 0.0), square(6.0, 0.5)])
    corner, side = crowded_part(camera, bodies)
    inside = ((camera.project(bodies.mean(axis=1)) - corner) / side).round(2)
    assert ((inside > 0.0) & (inside < 1.0)).all(axis=-1).tolist() == [False, True, True]


def test_nobody_in_the_picture_shows_all_of_it():
    corner, side = crowded_part(camera_at(), square(0.0, -100.0)[None])
    assert (corner.tolist(), side.tolist()) == ([-0.5, -0.5], [1280.0, 720.0])


def test_a_missing_person_is_left_out_of_the_picture():
    model = load_open_body()
    poses = BodyParameters(
        np.zeros((2, model.shapes)),
        np.array([[np.pi / 2, 0.0, 0.0], [np.nan] * 3]),
        np.zeros((2, 69)),
        np.zeros((2, 3)),
    )
    still = np.full((720, 1280, 3), 90, dtype=np.uint8)
    picture = plot_bodies(
        camera_at(), "camera", model.vertices(poses), model.faces, (1, 4), still=still
    )
    pixels = matplotlib.image.imread(io.BytesIO(picture))
    # Person 1 is orange-red: the only strong colour there is.
    assert (pixels[..., 0] - pixels[..., 2] > 0.3).mean() > 0.002
