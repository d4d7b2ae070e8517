"""The median of frames with a walking person."""

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
