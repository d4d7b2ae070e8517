import numpy as np
import pytest

from data_contracts.conventions import COCO17
from worldpose.geometry.cameras import Camera
from worldpose.geometry.rigid import Rigid
from worldpose.simulation.detector_errors import (
    DIFFICULTY,
    MIRRORED,
    SystematicErrors,
    detect,
    project_bodies,
)
from worldpose.simulation.settings import ObservationNoise

FPS = 25.0
FRAMES = 2000


@pytest.fixture
def camera():
    """At the origin, looks along y, x to the right, z up, 100 px per metre at 20 m."""
    rotation = np.array([[1.0, 0.0, 0.0], [0.0, 0.0, -1.0], [0.0, 1.0, 0.0]])
    return Camera(
        focal=np.array([2000.0, 2000.0]),
        principal_point=np.array([959.5, 539.5]),
        distortion=np.zeros(5),
        cam_from_world=Rigid(rotation, np.zeros(3)),
        image_size=np.array([1920, 1080]),
    )


def standing(x, y):
    """A person 1.8 m tall at a place, feet 1 m below the camera's height; arms hang."""
    across = np.array([0, 0.03, -0.03, 0.07, -0.07, *[0.2, -0.2] * 3, *[0.1, -0.1] * 3])
    height = np.array([1.6, 1.65, 1.65, 1.6, 1.6, *np.repeat([1.45, 1.15, 0.9, 0.95, 0.5, 0.1], 2)])
    return np.stack([x + across, np.full(17, y), height - 1.0], axis=-1)


EVEN = SystematicErrors(np.zeros((17, 3)), np.ones((17, 2, 2)))


def projected(camera, *people, frames=1):
    joints = np.tile(np.stack(people), (frames, 1, 1, 1))
    return project_bodies(camera, joints, np.full(len(people), 1.8))


def one_setting(**settings):
    return ObservationNoise(**{**ObservationNoise.none().model_dump(), **settings})


def detected(camera, noise, *people, frames=FRAMES):
    projections = projected(camera, *people, frames=frames)
    found = detect(projections, noise, EVEN, FPS, np.random.default_rng(0))
    return projections, found.keypoints, found.confidence


def test_pixels_and_size_of_a_person_straight_ahead(camera):
    projections = projected(camera, standing(0.0, 20.0))
    # Left ankle: 0.1 m to the right, 0.9 m down, at 100 px per metre.
    assert projections.keypoints[0, 0, 15].tolist() == pytest.approx([969.5, 629.5], abs=1e-9)
    assert projections.size[0, 0] == pytest.approx(180.0, abs=1e-9)
    assert projections.seen.all()


def test_a_person_right_behind_another_is_hidden(camera):
    projections = projected(camera, standing(0.0, 40.0), standing(0.0, 20.0))
    # Half as large about the camera's height, most of it fits into the nearer one's outline.
    assert (projections.hider[0, 0] == 1).mean() > 0.7
    assert (projections.hider[0, 1] == -1).all()


def test_without_noise_detections_are_the_projections(camera):
    projections, keypoints, confidence = detected(
        camera, ObservationNoise.none(), standing(0.0, 40.0), standing(0.0, 20.0), frames=3
    )
    np.testing.assert_array_equal(keypoints, projections.keypoints)
    assert (confidence == 1.0).all()


def test_white_noise_is_a_share_of_the_height_by_joint(camera):
    noise = one_setting(white=0.02)
    for distance, height in ((20.0, 180.0), (40.0, 90.0)):
        projections, keypoints, _ = detected(camera, noise, standing(0.0, distance))
        spread = (keypoints - projections.keypoints)[:, 0].std(axis=(0, 2))
        # 4000 draws each: standard error 1.1 %.
        np.testing.assert_allclose(spread, 0.02 * height * DIFFICULTY, rtol=0.06)


@pytest.mark.parametrize(
    ("setting", "share", "whose"),
    [
        ("joint_missed", 0.1, (0.0, 0.1)),
        ("person_missed", 0.2, (0.2, 0.2)),
        ("hidden_joint_missed", 0.4, (0.4, 0.0)),
        ("hidden_person_missed", 0.9, (0.9, 0.0)),
    ],
)
def test_misses_have_their_rates(camera, setting, share, whose):
    _, keypoints, confidence = detected(
        camera, one_setting(**{setting: share}), standing(0.0, 40.0), standing(0.0, 20.0)
    )
    missing = np.isnan(keypoints[..., 0])
    np.testing.assert_array_equal(missing, np.isnan(confidence))
    # Bursts of 5 frames leave some 400 independent draws: standard error 0.02.
    np.testing.assert_allclose(missing.mean(axis=(0, 2)), whose, atol=0.06)
    whole = missing.all(-1) | ~missing.any(-1)
    assert whole.all() == setting.startswith(("person", "hidden_person"))


def test_swaps_exchange_left_and_right_of_the_whole_person(camera):
    projections, keypoints, _ = detected(camera, one_setting(swapped=0.3), standing(0.0, 20.0))
    same = (keypoints == projections.keypoints).all((2, 3))[:, 0]
    swapped = (keypoints == projections.keypoints[:, :, MIRRORED]).all((2, 3))[:, 0]
    assert (same ^ swapped).all()
    assert swapped.mean() == pytest.approx(0.3, abs=0.06)
    assert COCO17[MIRRORED[COCO17.index("left_knee")]] == "right_knee"
    assert MIRRORED[0] == 0
