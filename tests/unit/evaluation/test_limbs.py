import numpy as np

from worldpose.evaluation.metrics import LIMBS, correct_limbs, limb_ends

NAMES = list(LIMBS)


def spread_out():
    """17 joints at (index, 0, 0)."""
    return np.stack([np.arange(17.0), np.zeros(17), np.zeros(17)], axis=-1)


def test_ends_are_joints_or_middles_of_two():
    ends = limb_ends(spread_out())
    assert ends.shape == (10, 2, 3)
    assert ends[NAMES.index("right lower leg"), :, 0].tolist() == [14.0, 16.0]
    # Middle of the hips 11 and 12, of the shoulders 5 and 6, of the ears 3 and 4.
    assert ends[NAMES.index("torso"), :, 0].tolist() == [11.5, 5.5]
    assert ends[NAMES.index("head"), :, 0].tolist() == [5.5, 3.5]


def test_every_body_joint_carries_a_limb_and_the_face_only_the_ears():
    used = {joint for ends in LIMBS.values() for end in ends for joint in end}
    assert used == set(range(3, 17))


def test_a_missing_joint_makes_its_limbs_wrong():
    predicted = spread_out()
    predicted[5] = np.nan
    wrong = {
        name
        for name, right in zip(NAMES, correct_limbs(predicted, spread_out(), 0.5), strict=True)
        if not right
    }
    assert wrong == {"left upper arm", "torso", "head"}


def test_the_bound_is_on_the_mean_of_both_ends():
    # Left lower leg: joints 13 and 15, length 2, so the mean error may be 1.
    predicted = spread_out()
    predicted[15, 1] = 2.0
    leg = NAMES.index("left lower leg")
    assert correct_limbs(predicted, spread_out(), 0.5)[leg]
    predicted[15, 1] = 2.001
    assert not correct_limbs(predicted, spread_out(), 0.5)[leg]
