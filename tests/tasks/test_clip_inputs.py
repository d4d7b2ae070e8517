"""A clip's detections as input of an iteration, corrected by the previous iteration's results."""

import numpy as np
import xarray as xr

from tasks.clip_inputs import PAGE, StoredArray


def array(values, *dims):
    return xr.DataArray(values, dims=("frame", *dims))


def test_rejected_keypoints_are_gone_and_lasting_errors_taken_off():
    frames = PAGE + 3  # over the border of a page
    rng = np.random.default_rng(0)
    cameras = [
        xr.Dataset(
            {
                "keypoints": array(
                    rng.random((frames, count, 17, 2), dtype=np.float32),
                    *("detection", "joint", "axis"),
                )
            }
        )
        for count in (2, 1)
    ]
    rejected = array(rng.random((frames, 2, 2, 17)) < 0.1, "camera", "detection", "joint")
    shift = array(
        rng.random((frames, 2, 2, 17, 2), dtype=np.float32),
        *("camera", "detection", "joint", "axis"),
    )
    plain = StoredArray(cameras, "keypoints")[5:frames]
    taken = StoredArray(cameras, "keypoints", rejected, shift)[5:frames]
    assert np.isnan(taken[rejected.values[5:]]).all()
    kept = ~rejected.values[5:] & np.isfinite(plain[..., 0])
    np.testing.assert_allclose(taken[kept], plain[kept] - shift.values[5:][kept], atol=1e-6)
    assert kept[:, 1, 0].any() and not kept[:, 1, 1].any()


def test_who_was_looked_for_again_is_taken_as_he_was_found_this_time():
    # One detection in each of two frames; then a redetected person in the second.
    ones = np.ones((2, 2, 17, 2), dtype=np.float32)
    ones[0, 1] = np.nan
    camera = xr.Dataset(
        {
            "keypoints": array(100.0 * ones, "detection", "joint", "axis"),
            "found_again": array(np.array([[-1, -1], [-1, 7]]), "detection"),
            "shift": array(2.0 * ones * [[[[0.0]], [[1.0]]]], "detection", "joint", "axis"),
        }
    )
    # The iteration before had three places, and of the last two says what it said of others.
    rejected = array(np.ones((2, 1, 3, 17), dtype=bool), "camera", "detection", "joint")
    rejected[:, :, 0] = False
    shift = array(np.full((2, 1, 3, 17, 2), 5.0), "camera", "detection", "joint", "axis")
    taken = StoredArray([camera], "keypoints", rejected, shift)[0:2]
    assert taken.shape == (2, 1, 2, 17, 2)
    np.testing.assert_array_equal(taken[:, 0, 0], 95.0)
    assert np.isnan(taken[0, 0, 1]).all()
    np.testing.assert_array_equal(taken[1, 0, 1], 98.0)
    detected = StoredArray([camera], "keypoints", redetected=False)[0:2]
    np.testing.assert_array_equal(detected[:, 0, 0], 100.0)
    assert np.isnan(detected[:, 0, 1]).all()
