"""A broadcast clip of a match in which the static cameras track no person."""

import numpy as np
import pytest
import turning_clip as clip
from test_calibrating_clips import FPS, LOOK, SETTINGS, clicks, grey

from worldpose.broadcast_calibration.calibration import (
    BroadcastClip,
    broadcast_arrays,
    broadcast_attributes,
    calibrate_broadcast,
)
from worldpose.broadcast_calibration.players import People
from worldpose.simulation.renderer import render_broadcast

FRAMES = 6


@pytest.mark.slow
def test_without_anybody_the_camera_is_what_lines_alone_say():
    true = clip.moving(FRAMES, pan=(-2.0, 2.0))
    pictures = [grey(p) for p in render_broadcast(true.camera, clip.PITCH, None, 5, LOOK)]
    nobody = People(np.empty((FRAMES, 0, 17, 3)), np.full((FRAMES, 3, 17, 2), np.nan), FPS)
    alone, held = (
        calibrate_broadcast(
            clip.PITCH,
            BroadcastClip([clicks(true, 2)], lambda: iter(pictures), FPS, people=who),
            SETTINGS,
        )
        for who in (None, nobody)
    )
    np.testing.assert_array_equal(held.camera.rotation, alone.camera.rotation)
    np.testing.assert_array_equal(held.camera.focal, alone.camera.focal)
    assert np.isnan(held.report.player_rms).all()
    assert broadcast_arrays(held).keys() == broadcast_arrays(alone).keys()
    assert broadcast_attributes("clip", held, 0)["feed_offset"]["frames"] is None
