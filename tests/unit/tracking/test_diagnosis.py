"""Each reason for finding no person is diagnosed from the detections, with numbers."""

import re
from dataclasses import replace

import numpy as np
import pytest

from data_contracts.keypoints import KeypointDetections
from worldpose.geometry.rigid import Rigid
from worldpose.tracking.diagnosis import diagnose_no_people
from worldpose.tracking.settings import TrackingSettings
from worldpose.tracking.tracker import track_people

detections = KeypointDetections.from_keypoints

FPS = 25.0
SETTINGS = TrackingSettings()
PLACES = np.array([[0.0, 0.0], [2.0, 1.0], [-3.0, 2.0], [4.0, -3.0]])


def walk(people, frames=80, radius=1.5):
    """Four people who walk on circles of their own."""
    time = np.arange(frames)[:, None] / FPS
    turn = np.array([1.0, -0.7, 0.5, -1.2]) * time + np.arange(4)
    return people(PLACES + radius * np.stack([np.cos(turn), np.sin(turn)], axis=-1))


def moved(cameras, centers):
    """The cameras with other centres, looking the same way."""
    rotation = cameras.cam_from_world.rotation
    translation = -np.einsum("cij,cj->ci", rotation, centers)
    return replace(cameras, cam_from_world=Rigid(rotation, translation))


def reason(cameras, keypoints, confidence, *, ground=True, settings=SETTINGS):
    """The diagnosis, after tracking has found no person."""
    pitch = (105.0, 68.0) if ground else None
    tracks = track_people(
        cameras, detections(keypoints, confidence), FPS, settings, pitch_size=pitch
    )
    assert tracks.report.people == 0
    names = [f"cam{n}" for n in range(len(cameras.focal))]
    given = (cameras, names, detections(keypoints, confidence), FPS, settings)
    return diagnose_no_people(*given, pitch_size=pitch, births=tracks.report.births)


def beside(ring, apart):
    """Two cameras side by side that look the same way."""
    camera = ring(4)[np.array([0, 0])]
    side = camera.cam_from_world.rotation[0, 0]
    return moved(camera, camera.center + np.array([[0.0], [apart]]) * side)


@pytest.mark.parametrize(
    ("count", "blank", "cause", "said"),
    [
        (4, [np.s_[:]], "no_detections", ["no camera shows a person"]),
        (
            *(4, [np.s_[..., 4:, :]], "too_few_keypoints"),
            ["1280 people in the images shows 4 joints", "5 are needed"],
        ),
        (4, [np.s_[:, 1:]], "one_camera", ["cam0 320, cam1 0"]),
        (2, [np.s_[:40, 0], np.s_[40:, 1]], "never_together", ["cam0 40 to 79, cam1 0 to 39"]),
        (4, [np.s_[3:]], "too_short", ["4 people were followed for moments"]),
    ],
)
def test_what_is_not_seen(ring, people, seen, count, blank, cause, said):
    keypoints, confidence = seen(ring(count), walk(people))
    for part in blank:
        keypoints[part] = np.nan
    found = reason(ring(count), keypoints, confidence)
    assert found.cause == cause
    assert all(text in found.message for text in said)


def test_cameras_side_by_side(ring, people, seen):
    cameras = beside(ring, 0.46)
    found = reason(cameras, *seen(cameras, walk(people), noise=0.3))
    assert found.cause == "narrow_angle"
    # 0.46 m at 30 m: 0.88 degrees.
    angle = float(re.search(r"same side, ([0-9.]+) degrees", found.message)[1])
    assert angle == pytest.approx(0.88, rel=0.2)
    assert "0.46 m apart" in found.message
    assert "5.7 are needed (setting tracking.min_angle_rad, 0.1 rad)" in found.message


@pytest.mark.parametrize(("factor", "unit"), [(1000.0, "millimetres"), (3.281, "feet")])
def test_translations_in_another_unit(ring, people, seen, factor, unit):
    keypoints, confidence = seen(ring(4), walk(people))
    found = reason(moved(ring(4), factor * ring(4).center), keypoints, confidence, ground=False)
    assert found.cause == "wrong_size"
    size = float(re.search(r"these are ([0-9.e+]+) times", found.message)[1])
    assert size == pytest.approx(factor, rel=0.1)
    assert unit in found.message


def test_a_world_whose_zero_is_not_the_ground(ring, people, seen):
    keypoints, confidence = seen(ring(4), walk(people))
    raised = moved(ring(4), ring(4).center + [0.0, 0.0, 4.0])
    found = reason(raised, keypoints, confidence)
    assert found.cause == "wrong_height"
    height = float(re.search(r"at a height of ([0-9.]+) m", found.message)[1])
    assert height == pytest.approx(5.1, abs=0.2)


@pytest.mark.parametrize(("sign", "up"), [(1.0, "y"), (-1.0, "-y")])
def test_a_world_with_another_axis_up(ring, people, seen, sign, up):
    keypoints, confidence = seen(ring(4), walk(people))
    turn = np.array([[1.0, 0.0, 0.0], [0.0, 0.0, sign], [0.0, -sign, 0.0]])
    pose = ring(4).cam_from_world
    cameras = replace(ring(4), cam_from_world=Rigid(pose.rotation @ turn.T, pose.translation))
    given = (cameras, list("abcd"), detections(keypoints, confidence), FPS, SETTINGS)
    found = diagnose_no_people(*given, pitch_size=(105.0, 68.0))
    assert found.cause == "not_upright"
    assert f"axis of people is {up}, not z" in found.message
    assert f"--up {up}," in found.message


def test_people_beside_the_pitch(ring, people, seen):
    keypoints, confidence = seen(ring(4), walk(people))
    found = reason(moved(ring(4), ring(4).center + [90.0, 0.0, 0.0]), keypoints, confidence)
    assert found.cause == "outside_pitch"
    assert re.search(r"they are (8[89]|9[0-2]) m from the centre spot", found.message)


def test_a_clock_that_is_off(ring, people, seen):
    late = 12
    cameras = ring(5)[np.array([0, 2])]
    keypoints, confidence = seen(cameras, walk(people, 200, radius=5.0))
    late_keypoints = keypoints[40:160].copy()
    late_keypoints[:, 1] = keypoints[40 - late : 160 - late, 1]
    # Tracking may find people who are none: rays of two people meet now and then.
    found = diagnose_no_people(
        *(cameras, ("cam0", "cam1"), detections(late_keypoints, confidence[40:160])),
        *(FPS, SETTINGS),
        **{"pitch_size": (105.0, 68.0), "rates": np.array([0.5, 2.0])},
    )
    assert found.cause == "clock"
    # In the frames of each camera, of which there are half and twice as many.
    assert "add +24 to offset_frames of cam1, or -6 to those of cam0" in found.message


def test_cameras_that_contradict_each_other(ring, people, seen):
    cameras = ring(5)[np.array([0, 2])]
    keypoints, confidence = seen(cameras, walk(people))
    wrong = cameras.cam_from_world.rotation.copy()
    wrong[1] = Rigid.from_rotvec([0.2, 0.0, 0.0], np.zeros(3)).rotation @ wrong[1]
    translation = -np.einsum("cij,cj->ci", wrong, cameras.center)
    turned = replace(cameras, cam_from_world=Rigid(wrong, translation))
    found = reason(turned, keypoints, confidence)
    assert found.cause == "cameras_contradict"
    assert "cam0 and cam1" in found.message


def test_cameras_that_show_other_places(ring, people, seen):
    cameras = ring(5)[np.array([0, 2])]
    away = np.array([[0.0, 0.0, 0.0], [60.0, 20.0, 0.0]])
    keypoints, confidence = seen(moved(cameras, cameras.center), walk(people))
    found = reason(moved(cameras, cameras.center + away), keypoints, confidence)
    assert found.cause == "one_camera_each"


def test_two_cameras_at_one_place(ring, people, seen):
    cameras = beside(ring, 0.0)
    found = reason(cameras, *seen(cameras, walk(people)))
    assert found.cause == "same_place"
    assert "cam0 and cam1" in found.message
