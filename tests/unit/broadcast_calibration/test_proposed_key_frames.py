"""Key frames proposed from the images of a clip."""

from functools import cache

import numpy as np
import pytest

from worldpose.broadcast_calibration import propose_key_frames
from worldpose.errors import InputError
from worldpose.geometry import Camera
from worldpose.pitch import PitchTemplate
from worldpose.simulation.renderer import render_pitch
from worldpose.simulation.scene import look_at

PITCH = PitchTemplate.standard()
GRASS = np.full((720, 1280, 3), (60, 120, 50), np.uint8)


@cache
def frame(x, center=(2.0, -70.0, 18.0)):
    """The image of a camera that looks at a place x [m] along the pitch."""
    camera = Camera(
        focal=np.array([1900.0, 1900.0]),
        principal_point=np.array([639.5, 359.5]),
        distortion=np.zeros(5),
        cam_from_world=look_at(np.array(center), np.array([x, 2.0, 0.0]), 0.0),
        image_size=np.array([1280, 720]),
    )
    return camera, render_pitch(camera, PITCH, None, 5)


def test_frames_with_one_center_become_key_frames():
    frames = {10: frame(-38.0), 40: frame(38.0)}
    pictures = [(number, picture) for number, (_, picture) in frames.items()]
    pictures.insert(1, (25, GRASS))
    found = propose_key_frames(pictures, PITCH, side="near", where="clip")
    assert [each.frame for each in found] == [10, 40]
    for key in found:
        camera = frames[key.frame][0]
        assert len(key.markings.drawn) >= 3
        for marking in key.markings.drawn:
            line = camera.project(PITCH.marking_points(marking.name, 0.05))
            line = line[np.isfinite(line).all(axis=1)]
            away = np.linalg.norm(np.array(marking.xy)[:, None] - line, axis=-1).min(axis=1)
            assert np.median(away) < 2.0, marking.name


def test_frames_of_two_centers_are_refused():
    pictures = [(0, frame(-38.0)[1]), (9, frame(-38.0, (2.0, -45.0, 30.0))[1])]
    with pytest.raises(InputError, match=r"2 clear frames of 2, . with one position"):
        propose_key_frames(pictures, PITCH, side="near", where="clip")


def test_a_clip_without_a_pitch_is_refused_with_what_to_click():
    with pytest.raises(InputError, match=r"clip: expected 2 frames.*found 0 clear.*Click four"):
        propose_key_frames([(0, GRASS), (1, GRASS)], PITCH, side="near", where="clip")
