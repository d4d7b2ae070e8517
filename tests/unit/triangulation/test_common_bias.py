import numpy as np
import pytest

from worldpose.triangulation.noise_model import (
    BY_JOINT,
    PROPORTIONS,
    STATURE,
    learn_common_bias,
)

USUAL = 0.022
NOISE = 0.015


def people(rng, bias=0.0, persons=12, frames=40):
    """Upright people of published proportions, some pixels' noise, and a detector's own joints."""
    share = {name: each.share for name, each in zip(NAMES, PROPORTIONS, strict=True)}
    joints = np.zeros((frames, persons, 17, 3))
    height = STATURE[0] * (1.0 + 0.04 * rng.standard_normal(persons))

    def own(name):
        return share[name] * height * (1.0 + 0.03 * rng.standard_normal(persons))

    shoulders, hips, trunk = own("shoulders") / 2, own("hips") / 2, own("trunk")
    upper, fore, thigh, shank = own("upper arm"), own("forearm"), own("thigh"), own("shank")
    for side, (s, e, w, h, k, a) in ((1, (5, 7, 9, 11, 13, 15)), (-1, (6, 8, 10, 12, 14, 16))):
        joints[:, :, s, 1], joints[:, :, s, 2] = side * shoulders, trunk
        joints[:, :, e], joints[:, :, w] = joints[:, :, s], joints[:, :, s]
        joints[:, :, e, 2] -= upper
        joints[:, :, w, 2] -= upper
        joints[:, :, w, 0] += fore
        joints[:, :, h, 1] = side * hips
        joints[:, :, k], joints[:, :, a] = joints[:, :, h], joints[:, :, h]
        joints[:, :, k, 2] -= thigh
        joints[:, :, a, 2] -= thigh + shank
    offset = bias * BY_JOINT[:, None] * rng.standard_normal((17, 3))
    for left in range(5, 17, 2):
        offset[left + 1] = offset[left] * [1.0, -1.0, 1.0]
    joints += offset + NOISE * rng.standard_normal(joints.shape)
    covariance = np.broadcast_to(NOISE**2 * np.eye(3), (*joints.shape, 3)).copy()
    return joints, covariance


NAMES = ("upper arm", "forearm", "thigh", "shank", "shoulders", "hips", "trunk")


def test_nobody_leaves_what_is_usual():
    nothing = np.full((6, 2, 17, 3), np.nan)
    learned = learn_common_bias(nothing, np.full((6, 2, 17, 3, 3), np.nan), USUAL)
    # The mean of an inverse chi-square of eight degrees of freedom: 8 / (8 - 2).
    assert learned == pytest.approx(USUAL * np.sqrt(8.0 / 6.0), rel=0.02)
    empty = learn_common_bias(np.empty((0, 0, 17, 3)), np.empty((0, 0, 17, 3, 3)), USUAL)
    assert empty == learned


def test_a_detector_that_goes_far_is_known_by_the_proportions_of_people():
    rng = np.random.default_rng(5)
    learned = {
        bias: np.mean([learn_common_bias(*people(rng, bias), USUAL) for _ in range(30)])
        for bias in (0.0, 0.02, 0.05, 0.08)
    }
    assert 0.75 * USUAL < learned[0.0] < 0.95 * USUAL
    assert learned[0.02] == pytest.approx(0.023, abs=0.003)
    # Between what was expected and what is there: seven lengths tell.
    assert 0.033 < learned[0.05] < 0.05
    assert 0.05 < learned[0.08] < 0.08
    assert sorted(learned.values()) == list(learned.values())
