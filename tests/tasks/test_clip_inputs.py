"""Detections of a clip as an iteration takes them: less what the one before said of them."""

import numpy as np
import xarray as xr

from tasks.clip_inputs import PAGE, StoredClip


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
    plain = StoredClip(cameras, "keypoints")[5:frames]
    taken = StoredClip(cameras, "keypoints", rejected, shift)[5:frames]
    assert np.isnan(taken[rejected.values[5:]]).all()
    kept = ~rejected.values[5:] & np.isfinite(plain[..., 0])
    np.testing.assert_allclose(taken[kept], plain[kept] - shift.values[5:][kept], atol=1e-6)
    assert kept[:, 1, 0].any() and not kept[:, 1, 1].any()
