"""Cameras on the pitch that they show together."""

from functools import cache

import clicking_people as people
import numpy as np
import pytest

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


def places(rng):
    x, y = rng.uniform(-50.0, 50.0, 200), rng.uniform(-32.0, 32.0, 200)
    return np.stack([x, y, PAINTED.height(x, y)], axis=-1)


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


def test_joined_cameras_place_people_on_the_surface():
    cameras, found = seats()
    venue = join_cameras([calibration_arrays(each) for each in found])
    pitch = TOLD.with_surface(venue.surface.shape)
    rng = np.random.default_rng(0)
    for index, camera in enumerate(cameras):
        true = places(rng)
        pixels = camera.project(true)
        seen = (np.isfinite(pixels) & (pixels > 0) & (pixels < np.array(people.SIZE) - 1)).all(1)
        joined = venue.cameras[index].project(
            np.insert(true[:, :2], 2, pitch.height(true[:, 0], true[:, 1]), axis=1)
        )
        off = np.linalg.norm(joined - pixels, axis=1)[seen]
        assert np.median(off) < 0.5


def test_a_camera_alone_stays_as_it_is_and_a_given_one_tells_nothing():
    _, found = seats()
    arrays = calibration_arrays(found[0])
    given = {name: arrays[name] for name in arrays if not name.startswith(("venue_", "covariance"))}
    venue = join_cameras([arrays, given])
    assert venue.cameras[0].center == pytest.approx(found[0].estimate.camera.center, abs=1e-6)
    assert venue.covariance[0] == pytest.approx(found[0].estimate.covariance, rel=1e-6, abs=1e-12)
    assert np.isnan(venue.covariance[1]).all()
    assert join_cameras([given]).surface is None
