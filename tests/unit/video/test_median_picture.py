"""The median of frames with a walking person."""

import tracemalloc

import numpy as np
import pytest

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


def test_memory_does_not_grow_with_the_clip():
    def peak(count):
        tracemalloc.start()
        median_picture(walking(count, (200, 300)), most=4)
        size = tracemalloc.get_traced_memory()[1]
        tracemalloc.stop()
        return size

    # The first call also holds what is made once; frames are 60 kB, of which 4 are kept.
    assert peak(200) < peak(8) + 60_000
