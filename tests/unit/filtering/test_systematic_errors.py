"""Lasting errors of keypoints: what is planted is found, told apart from what looks like it."""

from dataclasses import replace

import numpy as np
import pytest
from planted_errors import plant

from worldpose.filtering.judging import Residuals
from worldpose.filtering.settings import FilteringSettings
from worldpose.filtering.systematic_errors import (
    TERMS,
    SystematicErrors,
    ViewBias,
    learn_systematic_errors,
    learn_view_bias,
    watch_motion,
)

ROWS = 3000


@pytest.fixture(scope="module")
def scene():
    return plant(44, duration=0.6)


def seen_from_all_sides(shift, noise=1.0):
    """Residuals of one joint after another, with a direction and a size for each row."""
    rng = np.random.default_rng(2)
    azimuth, scale = rng.uniform(-np.pi, np.pi, ROWS), rng.uniform(30.0, 80.0, ROWS)
    missed = shift(azimuth, scale) + noise * rng.normal(size=(ROWS, 17, 2))
    zero = np.zeros(ROWS, dtype=np.int64)
    variance = np.full((ROWS, 17), noise**2)
    return Residuals(zero, zero, zero, missed, variance, 1.0), azimuth, scale


def test_a_bias_that_goes_with_the_side_is_found():
    bias = ViewBias(np.random.default_rng(1).normal(0.0, 0.02, (17, 2, TERMS)))
    misses, *seen = seen_from_all_sides(bias.shift)
    misses.missed[:1000, 3] = np.nan
    found = learn_view_bias(misses, *seen)
    # 1 px at 55 px per metre over 3,000 rows: 0.5 mm; five of these.
    np.testing.assert_allclose(found.coefficient, bias.coefficient, atol=0.0025)


def with_a_late_camera(scene, frames, held):
    """The scene's systematic, and what was detected there with a camera of which that is late.

    Args:
        held: share of the clock offset in people's offsets.
    """
    motion = watch_motion(scene.cameras, scene.joints, np.gradient(scene.joints, axis=0))
    late = np.array([0.0, frames, 0.0, 0.0, 0.0, 0.0])
    at = np.nonzero(scene.suspects.detections.detection_index >= 0)
    keypoints = scene.suspects.detections.keypoints.copy()
    shift = late[:, None, None, None] * motion.image_motion
    keypoints[(*at[:2], scene.suspects.detections.detection_index[at])] += shift[at]
    offsets = held * np.nan_to_num(shift.mean(axis=-2))
    detections = replace(scene.suspects.detections, keypoints=keypoints)
    suspects = replace(scene.suspects, detections=detections, offsets=offsets)
    return SystematicErrors(ViewBias.none(), late), motion, suspects


def test_a_late_clock_is_learned_beside_sides_and_its_shift_brings_keypoints_back():
    scene = plant(31, duration=2.0)
    true, motion, suspects = with_a_late_camera(scene, 0.6, held=0.0)
    people = (scene.cameras, scene.joints, scene.views, motion, suspects)
    systematic = learn_systematic_errors(*people, FilteringSettings(), 25.0)
    # The coupling between viewing-angle errors and clocks is below 0.1 frame.
    late = true.late - true.late.mean()
    np.testing.assert_allclose(systematic.late - systematic.late.mean(), late, atol=0.07)
    right = suspects.subtract(systematic.shift(motion, scene.views))
    exact = replace(systematic, late=np.zeros(6)).shift(motion, scene.views)
    on_time = scene.suspects.subtract(exact).detections.keypoints
    at = np.nonzero(scene.suspects.detections.detection_index >= 0)
    place = (*at[:2], scene.suspects.detections.detection_index[at])
    here = at[1] == 1
    honest = ~scene.displaced[place][here]

    def beside(found):
        return np.linalg.norm((found - on_time)[place][here][honest], axis=-1)

    assert np.nanmean(beside(right.detections.keypoints)) < 0.4 * np.nanmean(
        beside(suspects.subtract(exact).detections.keypoints)
    )
