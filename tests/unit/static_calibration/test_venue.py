"""Cameras on the pitch that they show together."""

from functools import cache

import clicking_people as people
import numpy as np

from data_contracts.pitch import PitchSpec
from worldpose.pitch.template import PitchTemplate
from worldpose.simulation.renderer import render_pitch
from worldpose.static_calibration.calibration import calibrate_camera
from worldpose.static_calibration.report import calibration_arrays
from worldpose.static_calibration.venue import join_cameras

PAINTED = PitchTemplate.from_spec(PitchSpec(crown=0.12, end_fall=0.35))
TOLD = PitchTemplate.standard()


@cache
def seats():
    """Two cameras of opposite sides, and their calibrations on a pitch told wrongly."""
    cameras, found = [], []
    for index in (0, 8):
        camera, rng = people.seat(index)
        names = list(PAINTED.points)
        pixels = camera.project(PAINTED.positions(names))
        inside = (np.isfinite(pixels) & (pixels > 4) & (pixels < np.array(people.SIZE) - 5)).all(1)
        seen = {names[i]: pixels[i] + rng.standard_normal(2) for i in np.flatnonzero(inside)}
        picture = render_pitch(camera, PAINTED, None, index)
        cameras.append(camera)
        found.append(calibrate_camera(TOLD, people.points(seen), people.SIZE, picture=picture))
    return tuple(cameras), tuple(found)


def test_cameras_show_a_surface_that_the_file_does_not_have():
    _, found = seats()
    assert [each.report.stage for each in found] == ["lines", "lines"]
    venue = join_cameras([calibration_arrays(each) for each in found])
    off = venue.surface.shape - PAINTED.surface
    std = np.sqrt(np.diag(venue.surface.covariance))
    assert (np.abs(off) < 3.0 * std).all()
    assert (std < [0.03, 0.05]).all()
    for each in found:
        own = each.report.lines.venue.covariance[-2:, -2:]
        assert (np.diag(own) >= std**2 * (1.0 - 1e-9)).all()
