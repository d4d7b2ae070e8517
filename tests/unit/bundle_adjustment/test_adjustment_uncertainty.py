"""Survey errors that all cameras share, and the resulting uncertainty."""

from dataclasses import replace

import numpy as np
import pytest

from worldpose.bundle_adjustment.uncertainty import add_shared_errors, survey_response
from worldpose.pitch.template import PitchTemplate
from worldpose.static_calibration.line_samples import (
    EXACT_PAINT,
    project_lines,
    sample_markings,
    thin_samples,
)
from worldpose.static_calibration.line_search import adjust
from worldpose.static_calibration.parameters import step_camera

SURVEY_ERROR = 0.006


@pytest.fixture
def lined(clip):
    """A clip of four cameras above the centre circle, the first three calibrated on its lines."""
    made, *_ = clip(cameras=4)
    on_lines = np.array([True, True, True, False])
    return replace(made, pitch=PitchTemplate.standard(), on_lines=on_lines)


def test_cameras_that_do_not_rest_on_lines_share_nothing(lined):
    response = survey_response(lined, SURVEY_ERROR)
    assert response[:3].any(axis=(1, 2)).all()
    assert not response[3].any()
    assert survey_response(replace(lined, pitch=None), SURVEY_ERROR).size == 0
    assert survey_response(replace(lined, on_lines=None), SURVEY_ERROR).size == 0


def test_what_cameras_share_is_never_more_than_they_state(lined):
    response = survey_response(lined, SURVEY_ERROR)
    for known, moved in zip(lined.covariance[:3], response[:3], strict=True):
        free = np.diag(known) > 0.0
        size = np.sqrt(np.diag(known)[free])
        left = (known - moved @ moved.T)[np.ix_(free, free)] / np.outer(size, size)
        # Rounding of numbers of size one.
        assert np.linalg.eigvalsh(left).min() > -1e-9


def test_a_survey_that_is_off_as_a_whole_takes_its_cameras_along(lined):
    # Cameras that know nothing but the lines: what all points have in common goes into them whole.
    pitch, free = lined.pitch, np.diag(lined.covariance[0]) > 0.0
    samples = sample_markings(pitch, 0.25)
    noise = replace(EXACT_PAINT, points_m=SURVEY_ERROR, shift_px=0.05)
    for c in range(3):
        seen = project_lines(lined.cameras[c], samples, 0.12, noise)
        seen = seen[thin_samples(seen, samples, 8.0, 700)]
        fitted = adjust(
            np.zeros(len(seen.places)),
            np.full(len(seen.places), 0.01),
            np.ascontiguousarray(seen.by_camera[:, :12][:, free]),
            seen.by_paint,
            seen.unknowns,
            (np.zeros((free.sum(), free.sum())), np.zeros(free.sum())),
            (np.inf,),
        )
        lined.covariance[c][np.ix_(free, free)] = np.linalg.inv(fitted.information)
    response = survey_response(lined, SURVEY_ERROR)
    spot = pitch.positions(["center_mark"])
    for axis in np.eye(3):
        common = np.tile(axis, len(pitch.points))
        for camera, moved in zip(lined.cameras[:3], response[:3], strict=True):
            # The paint is there, the survey says here: the camera has to make up for it.
            seen = camera.project(spot + SURVEY_ERROR * axis)
            # Tolerance for a paint error of 0.3 px, linearized.
            np.testing.assert_allclose(
                step_camera(camera, moved @ common).project(spot), seen, atol=1e-3
            )


def test_lines_that_are_off_together_move_the_camera_with_them():
    # One parameter that two cameras measure with unit variance: half of it is theirs alone, half
    # shared. The mean of both errs by a quarter for the one and a half for the other.
    information = np.ones((2, 1, 1))
    pull_apart = 1e6  # what people tell: both are the same
    matrix = np.diag([1.0, 1.0]) + pull_apart * np.array([[1.0, -1.0], [-1.0, 1.0]])
    response = np.full((2, 1, 1), np.sqrt(0.5))
    found = add_shared_errors(np.linalg.inv(matrix), information, response)
    # Of the mean of independent ones it would be a half; people's millionth is left.
    np.testing.assert_allclose(found[:, 0, 0], 0.75, rtol=1e-5)


def test_cameras_that_share_nothing_stay_as_sure(lined):
    rng = np.random.default_rng(1)
    root = rng.standard_normal((24, 24))
    found = add_shared_errors(root @ root.T, np.tile(np.eye(12), (2, 1, 1)), np.zeros((2, 12, 0)))
    blocks = (root @ root.T).reshape(2, 12, 2, 12)
    np.testing.assert_allclose(found, blocks[[0, 1], :, [0, 1]])
