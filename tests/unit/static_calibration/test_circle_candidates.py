"""Cameras from one straight marking and the circle around it, against the true camera."""

import numpy as np
from clicking_people import pinhole

from worldpose.pitch.template import PitchTemplate
from worldpose.simulation.renderer import render_pitch
from worldpose.static_calibration.from_paint.proposal import calibrate_without_clicks

PITCH = PitchTemplate.standard()
SIZE = (1280, 720)


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


def test_a_midfield_still_is_calibrated_on_the_stated_side():
    true = camera((0.0, 1.0), 2300.0)
    still = render_pitch(true, PITCH, None, 5)
    found = calibrate_without_clicks(PITCH, still, side="far").estimate.camera
    assert found.center[1] > 30.0  # the image looks the same from the near side
    assert farthest(found, true, ("halfway_line", "center_circle")) < 3.0
