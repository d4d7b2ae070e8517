"""The median of frames with a walking person."""

import tracemalloc

import numpy as np
import pytest

from worldpose.errors import InputError
from worldpose.video.folder import median_picture

GRASS = 90


def walking(count, shape=(20, 300, 3)):
    """Frames in one buffer, as readers give them; a bright person crosses from left to right."""
    frame = np.empty(shape, dtype=np.uint8)
    for index in range(count):
        frame[:] = GRASS
        left = (shape[1] - 10) * index // max(count - 1, 1)
        frame[5:15, left : left + 10] = 200
        yield frame


@pytest.mark.parametrize(("count", "shape"), [(21, (20, 300, 3)), (300, (70, 300))])
def test_who_walks_is_gone_however_long_the_clip(count, shape):
    assert (median_picture(walking(count, shape)) == GRASS).all()


@pytest.mark.parametrize("count", [1, 6, 255, 256])
def test_an_even_number_of_frames_has_the_lower_middle_level(count):
    frames = np.random.default_rng(count).integers(0, 256, (count, 70, 9, 3), dtype=np.uint8)
    frames[:, 0] = 0
    frames[:, 1] = 255
    lower = np.sort(frames, axis=0)[(count - 1) // 2]
    np.testing.assert_array_equal(median_picture(frames, most=400), lower)


def test_frames_are_kept_evenly_over_the_clip():
    # Frame n is n bright everywhere: the median of an even choice is the middle of the clip.
    frames = (np.full((2, 2), index // 4, dtype=np.uint8) for index in range(1000))
    # Of 1000 frames and at most 16, every 64th is kept, 0 to 960, and the eighth is their median.
    assert median_picture(frames, most=16)[0, 0] == 7 * 64 // 4


def test_memory_does_not_grow_with_the_clip():
    def peak(count):
        tracemalloc.start()
        median_picture(walking(count, (200, 300)), most=4)
        size = tracemalloc.get_traced_memory()[1]
        tracemalloc.stop()
        return size

    # The first call also holds what is made once; frames are 60 kB, of which 4 are kept.
    assert peak(200) < peak(8) + 60_000


def test_no_frames_two_sizes_and_too_few_to_keep_are_refused():
    with pytest.raises(InputError, match="no frames"):
        median_picture([])
    with pytest.raises(InputError, match=r"frame 1, \(4, 5\)"):
        median_picture([np.zeros((4, 4), np.uint8), np.zeros((4, 5), np.uint8)])
    with pytest.raises(InputError, match="two frames"):
        median_picture([np.zeros((4, 4), np.uint8)], most=1)
