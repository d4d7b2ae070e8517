"""Cameras of a known scene are found from a walking person, or refused where nothing tells them."""

from dataclasses import replace

import numpy as np
import pytest
from camera_builders import look_at_camera

from data_contracts.cameras import LensCalibration
from data_contracts.keypoints import KeypointDetections
from worldpose.bundle_adjustment.people_cameras import KnownLength, locate_cameras
from worldpose.errors import InputError
from worldpose.geometry.cameras import Camera
from worldpose.geometry.lens_models import LensModel
from worldpose.geometry.rigid import align
from worldpose.simulation.scenarios import SCENARIOS
from worldpose.simulation.scene import simulate_scene

FPS = 50.0
SIZE = (1280, 960)
FOCAL = 900.0
NAMES = ("north", "east", "south", "west")


@pytest.fixture(scope="module")
def walkers():
    """Joints (frames, 2, 17, 3) of the two people who walk farthest, near the origin."""
    tiny = SCENARIOS["tiny"]
    scene = simulate_scene(tiny.model_copy(update={"duration": 10.0, "broadcast": ()}), 3)
    joints = scene.truth.joints
    middle = joints[:, :, [11, 12]].mean(axis=2)
    way = np.linalg.norm(np.ptp(middle, axis=0)[:, :2], axis=1)
    chosen = np.argsort(-way)[:2]
    found = joints[:, chosen]
    return found - np.array([*found[:, 0, :, :2].reshape(-1, 2).mean(axis=0), 0.0])


@pytest.fixture(scope="module")
def cameras(walkers):
    """Four cameras around the first person's way, all in front of it."""
    reach = float(np.abs(walkers[:, 0, :, :2]).max())
    found = []
    for n, angle in enumerate(np.radians([20.0, 110.0, 215.0, 300.0])):
        far = reach + 5.0 + 0.7 * n
        center = (far * np.cos(angle), far * np.sin(angle), 1.5 + 0.5 * n)
        found.append(
            look_at_camera(
                *(center, (0.0, 0.0, 0.9), FOCAL, SIZE),
                middle=(640.0 + n, 470.0 + n),
                lens=(-0.05, 0.01, 0.0, 0.0, 0.0),
                roll=0.02 * n,
            )
        )
    return Camera.stack(found)


def lens(camera, name, focal_std=2.0, focal=None):
    return LensCalibration(
        id=name,
        image_size=SIZE,
        focal_px=float(camera.focal[0]) if focal is None else focal,
        principal_point_px=tuple(camera.principal_point.tolist()),
        distortion=tuple(camera.coefficients.tolist()),
        lens_model=LensModel(int(camera.lens_model)).label,
        focal_std_px=focal_std,
        principal_point_std_px=2.0,
        distortion_std=0.005,
    )


def lenses(cameras, **about):
    return [lens(cameras[c], name, **about) for c, name in enumerate(NAMES[: len(cameras.focal)])]


def seen(cameras, joints, noise=1.5):
    """Detections of people (frames, persons, 17, 3) with Gaussian noise [px]."""
    rng = np.random.default_rng(4)
    views = []
    for c in range(len(cameras.focal)):
        pixels = cameras[c].project(joints.reshape(-1, 3)).reshape(*joints.shape[:-1], 2)
        inside = ((pixels >= 0) & (pixels < SIZE)).all(axis=-1)
        pixels = pixels + rng.normal(0.0, noise, pixels.shape)
        views.append(np.where(inside[..., None], pixels, np.nan))
    keypoints = np.stack(views, axis=1)
    confidence = np.where(np.isfinite(keypoints[..., 0]), 0.9, np.nan)
    return KeypointDetections.from_keypoints(keypoints, confidence)


FISHEYE = [-0.08, 0.02, 0.0, 0.0, -0.01, 0.002, 0.0, 0.0]


@pytest.mark.parametrize("fisheye", [False, True])
def test_a_walking_person_locates_four_cameras_in_metres(walkers, cameras, fisheye):
    if fisheye:
        cameras = replace(cameras, distortion=np.array(FISHEYE), lens_model=LensModel.FISHEYE)
    apart = float(np.linalg.norm(cameras.center[0] - cameras.center[2]))
    found = locate_cameras(
        lenses(cameras), seen(cameras, walkers[:, :1]), FPS, KnownLength(apart, (0, 2), 0.005)
    )
    motion = align(found.cameras.center, cameras.center, with_scale=False)
    off = np.linalg.norm(motion.apply(found.cameras.center) - cameras.center, axis=1)
    assert off.max() < 0.05
    assert (off < 4.0 * found.std[:, 0] + 0.02).all()
    turned = found.cameras.cam_from_world.rotation @ motion.rotation.T
    angle = np.arccos(
        np.clip(
            0.5 * (np.einsum("cij,cij->c", turned, cameras.cam_from_world.rotation) - 1.0),
            -1.0,
            1.0,
        )
    )
    assert np.degrees(angle).max() < 0.5
    # The world's z is up, its origin on the ground.
    tilt = np.arccos(np.clip((motion.rotation @ [0.0, 0.0, 1.0])[2], -1.0, 1.0))
    assert tilt < max(3.0 * found.up_std, np.radians(1.0))
    assert abs(motion.apply(np.zeros((1, 3)))[0, 2]) < 0.08
    assert found.people == 1
    assert found.residual_px.max() < 3.0
    assert found.held_out_px.max() < 4.0
    assert 0.0 < found.coverage.min() <= found.coverage.max() <= 1.0


def test_stature_gives_the_scale_within_its_deviation(walkers, cameras):
    top = walkers[:, 0, :5, 2].max(axis=1) - walkers[:, 0, 15:, 2].min(axis=1)
    # Eyes are 0.11 m below the top of the head, ankles 0.08 m above the ground.
    stature = float(np.median(top)) + 0.19
    found = locate_cameras(
        lenses(cameras), seen(cameras, walkers[:, :1]), FPS, KnownLength(stature)
    )
    scale = float(align(found.cameras.center, cameras.center, with_scale=True).scale)
    assert abs(np.log(scale)) < 3.0 * found.scale_std
    assert found.stature_m == pytest.approx(stature)


def without(detections, camera, frames):
    """The detections without those of a camera in some frames."""
    confidence = detections.confidence.copy()
    confidence[frames, camera] = np.nan
    return replace(detections, confidence=confidence)


def stand_still(seen_by, walkers):
    first = walkers[:1] - np.array([*walkers[0, 0, 11, :2], 0.0])
    return seen_by(np.repeat(first, len(walkers), axis=0))


def show_apart(seen_by, walkers):
    half = len(walkers) // 2
    return without(without(seen_by(walkers), 0, slice(half, None)), 1, slice(None, half - 5))


def show_another(seen_by, walkers):
    given = seen_by(walkers)
    keypoints = given.keypoints.copy()
    keypoints[:, 1] = keypoints[::-1, 1] * [-1.0, 1.0] + [1280.0, 0.0]
    return replace(given, keypoints=keypoints)


@pytest.mark.parametrize(
    ("count", "show", "message"),
    [
        (1, lambda seen_by, walkers: seen_by(walkers), "north: expected two cameras or more"),
        (4, stand_still, "found people who stand still"),
        (2, show_apart, "in two cameras at once for 20 frames, found 5"),
        (
            4,
            lambda seen_by, walkers: without(seen_by(walkers), 2, slice(None)),
            "south: expected a person for 20 frames or more",
        ),
        (4, show_another, "east: expected a person for 20 frames that"),
    ],
    ids=["one camera", "still", "too few frames", "nobody", "another person"],
)
def test_people_who_determine_no_cameras_are_refused(walkers, cameras, count, show, message):
    given = show(lambda joints: seen(cameras[:count], joints), walkers[:, :1])
    with pytest.raises(InputError, match=message):
        locate_cameras(lenses(cameras)[:count], given, FPS, KnownLength(1.8))


def test_groups_that_show_different_people_are_named(walkers, cameras):
    first, second = (seen(cameras, walkers[:, p : p + 1] * flip) for p, flip in ((0, 1), (1, -1)))
    keypoints = np.concatenate([first.keypoints, second.keypoints[::-1]], axis=1)
    both = KeypointDetections.from_keypoints(
        keypoints, np.where(np.isfinite(keypoints[..., 0]), 0.9, np.nan)
    )
    halls = [lens(cameras[c], f"{hall}{c}") for hall in "ab" for c in range(4)]
    with pytest.raises(InputError, match="2 groups that share no person: a0, a1, a2, a3; b0, b1"):
        locate_cameras(halls, both, FPS, KnownLength(1.8))
