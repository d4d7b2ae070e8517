"""Cameras from one straight marking and the circle around it, against the true camera."""

import numpy as np
import pytest
from clicking_people import paint_of, pinhole

from worldpose.geometry.cameras import Camera
from worldpose.geometry.rigid import Rigid
from worldpose.pitch.template import PitchTemplate
from worldpose.simulation.renderer import render_pitch
from worldpose.static_calibration.from_paint.candidates import refine_candidates
from worldpose.static_calibration.from_paint.circles import name_circles
from worldpose.static_calibration.from_paint.proposal import (
    calibrate_without_clicks,
)
from worldpose.static_calibration.line_samples import sample_markings

PITCH = PitchTemplate.standard()
SIZE = (1280, 720)
FOCALS = np.geomspace(0.45, 5.0, 13)
VIEWS = {
    "touch line and half a circle": ((-17.0, 18.0), 2300.0, ("touch_line_far", "center_circle")),
    "area and arc": ((-33.0, 0.0), 2600.0, ("penalty_area_left_front", "penalty_arc_left")),
}


def camera(aim, focal, center=(-2.0, -66.0, 15.0)):
    return pinhole(center, (*aim, 0.0), focal, SIZE)


def farthest(found, true, names):
    """The largest distance of the markings' pixels in two cameras, up to half a turn [px]."""
    off = []
    for turn in (1.0, -1.0):
        moved = []
        for name in names:
            places = PITCH.marking_points(name, 0.5)
            pixels = true.project(places)
            others = found.project(places * [turn, turn, 1.0])
            seen = ((pixels >= 0.0) & (pixels <= np.array(SIZE) - 1.0)).all(axis=1)
            moved.append(np.linalg.norm(others - pixels, axis=1)[seen].max())
        off.append(max(moved))
    return min(off)


@pytest.mark.parametrize("view", VIEWS)
def test_a_marking_and_a_circle_give_a_camera_that_explains_them(view):
    aim, focal, names = VIEWS[view]
    true = camera(aim, focal)
    paint = paint_of(true, names)
    found = name_circles(paint, PITCH, FOCALS, 0.0)
    assert len(found) > 10
    assert (found.centers[:, 1] <= 0.0).all()  # on the near side
    samples = sample_markings(PITCH, 1.0)
    near = refine_candidates(paint, samples, found, (25.0, 12.0, 6.0, 5.0), (True, False))
    cameras = [
        Camera(
            focal=np.full(2, near.focals[k]),
            principal_point=true.principal_point,
            distortion=np.zeros(5),
            cam_from_world=Rigid(near.rotations[k], -near.rotations[k] @ near.centers[k]),
            image_size=true.image_size,
        )
        for k in range(len(near))
    ]
    assert min(farthest(each, true, names) for each in cameras) < 4.0


def test_a_midfield_still_is_calibrated_on_the_stated_side():
    true = camera((0.0, 1.0), 2300.0)
    still = render_pitch(true, PITCH, None, 5)
    found = calibrate_without_clicks(PITCH, still, side="far").estimate.camera
    assert found.center[1] > 30.0  # the image looks the same from the near side
    assert farthest(found, true, ("halfway_line", "center_circle")) < 3.0
