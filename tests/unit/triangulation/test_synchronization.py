"""Clock offsets of which nothing is known are found from moving people, or refused."""

from dataclasses import replace

import numpy as np
import pytest

from data_contracts.keypoints import KeypointDetections
from worldpose.geometry.cameras import Camera
from worldpose.geometry.rigid import Rigid, Similarity
from worldpose.pitch.template import PitchTemplate
from worldpose.simulation.scenarios import SCENARIOS
from worldpose.simulation.scene import simulate_scene
from worldpose.triangulation.synchronization import synchronize
from worldpose.triangulation.world import move_cameras

LATE = np.array([-12.0, -3.5, 0.0, 2.25, 20.0])
"""Offset of each camera [frame]: its frame t shows the time t + offset."""
FINE = 4
"""Simulated frames per frame: fractions of a frame are exact."""
FPS = 25.0
FRAMES, BEFORE = 70, 15


@pytest.fixture(scope="module")
def scene():
    """Five people before five cameras, simulated at 100 frames per second."""
    tiny = SCENARIOS["tiny"]
    rig = tiny.rig.model_copy(update={"cameras": len(LATE)})
    seconds = (FRAMES + BEFORE + 25) / FPS
    changes = {"fps": FINE * FPS, "duration": seconds, "rig": rig, "broadcast": ()}
    return simulate_scene(tiny.model_copy(update=changes), 4)


@pytest.fixture(scope="module")
def pitch():
    return PitchTemplate.from_spec(SCENARIOS["tiny"].pitch)


def with_rows(detections, rows):
    """Detections whose frame t of camera c is row rows[t, c]."""
    cameras = np.arange(rows.shape[1])
    arrays = {name: array[rows, cameras] for name, array in detections.arrays().items()}
    return KeypointDetections(frame=np.arange(len(rows)), **arrays)


def shifted(scene, late=LATE):
    rows = FINE * (np.arange(FRAMES)[:, None] + BEFORE + late)
    return with_rows(scene.static_views().detections, np.rint(rows).astype(int))


def turned(scene, angle):
    """The cameras with an error of the calibration [rad]."""
    rng = np.random.default_rng(2)
    still = np.zeros(3)
    cameras = []
    for camera in scene.cameras.values():
        error = Rigid.from_rotvec(rng.normal(0.0, angle, 3), still)
        pose = camera.cam_from_world
        cameras.append(replace(camera, cam_from_world=error @ pose))
    return Camera.stack(cameras)


def errors(found, late=LATE):
    off = found.late - late
    return off - np.nanmedian(off)


def test_offsets_are_found_without_a_hint_and_with_wrong_cameras(scene, pitch):
    angle = 1e-3
    found = synchronize(turned(scene, angle), shifted(scene), FPS, pitch=pitch)
    assert found.reasons == ("",) * 5
    assert np.abs(errors(found)).max() < 0.2
    assert (found.std < 0.1).all()
    peaks = found.shifts[found.matches.argmax(axis=1)]
    assert np.abs(peaks - found.late).max() < 4.0


@pytest.mark.parametrize("seed", [1, 8])  # chance makes one shift in 200 stand out most
def test_where_nothing_moves_no_offset_is_told(scene, pitch, seed):
    noise = 2.0
    still = with_rows(scene.static_views().detections, np.full((FRAMES, 5), 60))
    rng = np.random.default_rng(seed)
    moved = still.keypoints + rng.normal(0.0, noise, still.keypoints.shape)
    found = synchronize(turned(scene, 0.0), replace(still, keypoints=moved), FPS, pitch=pitch)
    assert np.isnan(found.late).all()
    assert np.isinf(found.std).all()
    assert all(found.reasons)


def test_a_camera_that_shows_other_people_has_no_offset(scene, pitch):
    seen = shifted(scene)
    alone = seen.keypoints.copy()
    alone[:, 3] = alone[::-1, 3] * [-1.0, 1.0] + [1900.0, 0.0]
    found = synchronize(turned(scene, 0.0), replace(seen, keypoints=alone), FPS, pitch=pitch)
    assert np.isnan(found.late[3])
    assert found.reasons[3]
    rest = np.array([0, 1, 2, 4])
    assert np.abs(errors(found)[rest]).max() < 0.2


def test_groups_that_share_no_person_have_offsets_of_their_own(scene):
    cameras, seen = turned(scene, 0.0), shifted(scene)
    other = {name: array[::-1] for name, array in seen.arrays().items()}
    arrays = {
        name: np.concatenate([array[:, :3], other[name][:, [0, 3, 4]]], axis=1)
        for name, array in seen.arrays().items()
    }
    away = cameras[np.array([0, 3, 4])]
    away = move_cameras(Similarity(np.array(1.0), np.eye(3), np.array([300.0, 0.0, 0.0])), away)
    both = Camera.stack([*(cameras[c] for c in range(3)), *(away[c] for c in range(3))])
    found = synchronize(both, seen.with_arrays(arrays, seen.frame), FPS)
    assert found.groups == ((0, 1, 2), (3, 4, 5))
    off = found.late[:3] - LATE[:3]
    assert np.abs(off - np.median(off)).max() < 0.3
    reversed_late = -LATE[[0, 3, 4]]
    off = found.late[3:] - reversed_late
    assert np.abs(off - np.median(off)).max() < 0.3
