"""Cameras with one planted fault each; people are rigid bodies that walk straight on."""

from dataclasses import replace

import numpy as np
import pytest
from camera_builders import look_at_camera

from data_contracts.conventions import COCO17_FLIP
from data_contracts.keypoints import KeypointDetections
from worldpose.camera_consistency.consistency import check_consistency, describe_faults
from worldpose.camera_consistency.diagnosis import Consistency, Fault
from worldpose.camera_consistency.hypotheses import lens_hypotheses
from worldpose.camera_consistency.settings import ConsistencySettings
from worldpose.geometry.cameras import Camera
from worldpose.geometry.lens_models import LensModel
from worldpose.geometry.rigid import Rigid

SETTINGS = ConsistencySettings(sample_frames=18)
PITCH = (105.0, 68.0)
FRAMES, FPS = 100, 25.0
FIGURE = np.array(
    [
        *((0.1, 0.0, 1.65), (0.08, 0.03, 1.68), (0.08, -0.03, 1.68)),
        *((0.0, 0.07, 1.66), (0.0, -0.07, 1.66), (0.0, 0.18, 1.42), (0.0, -0.18, 1.42)),
        *((0.05, 0.25, 1.15), (0.05, -0.25, 1.15), (0.2, 0.25, 0.95), (0.2, -0.25, 0.95)),
        *((0.0, 0.12, 0.92), (0.0, -0.12, 0.92), (0.1, 0.12, 0.5), (-0.1, -0.12, 0.5)),
        *((0.15, 0.12, 0.08), (-0.15, -0.12, 0.08)),
    ]
)


def looking(center, target, focal=1500.0, distortion=(-0.1, 0.05, 0.0, 0.0, 0.0)):
    return look_at_camera(center, target, focal, lens=distortion)


def rig():
    """Five cameras around the right half of the pitch."""
    places = [(5, -42, 9), (30, -45, 14), (62, -10, 7), (58, 25, 11), (20, 44, 18)]
    return [looking(place, (22.0 + n, 2.0 - n, 1.0)) for n, place in enumerate(places)]


def walkers(count=6, seed=4):
    """People (FRAMES, count, 17, 3) [m] who walk straight on at 1 to 5 m/s."""
    rng = np.random.default_rng(seed)
    start = rng.uniform([10, -12], [35, 14], (count, 2))
    angle = rng.uniform(0, 2 * np.pi, count)
    way = rng.uniform(1, 5, count)[:, None] * np.stack([np.cos(angle), np.sin(angle)], axis=-1)
    places = start + np.arange(FRAMES)[:, None, None] / FPS * way
    turn = np.zeros((count, 3, 3))
    turn[:, 0, 0] = turn[:, 1, 1] = np.cos(angle)
    turn[:, 1, 0], turn[:, 0, 1], turn[:, 2, 2] = np.sin(angle), -np.sin(angle), 1.0
    world = (FIGURE @ turn.swapaxes(-1, -2))[None].repeat(FRAMES, axis=0)
    world[..., :2] += places[:, :, None]
    return world


def seen(cameras, world, seed=0):
    """Detections (FRAMES, cameras, people, 17, 2) [px] with a pixel of noise, in random order."""
    rng = np.random.default_rng(seed)
    image = np.stack([c.project(world.reshape(len(world), -1, 3)) for c in cameras], axis=1)
    image = image.reshape(len(world), len(cameras), *world.shape[1:3], 2)
    inside = (image >= 0) & (image < [1920, 1080])
    image = np.where(inside.all(-1, keepdims=True), image, np.nan)
    image += rng.normal(0, 1.0, image.shape)
    return image[:, :, rng.permutation(image.shape[2])]


def check(cameras, keypoints, covariance=None, pitch=PITCH):
    confidence = np.where(np.isfinite(keypoints[..., 0]), 0.8, np.nan)
    return check_consistency(
        Camera.stack(cameras),
        covariance,
        KeypointDetections.from_keypoints(keypoints, confidence),
        FPS,
        SETTINGS,
        ground=pitch is not None,
    )


def named(result):
    return [(fault.camera, fault.kind) for fault in result.faults]


def posed(camera, rotation, translation):
    return replace(camera, cam_from_world=Rigid(rotation, translation))


def stated(camera, kind):
    """The camera with a fault in its calibration."""
    rotation, t = camera.cam_from_world.rotation, camera.cam_from_world.translation
    if kind == "flipped":
        return posed(camera, rotation @ np.diag([-1.0, -1.0, 1.0]), t)
    if kind == "mirrored":
        flip = np.diag([-1.0, 1.0, 1.0])
        return posed(camera, flip @ rotation @ np.diag([1.0, -1.0, 1.0]), flip @ t)
    if kind == "focal":
        return replace(camera, focal=camera.focal * 1.1)
    if kind == "pose":
        return posed(camera, rotation, t * 1000.0)
    assert kind == "degrees"
    turned = Rigid.from_rotvec(np.degrees(camera.cam_from_world.rotvec), t)
    return replace(camera, cam_from_world=turned)


@pytest.mark.parametrize("pitch", [PITCH, None])
def test_cameras_that_agree_are_confirmed(pitch):
    cameras = rig()
    result = check(cameras, seen(cameras, walkers()), pitch=pitch)
    assert (result.faults, result.confirmed) == ((), (0, 1, 2, 3, 4))


@pytest.mark.parametrize("kind", ["flipped", "mirrored", "both", "focal", "pose", "degrees"])
def test_a_wrong_calibration_is_named_with_its_fault(kind):
    cameras = rig()
    keypoints = seen(cameras, walkers())
    if kind == "both":  # a mirrored image, whose clicks have exchanged names
        keypoints[:, 3] = (keypoints[:, 3] * [-1.0, 1.0] + [1919.0, 0.0])[..., COCO17_FLIP, :]
    cameras[3] = stated(cameras[3], "mirrored" if kind == "both" else kind)
    result = check(cameras, keypoints)
    assert named(result) == [(3, {"degrees": "pose", "both": "mirrored"}.get(kind, kind))]
    assert result.confirmed == (0, 1, 2, 4)
    fault = result.faults[0]
    assert fault.share_corrected > max(0.8, fault.share_now)
    if kind == "focal":
        assert fault.value == pytest.approx(1.1, abs=0.02)
    details = {"degrees": "degrees", "both": "its images are mirrored, and so are the names"}
    assert details.get(kind, "") in fault.detail


def test_cameras_of_another_match_are_strangers_without_a_diagnosis():
    keypoints = seen(rig(), walkers())
    others = [(-5, -50, 12), (45, -38, 8), (55, 5, 16), (40, 40, 9), (5, 52, 10)]
    result = check([looking(place, (25.0, 1.0, 1.0)) for place in others], keypoints)
    assert (result.faults, result.strangers) == ((), (0, 1, 2, 3, 4))


def people_everywhere(seed):
    rng, world = np.random.default_rng(seed), walkers(22, seed)
    places = rng.uniform([-50, -32], [50, 32], (22, 2))
    world[..., :2] += (places - world[0, :, :, :2].mean(axis=1))[None, :, None]
    return rng, world


def low_cameras(places, focal=1500.0):
    return [looking(place, (0.0, 0.0, 1.0), focal, distortion=(0.0,) * 5) for place in places]


@pytest.mark.parametrize("still", [False, True])
def test_low_cameras_and_people_who_stand_show_no_strangers(still):
    rng, world = people_everywhere(0)
    world = world[:1].repeat(FRAMES, axis=0) if still else world
    cameras = low_cameras([(0, -45, 2.5), (50, -40, 2.5), (-60, 0, 2.5)])
    # Detectors place joints with habits of 2 cm, different in each view.
    views = [
        seen([each], world + rng.normal(0, 0.02, (17, 3)), n) for n, each in enumerate(cameras)
    ]
    keypoints = np.concatenate(views, axis=1)
    result = check(cameras, keypoints + rng.normal(0, 1.7, keypoints.shape))
    assert (result.faults, result.strangers) == ((), ())
    assert result.unconfirmed == (0, 1, 2)


@pytest.mark.parametrize("height", [2.5, 5.0])
def test_low_cameras_of_another_match_are_strangers(height):
    true, others = (
        low_cameras([(*place, height) for place in places], 900.0)
        for places in ([(0, -45), (50, -40), (-60, 0)], [(20, -50), (-40, -45), (60, 10)])
    )
    result = check(others, seen(true, people_everywhere(3)[1]))
    assert result.faults == () and len(result.strangers) >= 2  # some pairs tell nothing


@pytest.mark.parametrize("change", ["axes", "unit"])
def test_a_wrong_world_is_no_fault_of_its_cameras(change):
    cameras = rig()
    keypoints = seen(cameras, walkers())
    turn = np.array([[1.0, 0.0, 0.0], [0.0, 0.0, 1.0], [0.0, -1.0, 0.0]])
    for n, camera in enumerate(cameras):
        pose = camera.cam_from_world
        unit = 1000.0 if change == "unit" else 1.0
        rotation = pose.rotation if change == "unit" else pose.rotation @ turn.T
        cameras[n] = posed(camera, rotation, unit * pose.translation)
    result = check(cameras, keypoints)
    assert (result.faults, result.strangers) == ((), ())


@pytest.mark.parametrize(
    ("frames", "kind", "value"),
    # The other camera shows frames 9 earlier, or 50 frames per second stated as 25.
    [(np.arange(FRAMES) - 9, "clock", 9), (np.arange(FRAMES) // 2, "frame_rate", 2)],
)
def test_a_wrong_clock_or_frame_rate_is_named(frames, kind, value):
    cameras = rig()
    keypoints = seen(cameras, walkers())
    shown = (frames >= 0) & (frames < FRAMES)
    keypoints[shown, 2], keypoints[~shown, 2] = keypoints[frames[shown], 2], np.nan
    result = check(cameras, keypoints)
    assert named(result) == [(2, kind)]
    assert result.faults[0].value == pytest.approx(value, abs=1)


def test_exchanged_videos_of_two_cameras_are_named():
    cameras = rig()
    keypoints = seen(cameras, walkers())
    keypoints[:, [1, 3]] = keypoints[:, [3, 1]]
    result = check(cameras, keypoints)
    assert sorted(named(result)) == [(1, "swapped"), (3, "swapped")]
    assert {fault.camera: fault.other for fault in result.faults} == {1: 3, 3: 1}


def test_two_right_cameras_name_the_fault_of_a_third():
    cameras = rig()[:3]
    keypoints = seen(cameras, walkers())
    cameras[1] = stated(cameras[1], "flipped")
    assert named(check(cameras, keypoints)) == [(1, "flipped")]


def test_two_pairs_of_cameras_contradict_each_other_where_no_majority_decides():
    cameras = [looking((x, y, 15), (x / 4, 0, 1)) for x in (-45, 45) for y in (-60, 60)]
    keypoints = seen(cameras, walkers() - [22.0, 0.0, 0.0])
    keypoints[:, [1, 2]] = keypoints[:, [2, 1]]  # of two cameras opposite to each other
    result = check(cameras, keypoints)
    first, second = (fault.camera for fault in result.faults)
    assert {first, second, *result.confirmed} == {0, 1, 2, 3}
    said = describe_faults(result, "abcd", [0] * 4, np.ones(4), FPS)
    for each, other in zip(said, (second, first), strict=True):
        assert "no majority tells which of them is wrong" in each.reason
        assert "half a turn" in each.reason or f"that of camera {'abcd'[other]}" in each.reason


@pytest.mark.parametrize("cameras", [1, 5])
def test_without_people_nothing_is_known(cameras):
    result = check(rig()[:cameras], np.full((FRAMES, cameras, 1, 17, 2), np.nan))
    assert (result.faults, result.confirmed) == ((), ())
    assert result.unconfirmed == tuple(range(cameras))


def test_a_calibration_error_within_its_covariance_is_no_fault():
    cameras = rig()
    keypoints = seen(cameras, walkers())
    cameras[1] = replace(cameras[1], focal=cameras[1].focal * 1.04)
    covariance = np.full((5, 12, 12), np.nan)
    covariance[1] = np.diag([1e-6] * 3 + [1e-4] * 3 + [0.02**2] + [0.0] * 5)
    assert check(cameras, keypoints, covariance).faults == ()


def test_four_coefficients_of_a_fisheye_read_as_browns_are_a_hypothesis():
    true = replace(
        look_at_camera((0.0, -20.0, 8.0), (0.0, 0.0, 1.0), 800.0),
        distortion=np.array([-0.05, 0.01, 0.0, 0.0, -0.002, 0.0005, 0.0, 0.0]),
        lens_model=LensModel.FISHEYE,
    )
    read = replace(true, distortion=[-0.05, 0.01, -0.002, 0.0005, 0.0], lens_model=LensModel.BROWN)
    found = next(each for each in lens_hypotheses(read) if "fisheye" in each.detail)
    np.testing.assert_array_equal(found.camera.numbers, true.numbers)
    orders = [each for each in lens_hypotheses(true) if "order" in each.detail]
    assert not orders  # the order of a fisheye's coefficients is not in doubt


def test_a_camera_with_a_frame_rate_of_its_own_is_told_its_own_frames():
    faults = Fault(1, "clock", value=10.0), Fault(1, "frame_rate", value=0.5)
    found = Consistency(faults, (0,), (), np.zeros((2, 2)))
    clock, rate = describe_faults(found, "ab", [0, 20], np.array([1.0, 2.0]), 50.0)
    assert "10 match frames earlier than the others: set its clock offset to 40" in clock.reason
    assert "about 50 frames per second, not 100" in rate.reason
