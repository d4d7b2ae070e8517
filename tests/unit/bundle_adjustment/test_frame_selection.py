"""Selection of frames for the adjustment."""

from dataclasses import replace

import numpy as np

from worldpose.bundle_adjustment.clip import propose_frames


def test_frames_keep_their_distance_and_rise(clip):
    made, *_ = clip()
    chosen = propose_frames(made, count=40, gap=0.16, min_views=3)
    # 0.16 s are four frames of 25 Hz: at most six fit into 24.
    assert 4 <= len(chosen) <= 6
    assert np.diff(chosen).min() >= 4


def test_frames_without_well_seen_people_are_left_out(clip):
    made, *_ = clip()
    views = made.views.copy()
    views[5:] = 2
    chosen = propose_frames(replace(made, views=views), count=40, gap=0.0, min_views=3)
    assert chosen.tolist() == [0, 1, 2, 3, 4]


def test_a_frame_that_shows_another_part_of_the_pitch_comes_before_more_of_the_same(clip):
    made, *_ = clip(persons=1, frames=6)
    joints = made.joints.copy()
    joints[:] = joints[0]
    joints[3] += [20.0, 0.0, 0.0]
    views = np.full_like(made.views, 5)
    alike = replace(made, joints=joints, views=views)
    chosen = propose_frames(alike, count=2, gap=0.0, min_views=3)
    assert chosen.tolist() == [0, 3]
    # Proposed places are not collected again: nothing is new here, in given order.
    assert propose_frames(alike, 2, 0.0, 3, taken=np.array([3])).tolist() == [0, 1]
