"""Other people's clicks: noisier than stated, misnamed, drawn densely, in cropped images."""

import numpy as np
import opencv_rig as rig
import pytest

from data_contracts.pitch import PitchSpec
from worldpose.errors import InputError
from worldpose.pitch.template import PitchTemplate
from worldpose.static_calibration.estimate import calibrate_camera
from worldpose.static_calibration.evidence import gather_evidence
from worldpose.static_calibration.fit import build_problem, compute_residuals
from worldpose.static_calibration.settings import StaticCalibrationSettings


def cameras(count, clicks, noise, first=0, **lens):
    """Yield cameras with clicks, and a generator that continues."""
    found = 0
    for seed in range(first, first + 20 * count):
        rng = np.random.default_rng([seed, 77])
        camera = rig.wide_camera(rng, **lens)
        clicked = rig.click(camera, rng, clicks, noise)
        if clicked is not None:
            found += 1
            yield camera, clicked, rng
        if found == count:
            return


def calibrated(points, drawn=None, pitch=rig.PITCH):
    return calibrate_camera(pitch, rig.markings(points, drawn), rig.SIZE, where="cam07.json")


def test_a_point_beyond_the_fold_has_its_image_outwards_not_back_in_the_picture():
    (_, clicked, _), *_ = cameras(1, 9, noise=0.0, focal=(0.6, 0.7))
    evidence = gather_evidence(rig.PITCH, rig.markings(clicked), rig.SIZE, 0.5, "test")
    problem = build_problem(evidence, rig.SIZE, StaticCalibrationSettings())
    row = calibrated(clicked).estimate.camera.numbers
    row[4:9] = [-0.3, 0.0, 0.0, 0.0, 0.0]
    # Turned until a clicked point is 76 degrees off the axis: the fold is at 46 degrees.
    pose = row[9:18].reshape(3, 3)
    place = evidence.points_world[0]
    seen = pose @ place + row[18:21]
    away = np.array([np.tan(np.radians(76.0)), 0.0, 1.0]) * np.linalg.norm(seen) * 0.24
    row[18:21] += away - seen
    image = compute_residuals(problem, row).click[0] + evidence.points_image[0]
    folded = row[0] * away[0] / away[2] * (1.0 - 0.3 * (away[0] / away[2]) ** 2) + row[2]
    assert folded < 0  # what the polynomial alone says
    assert image[0] > rig.SIZE[0]


def test_an_image_that_is_cropped_off_its_center_is_told_from_wrong_names():
    said = 0
    for camera, clicked, _ in cameras(8, 12, noise=1.0, center=(1152.0, 378.0), first=1700):
        result = calibrated(clicked)
        assert result.report.wrong == ()
        said += any("cropped" in text for text in result.report.decisions)
        assert result.estimate.camera.focal[0] == pytest.approx(camera[0][0, 0], rel=0.1)
    assert said >= 5


def test_a_pitch_in_yards_is_told_from_wrong_clicks():
    pitch = PitchTemplate.from_spec(PitchSpec(length=114.8, width=74.4))
    for _, clicked, _ in cameras(3, 12, noise=1.0, first=2500):
        with pytest.raises(InputError, match=r"fit 105\.0 x 68\.0 m.*in yards"):
            calibrated(clicked, pitch=pitch)
