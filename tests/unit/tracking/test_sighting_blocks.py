import numpy as np

from worldpose.tracking.sightings import BLOCK, Sighting, Sightings

FRAMES = 3 * BLOCK + 5


def sighting(frame):
    return Sighting(np.array([frame, -1]), np.array([0.25, np.nan]), np.full((17, 3), float(frame)))


def test_sightings_give_back_what_was_put_in():
    kept = Sightings()
    for frame in range(10, 10 + FRAMES):
        kept[frame] = sighting(frame)
    assert list(kept) == list(range(10, 10 + FRAMES))
    for frame, found in kept.items():
        assert found.index.tolist() == [frame, -1]
        np.testing.assert_array_equal(found.ray_distance, [0.25, np.nan])
        assert (found.joints == frame).all()


def test_a_sighting_is_replaced_or_taken_out_alone():
    kept = Sightings()
    for frame in range(FRAMES):
        kept[frame] = sighting(frame)
    kept[5] = sighting(500)
    taken = kept.pop(6)
    assert taken.index.tolist() == [6, -1]
    kept[FRAMES] = sighting(FRAMES)
    assert len(kept) == FRAMES
    assert 6 not in kept
    assert [kept[frame].index[0] for frame in (4, 5, 7, FRAMES)] == [4, 500, 7, FRAMES]
