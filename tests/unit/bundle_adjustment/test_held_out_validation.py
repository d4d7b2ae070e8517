"""People who had no part in it judge a camera's change."""

import numpy as np
import pytest

from worldpose.bundle_adjustment.held_out_validation import held_out, verdict
from worldpose.static_calibration import stepped


def test_true_cameras_are_judged_by_the_noise_alone(clip):
    made, true, _ = clip(cameras=6, noise=1.0)
    frames = np.arange(24)
    held = held_out(made, true, frames, np.ones((24, 6), dtype=bool), robust_scale=100.0)
    # Two axes of unit variance, and what the joint of five other views adds: 2 (1 + 3 / (2 x 5)).
    assert np.nanmean(held.loss) == pytest.approx(2.6, rel=0.05)


def test_a_turned_camera_is_seen_in_its_own_keypoints(clip):
    made, true, _ = clip(cameras=6)
    frames, everybody = np.arange(24), np.ones((24, 6), dtype=bool)
    step = np.zeros((6, 12))
    step[2, 1] = 5e-3  # 10 px
    before = held_out(made, true, frames, everybody, 3.0)
    said = verdict(before, held_out(made, stepped(true, step), frames, everybody, 3.0))
    assert np.argmax(said.loss[:, 1] - said.loss[:, 0]) == 2
    assert said.error[2, 1] > 5.0 > said.error[2, 0]
    assert (said.judges == 24 * 6 * 17).all()


def test_only_the_judges_judge(clip):
    made, true, _ = clip()
    people = np.zeros((24, 6), dtype=bool)
    people[:, 4] = True
    held = held_out(made, true, np.arange(24), people, 3.0)
    assert np.isfinite(held.loss[:, :, 4]).all()
    assert np.isnan(held.loss[:, :, :4]).all()


def test_nobody_gives_no_verdict(clip):
    made, true, _ = clip()
    nobody = np.zeros((24, 6), dtype=bool)
    held = held_out(made, true, np.arange(24), nobody, 3.0)
    said = verdict(held, held)
    assert (said.judges == 0).all()
    assert np.isnan(said.loss).all()


@pytest.mark.parametrize(("scale", "loss"), [(3.0, 9.0 * np.log(5.0)), (1.5, 2.25 * np.log(17.0))])
def test_what_a_far_keypoint_costs_grows_with_the_logarithm_of_its_square(clip, scale, loss):
    made, true, _ = clip(frames=2, persons=1, noise=0.0)
    made.keypoints[1, 2, 0, 4] += [3.6, 4.8]
    everybody = np.ones((2, 1), dtype=bool)
    held = held_out(made, true, np.arange(2), everybody, robust_scale=scale)
    # 6 px at a noise of one: two and four scales, and the other four views are exact.
    assert held.error[1, 2, 0, 4] == pytest.approx(6.0, rel=1e-4)
    assert held.loss[1, 2, 0, 4] == pytest.approx(loss, rel=1e-4)
    assert held.loss[0].max() < 1e-4
