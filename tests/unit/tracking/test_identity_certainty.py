"""Who comes back is the same person by shape, not by being the only one; the odds are exported."""

import cv2
import numpy as np
import pytest

from data_contracts.tracking import Join
from worldpose.tracking.joins import End, Takeover, choose_joins, identity_certainty, join_costs
from worldpose.tracking.plane.feet import GroundPositions
from worldpose.tracking.plane.shirts import measure_shirts
from worldpose.tracking.plane.tracker import track_on_plane
from worldpose.tracking.settings import TrackingSettings

SETTINGS = TrackingSettings()
LIMBS = np.full(11, 0.36)


def end(number, frame, limbs=LIMBS, place=(0.0, 0.0)):
    return End(number, frame, np.array(place), np.zeros(2), limbs, np.full(11, 4e-5))


def decided(before, after):
    costs = join_costs(before, after, 25.0, 300.0, SETTINGS)
    return [
        (join.before, join.after)
        for join in choose_joins(before, after, costs, 25.0, SETTINGS)
        if join.decided
    ]


def test_a_person_is_back_after_ten_seconds_only_with_the_own_size():
    gone, other = end(0, 100), end(1, 110, LIMBS + 0.03)
    same, unlike = end(2, 350, place=(4.0, 3.0)), end(3, 360, LIMBS - 0.02)
    assert decided([gone, other], [same]) == [(0, 2)]
    # One has left, and one comes: that alone is no evidence.
    assert decided([gone], [unlike]) == []
    assert decided([gone], [end(4, 350, np.full(11, np.nan))]) == []
    # After minutes, a place tells nothing.
    patient = TrackingSettings(max_join_gap_s=200.0)
    (cost,) = join_costs([gone], [end(6, 5000)], 25.0, 300.0, patient).ravel()
    assert np.isfinite(cost)
    # A moment unseen needs no shape.
    assert decided([gone], [end(5, 110, np.full(11, np.nan))]) == [(0, 5)]


def test_certainty_falls_at_every_return_and_not_at_a_confirmed_one():
    def join(first_frame, margin, after=7, is_decided=True):
        last = first_frame - 5
        return Join(before=7, after=after, last_frame=last, first_frame=first_frame, cost=0.0,
                    margin=margin, decided=is_decided)  # fmt: skip

    joins = [join(10, np.log(9.0)), join(20, None), join(30, np.log(4.0)), join(5, 1.0, 8, False)]
    found = identity_certainty(joins, np.array([7, 8]), 40)
    assert found[[0, 9, 10, 29, 30, 39], 0] == pytest.approx([1, 1, 0.9, 0.9, 0.72, 0.72])
    assert (found[:, 1] == 1.0).all()


def test_a_track_that_may_show_another_person_is_as_likely_either():
    join = Takeover(frame=20, person=7, other=-1).join
    found = identity_certainty([join], np.array([7, 8]), 40)
    assert found[[0, 19, 20, 39], 0] == pytest.approx([1, 1, 0.5, 0.5])
    assert (found[:, 1] == 1.0).all()


RED, BLUE, GRASS = (200, 20, 30), (20, 40, 180), (60, 120, 50)
FPS = 25.0


def lab(colour):
    pixel = np.array(colour, dtype=np.float32)[None, None] / 255.0
    return cv2.cvtColor(pixel, cv2.COLOR_RGB2LAB)[0, 0]


def people(lefts):
    """Boxes of 20 x 60 px, and torsos whose shoulders are at 12 px and hips at 30 px."""
    boxes = np.array([[left, 20.0, left + 20.0, 80.0] for left in lefts])
    keypoints = np.full((len(lefts), 17, 2), np.nan)
    for joint, at in ((5, (15, 32)), (6, (5, 32)), (11, (13, 50)), (12, (7, 50))):
        keypoints[:, joint] = np.array(at, dtype=float) + [[left, 0.0] for left in lefts]
    return keypoints, np.where(np.isfinite(keypoints[..., 0]), 0.9, np.nan), boxes


def draw(lefts, colours):
    image = np.empty((100, 200, 3), dtype=np.uint8)
    image[:] = GRASS
    for left, colour in zip(lefts, colours, strict=True):
        image[31:52, left + 4 : left + 17] = colour
    return image


def test_the_colour_is_that_of_the_upper_body_with_and_without_keypoints():
    keypoints, confidence, boxes = people([20, 120])
    image = draw([20, 120], [RED, BLUE])
    found = measure_shirts(image, keypoints, confidence, boxes)
    np.testing.assert_allclose(found, [lab(RED), lab(BLUE)], atol=1e-3)
    confidence[:] = np.nan
    np.testing.assert_allclose(measure_shirts(image, keypoints, confidence, boxes), found)


def meeting(colours, spread=2.0):
    """Two people who run towards each other, meet, and run back; their places and shirts."""
    rng = np.random.default_rng(2)
    frames = 50
    x = 0.1 + np.abs(np.linspace(-5.0, 5.0, frames))
    xy = np.zeros((frames, 1, 2, 2))
    xy[:, 0, 0, 0], xy[:, 0, 1, 0] = -x, x
    xy += rng.normal(0.0, 0.02, xy.shape)
    shirts = np.empty((frames, 1, 2, 3))
    for person, colour in enumerate(colours):
        shirts[:, 0, person] = lab(colour) + rng.normal(0.0, spread, (frames, 3))
    shirts[23:27] = np.nan  # they hide one another
    noise = np.broadcast_to(0.2**2 * np.eye(2), (*xy.shape, 2)).copy()
    height = np.full(xy.shape[:-1], 1.8)
    return GroundPositions(xy, noise, np.zeros_like(noise), height, shirts=shirts)


def ends(positions):
    """Each track's detection in the first and in the last frame."""
    tracks = track_on_plane(positions, FPS, pitch_size=(105.0, 68.0))
    index = tracks.detection_index[:, 0]
    assert index.shape[1] == 2
    return sorted((int(index[0, n]), int(index[-1, n])) for n in range(2))


def test_people_of_two_teams_who_meet_and_part_are_not_exchanged():
    positions = meeting([RED, BLUE])
    assert ends(positions) == [(0, 0), (1, 1)]
    positions.shirts[:] = np.nan
    assert ends(positions) == [(0, 1), (1, 0)]  # at constant velocity they run on


def test_shirts_of_one_team_decide_nothing_even_if_one_stands_in_the_shade():
    # The second person's shirt is darker, as shading makes it.
    assert ends(meeting([(200, 20, 30), (185, 18, 28)])) == [(0, 1), (1, 0)]
