"""Followed points, what they say of the camera, and which are no part of the image."""

import numpy as np
import turning_clip as clip

from worldpose.broadcast_calibration.tracking import (
    Followed,
    chain,
    follow,
    modified_z_scores,
    turn,
)


def test_a_shifted_picture_is_followed_by_its_shift():
    # Structure at the size of a tracking window.
    coarse = np.random.default_rng(1).uniform(0.0, 255.0, (40, 60))
    picture = np.kron(coarse, np.ones((8, 8))).astype(np.uint8)
    moved = np.roll(picture, (-2, 3), axis=(0, 1))
    (pair,) = follow([picture, moved], None, 200)
    assert len(pair.start) > 60
    # Whole pixels: what is left is the tracker's tolerance.
    assert np.abs(pair.end - pair.start - [3.0, -2.0]).max() < 0.05
    assert pair.inlier_share > 0.9


def pairs_of(camera, rng):
    flow = clip.followed_points(camera, rng, each=80, noise=0.05)
    return [
        Followed(flow.start[flow.frame == t], flow.end[flow.frame == t], 1.0)
        for t in range(len(camera) - 1)
    ]


def test_a_turn_and_a_zoom_are_found_among_movers():
    rng = np.random.default_rng(4)
    true = clip.moving(2, pan=(0.0, 0.6), zoom=(2000.0, 2020.0))
    (pair,) = pairs_of(true, rng)
    # A third of the points move on their own.
    end = pair.end.copy()
    end[:25] += rng.uniform(-15.0, 15.0, (25, 2))
    found = turn(true.frames(slice(0, 1)), Followed(pair.start, end, 1.0))
    assert found.determined
    pixels = np.array([[100.0, 100.0], [800.0, 450.0]])
    one, two = (each.camera[1].unproject(pixels).directions for each in (found.camera, true))
    # 55 points of 0.05 px: a hundredth of a pixel, of 2000 px.
    assert np.abs(one - two).max() < 2e-5
    assert (modified_z_scores(found.residual)[:25] > 3.5).mean() > 0.9


def test_a_chain_meets_its_key_frames_and_says_what_it_missed():
    rng = np.random.default_rng(5)
    true = clip.moving(30)
    keys = true.frames(np.array([3, 24]))
    links = chain([3, 24], keys, pairs_of(true, rng), 3.5)
    for index, frame in enumerate((3, 24)):
        np.testing.assert_allclose(links.camera.rotation[frame], keys.rotation[index], atol=1e-12)
    assert links.determined.all()
    # 21 steps of about a hundredth of a pixel.
    assert 0.0 < links.drift[0] < 0.3
