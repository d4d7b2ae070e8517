"""A calibration's unit and up axis follow from the people, or from what the user states."""

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from camera_builders import look_at_camera
from scipy.spatial.transform import Rotation

from data_contracts.keypoints import KeypointDetections
from worldpose.errors import InputError, UsageError
from worldpose.formats.calibration_unit import scaled
from worldpose.geometry.cameras import Camera
from worldpose.geometry.rigid import Rigid, Similarity
from worldpose.triangulation.reinterpretation import reinterpret_calibration
from worldpose.triangulation.world import (
    People,
    StatedWorld,
    doubt_statures,
    doubt_world,
    move_cameras,
    place_cameras,
    read_stated_world,
)

FPS = 25.0
NOTHING = StatedWorld()
CALIBRATION = Path("cal.mcal")
FLIP = np.diag([1.0, -1.0, -1.0])
LYING = np.array([[1.0, 0.0, 0.0], [0.0, 0.0, 1.0], [0.0, -1.0, 0.0]])
"""Rotation from people who stand along z to ones who lie along y."""


@pytest.fixture(autouse=True)
def calibration(tmp_path, monkeypatch):
    """A file whose ending tells that its cameras are in metres."""
    monkeypatch.chdir(tmp_path)
    CALIBRATION.touch()


def walk(people, frames=40):
    time = np.arange(frames)[:, None] / FPS
    turn = np.array([1.0, -0.7, 0.5]) * time + np.arange(3)
    return people(2.0 * np.stack([np.cos(turn), np.sin(turn)], axis=-1))


def records(cameras):
    return {f"c{n}": cameras[n].to_calibration(f"c{n}") for n in range(len(cameras.focal))}


def poses(keypoints, confidence):
    frame = np.arange(len(keypoints))
    return {
        f"c{n}": KeypointDetections.from_keypoints(keypoints[:, n], confidence[:, n], frame=frame)
        for n in range(keypoints.shape[1])
    }


def placed(true, given, keypoints, stated=NOTHING):
    """Errors of the placed cameras: tilt [degree], height [m], scale [1]; and the sentences."""
    found, notes = place_cameras(CALIBRATION, records(given), keypoints, FPS, stated)
    cameras = Camera.stack([Camera.from_calibration(each) for each in found.values()])
    turn = np.swapaxes(cameras.cam_from_world.rotation, -1, -2) @ true.cam_from_world.rotation
    tilt = float(np.degrees(np.arccos(np.clip(turn[:, 2, 2], -1.0, 1.0))).max())
    size = np.ptp(cameras.center[:, :2]) / np.ptp(true.center[:, :2])
    apart = [np.linalg.norm(each.center[1:] - each.center[0], axis=1) for each in (cameras, true)]
    assert size > 0.5
    height = float(np.abs(cameras.center[:, 2] - true.center[:, 2]).max())
    return tilt, height, float((apart[0] / apart[1]).mean()), notes


@pytest.mark.parametrize(
    ("unit_m", "turn", "said"),
    [
        (1.0, Rotation.identity(), ()),
        (0.001, Rotation.identity(), ("its unit is millimetres, by 3 people of",)),
        (0.3048, Rotation.identity(), ("feet",)),
        (1.0, Rotation.from_euler("x", -90, degrees=True), ("up is y", "90.0 degrees about x")),
        (1.0, Rotation.from_euler("x", 180, degrees=True), ("up is -z", "180.0 degrees about x")),
        (1.0, Rotation.from_euler("y", 90, degrees=True), ("up is x", "90.0 degrees about -y")),
        (0.001, Rotation.from_euler("xy", [110, 30], degrees=True), ("millimetres", "up is ")),
    ],
)
def test_people_tell_the_unit_the_vertical_and_the_ground(ring, people, seen, unit_m, turn, said):
    true = ring(4)
    keypoints = poses(*seen(true, walk(people)))
    turned = turn.magnitude() > 0.0
    shift = np.array([0.4, -0.3, 0.5]) / unit_m if turned else np.zeros(3)
    given = move_cameras(Similarity(np.array(1.0 / unit_m), turn.as_matrix(), shift), true)
    tilt, height, scale, notes = placed(true, given, keypoints)
    arbitrary = len(said) > 1 and said[0] == "millimetres"
    assert tilt < (1.0 if arbitrary else 1e-5)
    assert height < (0.3 if arbitrary else 0.05 if turned else 1e-9)  # 30 m away
    assert (scale, len(notes)) == (pytest.approx(1.0, abs=1e-9), 1)
    for text in said or ("its unit is metres, by 3 people of 1.7",):
        assert text in notes[0]


def test_what_the_user_states_holds(ring, people, seen):
    true = ring(4)
    keypoints = poses(*seen(true, walk(people)))
    turn = Rotation.from_euler("x", -90, degrees=True).as_matrix()
    given = move_cameras(Similarity(np.array(12.5), turn, np.zeros(3)), true)
    tilt, height, scale, notes = placed(true, given, {}, read_stated_world("0.08", "y"))
    assert (tilt, height, scale) == pytest.approx((0.0, 0.0, 1.0), abs=1e-5)
    assert "0.08 m, as stated; up is y" in notes[0]
    with pytest.raises(InputError, match=r"3 people of 2[0-9.]+ units.*make it 0.079"):
        place_cameras(CALIBRATION, records(given), keypoints, FPS, NOTHING)
    with pytest.raises(InputError, match=r"in millimetres, .* found 3 people of 1[.][0-9]+ units"):
        placed(true, true, keypoints, StatedWorld(0.001))
    # People who contradict the stated axis are told.
    notes = placed(true, true, keypoints, read_stated_world(None, "y"))[3]
    assert "the upright axis of people is z, not y as stated" in notes[1]


@pytest.mark.parametrize(
    ("change", "said"),
    [
        (lambda pose: pose.inverse(), "of the cameras in the world, not the other way"),
        (lambda pose: Rigid(FLIP @ pose.rotation, pose.translation @ FLIP), "as OpenGL's: turn"),
        (lambda pose: Rigid(pose.rotation.swapaxes(-1, -2), pose.translation), "transpose R"),
        (lambda pose: Rigid(pose.rotation, pose.inverse().translation), "write -R t"),
    ],
)
def test_poses_that_mean_something_else_are_refused_with_what_they_mean(
    ring, people, seen, change, said
):
    true = ring(4)
    given = replace(true, cam_from_world=change(true.cam_from_world))
    with pytest.raises(InputError, match=f"They agree if .*{said}"):
        placed(true, given, poses(*seen(true, walk(people))))


def test_points_with_y_before_x_are_refused(ring, people, seen):
    true = ring(4)
    given = {
        name: replace(each, keypoints=each.keypoints[..., ::-1])
        for name, each in poses(*seen(true, walk(people))).items()
    }
    with pytest.raises(InputError, match="agree alone if x and y are exchanged"):
        placed(true, true, given)


def test_a_calibration_of_larger_images_is_scaled_to_those_of_the_people(ring, people, seen):
    true = ring(4)
    middle = 3.0 * (true.principal_point + 0.5) - 0.5
    large = replace(
        true, focal=3.0 * true.focal, principal_point=middle, image_size=3 * true.image_size
    )
    detections = poses(*seen(true, walk(people)))
    found, notes = place_cameras(CALIBRATION, records(large), detections, FPS, NOTHING)
    assert "scaled by 0.33333" in notes[1]
    for name, camera in records(true).items():
        assert found[name].image_size == camera.image_size
        np.testing.assert_allclose(found[name].focal_px, camera.focal_px)
        np.testing.assert_allclose(found[name].principal_point_px, camera.principal_point_px)


def test_exchanged_sides_are_told(ring, people, seen):
    true = ring(4)
    joints = walk(people)
    sides = [0, *(n + 1 if n % 2 else n - 1 for n in range(1, 17))]
    assert People.of(joints, FPS).ahead == 1.0
    assert People.of(joints[:, :, sides], FPS).ahead == 0.0
    (*_, notes) = placed(true, true, poses(*seen(true, joints[:, :, sides])))
    assert "left and right are exchanged in all 2D poses" in notes[1]


def test_people_who_lie_turn_no_world_in_which_cameras_stand(ring, people, seen):
    true, lying = ring(4), walk(people) @ LYING.T
    given = records(true)
    keypoints = poses(*seen(true, lying + [0.0, 0.0, 1.0]))
    found, notes = place_cameras(CALIBRATION, given, keypoints, FPS, NOTHING)
    assert found == given
    assert "the cameras stand along z" in notes[1]
    assert doubt_world(true, People.of(lying, FPS)) == []
    turned = move_cameras(Similarity(np.array(1.0), LYING, np.zeros(3)), true)
    (said,) = doubt_world(turned, People.of(lying, FPS))
    assert "the upright axis of people is y, not z: 100% of 120 poses" in said
    assert "--up y" in said


def test_cameras_on_whom_no_people_agree_are_told_and_nearby_ones_cast_no_doubt(ring, people, seen):
    others = {}
    for n, (name, camera) in enumerate(records(ring(4)).items()):
        turn = Rotation.from_euler("z", 40 + 20 * n, degrees=True).as_matrix() @ camera.rotation
        others[name] = camera.model_copy(update={"rotation": tuple(map(tuple, turn.tolist()))})
    # Rays of cameras 1.5 m apart meet at 0.05 rad, which is too little for a position.
    near = Camera.stack(
        [
            look_at_camera([30.0, y, 6.0], (0.0, 0.0, 0.0), 1500.0, middle=(960.0, 540.0))
            for y in (0.0, 1.5)
        ]
    )
    for given, cameras, told in ((others, ring(4), True), (records(near), near, False)):
        keypoints = poses(*seen(cameras, walk(people)))
        _, notes = place_cameras(CALIBRATION, given, keypoints, FPS, NOTHING)
        assert any("no person is consistent between two" in note for note in notes) == told
        assert told or not any("consistent" in note or "agree" in note for note in notes), notes


def test_without_people_cameras_alone_decide(ring):
    near, far = (
        records(move_cameras(Similarity(np.array(scale), np.eye(3), np.zeros(3)), ring(4)))
        for scale in (1.0, 20.0)
    )
    found, (note,) = place_cameras(CALIBRATION, near, {}, FPS, NOTHING)
    assert found == near
    assert "taken as metres, which no people confirm: cameras stand up to 30 m" in note
    with pytest.raises(InputError, match=r"601 units from the middle.*--unit mm"):
        place_cameras(CALIBRATION, far, {}, FPS, NOTHING)
    assert place_cameras(CALIBRATION, far, {}, FPS, StatedWorld(1.0)) == (far, [])


@pytest.mark.parametrize(
    ("statures", "said"),
    [
        ([1.85] * 11, ""),
        ([1.6, 1.9], ""),
        ([1.82 / 0.9144] * 11, "it is 1.82 m if the calibration is in yards"),
        ([1.3] * 5, "0.76 times the true ones"),
    ],
)
def test_statures_that_no_adults_have(statures, said):
    found = doubt_statures(np.array(statures))
    assert said in found
    assert bool(found) == bool(said)


@pytest.mark.parametrize(
    ("unit", "up"), [("miles", None), ("-1", None), ("nan", None), (None, "w"), (None, "0,0,0")]
)
def test_options_that_state_nothing(unit, up):
    with pytest.raises(UsageError, match=f"found {unit} and {up}"):
        read_stated_world(unit, up)


def test_a_lens_that_folds_in_the_middle_is_refused_and_at_the_corners_told(ring):
    corner = float(np.hypot(*(ring(4)[0].image_size / 2)) / ring(4)[0].focal[0])

    def given(share):
        """r (1 + k1 r^2) grows up to r = 1 / sqrt(-3 k1), where it is two thirds of that."""
        k1 = -((2.0 / (3.0 * share * corner)) ** 2) / 3.0
        return records(replace(ring(4), distortion=np.tile([k1, *[0.0] * 7], (4, 1))))

    with pytest.raises(InputError, match=r"c0: distortion: expected a lens whose image radii grow"):
        place_cameras(CALIBRATION, given(0.5), {}, FPS, NOTHING)
    _, (_, warning, *_) = place_cameras(CALIBRATION, given(0.9), {}, FPS, NOTHING)
    assert "c0: the lens model folds within the image" in warning


@pytest.mark.parametrize("also", [1.0 / 3.0, 0.5])
def test_cameras_of_different_sizes_are_scaled_if_people_agree_at_one_size(ring, also):
    true = records(ring(2))
    size = np.array(true["c0"].image_size)
    focal = true["c0"].focal_px[0]
    true["c1"] = scaled(true["c1"], 0.5, tuple((size // 2).tolist()))
    large = {n: scaled(c, 3.0, tuple(3 * s for s in c.image_size)) for n, c in true.items()}
    # People all over the larger image, and one joint of 17 x 20 beyond its border.
    points = np.random.default_rng(3).uniform(0.0, 1.0, (20, 2, 1, 17, 2)) * size
    points[:, 1] /= 2.0
    points[0, 0, 0, 0] = size + 40.0
    seen = KeypointDetections.from_keypoints(points, np.ones(points.shape[:-1]))
    wanted = 3.0 * focal * np.array([1.0 / 3.0, also])

    def agree(batch):
        return bool(np.isclose(batch.focal[0, 0], wanted).any())

    found, notes = reinterpret_calibration(CALIBRATION, large, seen, agree)
    if also == 0.5:
        assert found == large
        assert "but do if scaled by 0.33333 and 0.50000" in notes[0]
    else:
        assert [found[name].image_size for name in true] == [c.image_size for c in true.values()]
        both = " and ".join("{} x {}".format(*c.image_size) for c in true.values())
        assert f"scaled by 0.33333, to images of {both} px: of the usual ratios" in notes[0]


def test_exchanged_axes_are_found_with_tangential_lenses(ring):
    true = ring(2)
    true = replace(true, distortion=true.distortion + [0, 0, 0.01, -0.02, 0, 0, 0, 0])
    places = np.random.default_rng(0).uniform(-1.0, 1.0, (9, 3))
    seen = true[0].project(places)[..., ::-1]

    def agree(batch):
        return np.allclose(batch[0].project(places), seen)

    with pytest.raises(InputError, match="Write x first, then y"):
        reinterpret_calibration(CALIBRATION, records(true), None, agree)
