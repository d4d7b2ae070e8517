"""Key frames proposed from the images of a clip."""

import numpy as np
import pytest
from camera_builders import look_at_camera

from data_contracts.keypoints import KeypointDetections
from worldpose.broadcast_calibration import key_frames
from worldpose.broadcast_calibration.key_frames import KnownPeople, propose_key_frames
from worldpose.errors import InputError
from worldpose.pitch.template import PitchTemplate
from worldpose.simulation.renderer import render_pitch
from worldpose.static_calibration.from_paint.proposal import propose_camera

PITCH = PitchTemplate.standard()
GRASS = np.full((720, 1280, 3), (60, 120, 50), np.uint8)


def frame(x):
    """The image of a camera on the far side that looks at a place x [m] along the pitch."""
    camera = look_at_camera((2.0, 70.0, 18.0), (x, 2.0, 0.0), 1900.0, (1280, 720))
    return camera, render_pitch(camera, PITCH, None, 5)


def pictures_of(frames):
    return [(number, picture) for number, (_, picture) in frames.items()]


def assert_drawn_on_the_lines(found, frames):
    assert [each.frame for each in found] == list(frames)
    for key in found:
        camera = frames[key.frame][0]
        assert len(key.markings.drawn) >= 3
        for marking in key.markings.drawn:
            line = camera.project(PITCH.marking_points(marking.name, 0.05))
            line = line[np.isfinite(line).all(axis=1)]
            away = np.linalg.norm(np.array(marking.xy)[:, None] - line, axis=-1).min(axis=1)
            assert np.median(away) < 2.0, marking.name


@pytest.fixture(scope="module")
def proposals():
    return {}


@pytest.fixture(autouse=True)
def _propose_once(monkeypatch, proposals):
    """Proposes a camera for each rendered image and side in one test alone."""

    def propose_once(picture, pitch, *, side, where):
        key = (id(picture), side)  # rendered images stay in memory
        if key not in proposals:
            proposals[key] = propose_camera(picture, pitch, side=side, where=where)
        return proposals[key]

    monkeypatch.setattr(key_frames, "propose_camera", propose_once)


def test_a_clip_without_a_pitch_is_refused_with_what_to_click():
    with pytest.raises(InputError, match=r"clip: expected 2 frames.*found 0 clear.*Click four"):
        propose_key_frames([(0, GRASS), (1, GRASS)], PITCH, side="near", where="clip")


def people_of(frames, places, *, seen_at=None):
    """Boxes of people who stand at places (p, 2) [m] in every frame, and the places they have."""
    boxes = np.full((max(frames) + 1, len(places), 4), np.nan)
    for number, (camera, _) in frames.items():
        feet = camera.project(np.column_stack([places, np.zeros(len(places))]))
        heads = camera.project(np.column_stack([places, np.full(len(places), 1.8)]))
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
    known = np.broadcast_to(places if seen_at is None else seen_at, (len(boxes), *places.shape))
    return KnownPeople(detections, known, 25.0)


FAR = {number: frame(x) for number, x in ((10, -38.0), (40, 38.0))}
PLACES = np.random.default_rng(3).uniform([-50.0, -30.0], [50.0, 20.0], (24, 2))


@pytest.mark.slow
def test_people_of_known_places_tell_the_side_of_a_camera_that_has_none():
    people, pictures = people_of(FAR, PLACES), pictures_of(FAR)
    pictures.insert(1, (25, GRASS))
    found = propose_key_frames(pictures, PITCH, side=None, where="clip", people=people)
    assert_drawn_on_the_lines(found, FAR)


def test_a_stated_side_that_people_contradict_is_named():
    people = people_of(FAR, PLACES)
    with pytest.raises(InputError, match=r"only after half a turn.*State the opposite side"):
        propose_key_frames(pictures_of(FAR), PITCH, side="near", where="clip", people=people)
