"""Key frames proposed from the images of a clip."""

import numpy as np
import pytest
from camera_builders import look_at_camera

from data_contracts.keypoints import KeypointDetections
from worldpose.broadcast_calibration.key_frames import KnownPeople, propose_key_frames
from worldpose.errors import InputError
from worldpose.pitch.template import PitchTemplate
from worldpose.simulation.renderer import render_pitch

PITCH = PitchTemplate.standard()
GRASS = np.full((720, 1280, 3), (60, 120, 50), np.uint8)


def frame(x):
    """A camera on the far side that looks at a place x [m] along the pitch, and its image."""
    camera = look_at_camera((2.0, 70.0, 18.0), (x, 2.0, 0.0), 1900.0, (1280, 720))
    return camera, render_pitch(camera, PITCH, None, 5)


def pictures_of(frames):
    return [(number, picture) for number, (_, picture) in frames.items()]


def test_a_clip_without_a_pitch_is_refused_with_what_to_click():
    with pytest.raises(InputError, match=r"clip: expected 2 frames.*found 0 clear.*Click four"):
        propose_key_frames([(0, GRASS), (1, GRASS)], PITCH, side="near", where="clip")


def people_of(frames):
    """Boxes of people who stand at known places in every frame."""
    boxes = np.full((max(frames) + 1, len(PLACES), 4), np.nan)
    for number, (camera, _) in frames.items():
        feet = camera.project(np.column_stack([PLACES, np.zeros(len(PLACES))]))
        heads = camera.project(np.column_stack([PLACES, np.full(len(PLACES), 1.8)]))
        half = 0.2 * (feet[:, 1] - heads[:, 1])
        sides = feet[:, 0] - half, heads[:, 1], feet[:, 0] + half, feet[:, 1]
        inside = ((feet > 0.0) & (feet < [1280, 720]) & (heads > 0.0)).all(axis=1)
        boxes[number, inside] = np.stack(sides, axis=-1)[inside]
    shape = boxes.shape[:2]
    detections = KeypointDetections(
        keypoints=np.full((*shape, 17, 2), np.nan),
        confidence=np.full((*shape, 17), np.nan),
        boxes=boxes,
        score=np.where(np.isnan(boxes[..., 0]), np.nan, 1.0),
        frame=np.arange(len(boxes)),
    )
    return KnownPeople(detections, np.broadcast_to(PLACES, (len(boxes), *PLACES.shape)), 25.0)


@pytest.fixture(scope="module")
def far():
    return {number: frame(x) for number, x in ((10, -38.0), (40, 38.0))}


PLACES = np.random.default_rng(3).uniform([-50.0, -30.0], [50.0, 20.0], (24, 2))


@pytest.mark.slow
def test_people_of_known_places_tell_the_side_of_a_camera_that_has_none(far):
    people, pictures = people_of(far), pictures_of(far)
    pictures.insert(1, (25, GRASS))
    found = propose_key_frames(pictures, PITCH, side=None, where="clip", people=people)
    assert [each.frame for each in found] == list(far)
    for key in found:
        assert len(key.markings.drawn) >= 3
        for marking in key.markings.drawn:
            line = far[key.frame][0].project(PITCH.marking_points(marking.name, 0.05))
            line = line[np.isfinite(line).all(axis=1)]
            away = np.linalg.norm(np.array(marking.xy)[:, None] - line, axis=-1).min(axis=1)
            assert np.median(away) < 2.0, marking.name


@pytest.mark.slow  # sides of static cameras are compared alike in a moment
def test_a_stated_side_that_people_contradict_is_named(far):
    with pytest.raises(InputError, match=r"only after half a turn.*State the opposite side"):
        propose_key_frames(
            pictures_of(far), PITCH, side="near", where="clip", people=people_of(far)
        )
