"""A camera from few clicks whose lens was calibrated before."""

import numpy as np
import pytest
from clicking_people import (
    DISTORTION,
    PITCH,
    SIZE,
    click,
    ground_errors,
    lens_of,
    on_the_pitch,
    wide_camera,
)

from worldpose.errors import InputError
from worldpose.static_calibration.estimate import calibrate_camera
from worldpose.static_calibration.from_paint.proposal import propose_camera


def test_a_known_lens_lowers_the_ground_error_of_few_clicks():
    with_lens, without = [], []
    for seed in range(5):
        camera, rng = wide_camera(seed)
        clicked = click(camera, rng, count=6).clicked
        lens = lens_of(camera, rng)
        places = on_the_pitch(rng, 200)
        for errors, given in ((with_lens, lens), (without, None)):
            found = calibrate_camera(PITCH, clicked, SIZE, lens=given)
            estimate = found.estimate.camera
            errors.append(np.quantile(ground_errors(estimate, camera, places), 0.95))
            if given is not None:
                np.testing.assert_array_equal(estimate.distortion[2:4], DISTORTION[2:4])
                assert estimate.focal[0] == pytest.approx(camera.focal[0], rel=0.02)
                assert "k3" in found.report.free
                assert any("the given lens" in each for each in found.report.decisions)
    # Seen over ten seeds: 0.32 m and 1.71 m (medians).
    assert np.median(with_lens) < 0.5 * np.median(without)


def test_a_lens_of_images_of_another_size_is_refused():
    camera, rng = wide_camera(1)
    clicked = click(camera, rng, count=6).clicked
    small = lens_of(camera, rng).model_copy(update={"image_size": (1280, 720)})
    said = "image_size 1920 x 1080, that of the image, found 1280 x 720"
    with pytest.raises(InputError, match=said):
        calibrate_camera(PITCH, clicked, SIZE, lens=small)
    with pytest.raises(InputError, match=said):
        propose_camera(np.zeros((1080, 1920, 3), np.uint8), PITCH, side="near", lens=small)


def test_a_lens_that_the_clicks_contradict_makes_the_camera_weak():
    camera, rng = wide_camera(1)
    clicked = click(camera, rng, count=14).clicked
    for focal, contradicted in ((1.0, False), (0.93, True)):
        report = calibrate_camera(PITCH, clicked, SIZE, lens=lens_of(camera, rng, focal)).report
        found = [each for each in report.reasons if "contradict the given lens" in each]
        assert bool(found) == contradicted, report.reasons
