"""What is stored keeps its layout; weak directions have names."""

import numpy as np
import pytest

from data_contracts.bundle_adjustment import BUNDLE_ADJUSTMENT
from worldpose.bundle_adjustment import (
    BundleAdjustmentSettings,
    adjust_cameras,
    adjustment_arrays,
    marking_errors,
    weak_direction,
)
from worldpose.geometry.stored import camera_from_arrays
from worldpose.store.groups import checked_arrays, checked_attributes


@pytest.mark.parametrize("evidence", ["markings_and_players", "markings"])
def test_arrays_and_attributes_are_those_of_the_layout(clip, evidence):
    made, *_ = clip(persons=3, frames=8)
    settings = BundleAdjustmentSettings(evidence=evidence, folds=2)
    adjusted = adjust_cameras(made, settings)
    person = np.array([4, 7, 9], dtype=np.int32)
    arrays, attributes = adjustment_arrays(adjusted, settings, person)
    checked = checked_arrays(BUNDLE_ADJUSTMENT, arrays, {})
    given = {"camera": list("abcde"), **attributes}
    stored = checked_attributes(BUNDLE_ADJUSTMENT, checked, given)
    assert set(checked["outlier_person"]) <= {4, 7, 9}
    assert stored["used_frames"] == adjusted.used.tolist()
    back = camera_from_arrays(checked)
    np.testing.assert_array_equal(back.numbers, adjusted.cameras.numbers)


def test_marking_errors_are_root_mean_squares_per_axis(clip):
    made, true, _ = clip(clicked=400)
    # 800 numbers of unit variance tell their root mean square to 2.5 %; three of that.
    np.testing.assert_allclose(marking_errors(made, true), 1.0, atol=0.075)
    none, *_ = clip(clicked=0)
    assert np.isnan(marking_errors(none, true)).all()


def test_focal_length_against_distance_is_named(clip):
    _, true, _ = clip()
    distance = true[0].cam_from_world.apply(np.array([[0.0, 0.0, 1.0]]))[0, 2]
    together = np.zeros(12)
    # Farther away and closer zoomed: 1 % of both.
    together[5], together[6] = 0.01 * distance, 0.01
    covariance = np.outer(together, together) + 1e-12 * np.eye(12)
    weak = weak_direction(true[0], covariance)
    assert {part.split()[0] for part in weak.about.split(", ")} == {"tz", "log_focal"}
    np.testing.assert_allclose(np.abs(weak.step[5:7]), together[5:7], rtol=0.05)


def test_a_given_camera_has_no_weak_direction(clip):
    _, true, _ = clip()
    weak = weak_direction(true[0], np.zeros((12, 12)))
    assert weak.about == "not known"
    assert not weak.step.any()
