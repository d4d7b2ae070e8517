"""Every broken convention is named, and a sound data set is left alone."""

import shutil

import numpy as np
import pytest

from data_contracts.conventions import COCO17
from worldpose.body import BodyParameters, fold_keypoints, load_open_body
from worldpose.cameras import Camera, Rigid
from worldpose.errors import InputError
from worldpose.release import JointTracks, coco_dataset, write_coco, write_joints
from worldpose.release.camera_file import write_moving_camera, write_static_camera
from worldpose.release.challenge import challenge_truth
from worldpose.release.challenge_files import read_submission, write_challenge, write_submission
from worldpose.release.check import CheckSettings, check_clip
from worldpose.release.check_reading import clips_in, read_clip
from worldpose.release.pose_file import write_poses

FRAMES, PERSONS, FPS = 40, 6, 50.0
Y_DOWN = np.array([[1.0, 0.0, 0.0], [0.0, 0.0, -1.0], [0.0, 1.0, 0.0]])
"""Takes the world x, y, z to x, -z, y."""


@pytest.fixture(scope="module")
def model():
    return load_open_body()


@pytest.fixture(scope="module")
def poses(model):
    """People who run about with moving limbs; one is missing for a while."""
    rng = np.random.default_rng(3)
    time = np.arange(FRAMES)[None, :, None] / FPS
    heading = rng.uniform(-np.pi, np.pi, (PERSONS, 1))
    velocity = 5.0 * np.concatenate([np.cos(heading), np.sin(heading)], axis=-1)
    ground = rng.uniform(-12.0, 12.0, (PERSONS, 1, 2)) + velocity[:, None] * time
    body_pose = 0.3 * rng.standard_normal((PERSONS, 1, 69))
    body_pose = body_pose * np.sin(8.0 * time + rng.uniform(0.0, 6.0, (PERSONS, 1, 1)))
    orient = np.empty((PERSONS, FRAMES, 3))
    upright = np.array([np.pi / 2, 0.0, 0.0])
    for person in range(PERSONS):
        turn = Rigid.from_rotvec(np.array([0.0, 0.0, heading[person, 0]]), np.zeros(3))
        whole = turn @ Rigid.from_rotvec(upright, np.zeros(3))
        orient[person] = whole.rotvec
    betas = 0.5 * rng.standard_normal((PERSONS, 1, 10))
    transl = np.concatenate([ground, np.zeros((PERSONS, FRAMES, 1))], axis=-1)
    standing = BodyParameters(betas, orient, body_pose, transl)
    lowest = model.vertices(standing)[..., 2].min(-1)
    transl[..., 2] -= lowest
    transl[1, 10:20], orient[1, 10:20], body_pose[1, 10:20] = np.nan, np.nan, np.nan
    return BodyParameters(betas, orient, body_pose, transl)


def looking(center, target, focal, distortion=(0.0,) * 5):
    """A camera at a place that looks at another with the horizon level."""
    center, target = np.asarray(center, float), np.asarray(target, float)
    forward = (target - center) / np.linalg.norm(target - center)
    right = np.cross(forward, [0.0, 0.0, 1.0])
    right /= np.linalg.norm(right)
    rotation = np.stack([right, np.cross(forward, right), forward])
    return Camera(
        focal=np.full(2, float(focal)),
        principal_point=np.array([960.0, 540.0]),
        distortion=np.array(distortion),
        cam_from_world=Rigid(rotation, -rotation @ center),
        image_size=np.array([1920, 1080]),
    )


LENS = (0.05, 0.02, 0.004, -0.003, 0.03)


@pytest.fixture(scope="module")
def cameras():
    return {
        "north": looking([5.0, 55.0, 14.0], [0.0, 0.0, 0.0], 2000.0, LENS),
        "south": looking([-8.0, -60.0, 11.0], [1.0, 0.0, 0.0], 2300.0, LENS),
        "east": looking([70.0, -10.0, 17.0], [0.0, 1.0, 0.0], 2500.0, LENS),
    }


@pytest.fixture(scope="module")
def main_camera():
    """The broadcast camera, which pans and zooms from one place."""
    rows = [
        looking([0.0, -75.0, 15.0], [x, 0.0, 0.0], 3000.0 + 5.0 * n, (0.3, 0.9, 0.0, 0.0, 0.0))
        for n, x in enumerate(np.linspace(-4.0, 4.0, FRAMES))
    ]
    return Camera.stack(rows)


@pytest.fixture(scope="module")
def written(model, poses, cameras, main_camera, tmp_path_factory):
    """Sound data sets by kind: with 2D of static cameras, without 2D, the challenge's."""
    folder = tmp_path_factory.mktemp("sets")
    joints = fold_keypoints(model, COCO17)(poses).swapaxes(0, 1)
    tracks = JointTracks(np.arange(FRAMES), np.arange(PERSONS), joints)
    for kind in ("static", "plain", "challenge"):
        write_poses(folder / kind / "poses" / "A_1.npz", poses, model.name)
    for name, camera in cameras.items():
        for kind in ("static", "plain"):
            calibration = camera.to_calibration(name)
            write_static_camera(folder / kind / "cameras" / f"{name}.npz", calibration)
        dataset = coco_dataset(name, camera, tracks, np.ones(joints.shape[:3], bool))
        write_coco(folder / "static" / f"{name}.json", dataset)
    write_joints(folder / "static" / "joints.npz", tracks)
    for kind in ("plain", "challenge"):
        write_moving_camera(folder / kind / "cameras" / "A_1.npz", main_camera)
    truth = challenge_truth(model, poses, main_camera)
    assert len(truth.persons) == PERSONS, "all must be in sight for rows to be those of the poses"
    write_challenge(folder / "challenge", {"A_1": truth.clip}, 2026)
    write_submission(folder / "challenge" / "submission.zip", {"A_1": truth.submission})
    return folder


@pytest.fixture
def data_set(written, tmp_path):
    """Gives a copy of a data set to be spoilt."""

    def copy(kind):
        return shutil.copytree(written / kind, tmp_path / kind)

    return copy


def findings(folder, model, pitch=True):
    clips = clips_in(folder)
    clip = read_clip(folder, clips[0], clips, lambda name: model, None, FPS, pitch)
    return check_clip(clip, CheckSettings())


def edit(path, change):
    """Change the arrays of an npz file in place."""
    with np.load(path) as file:
        arrays = {name: file[name] for name in file.files}
    change(arrays)
    np.savez(path, **arrays)


def edit_cameras(folder, change):
    for path in sorted((folder / "cameras").glob("*.npz")):
        edit(path, change)


def edit_poses(folder, change):
    edit(folder / "poses" / "A_1.npz", change)


def edit_joints(folder, change):
    edit(folder / "joints.npz", change)


def transpose_rotation(arrays):
    arrays["R"] = arrays["R"].swapaxes(-1, -2)


def center_for_translation(arrays):
    arrays["t"] = -np.einsum("fba,fb->fa", arrays["R"], arrays["t"])


def camera_to_world(arrays):
    center_for_translation(arrays)
    transpose_rotation(arrays)


def turn_poses(arrays, axes, model):
    """Turn whole bodies, as a writer does who knows where the pivot is."""
    pelvis = model.joint_template[0] + arrays["betas"] @ model.joint_directions[0].T
    turn = Rigid(axes, np.zeros(3))
    whole = turn @ Rigid.from_rotvec(arrays["global_orient"].astype(float), np.zeros(3))
    arrays["global_orient"] = whole.rotvec
    pelvis = pelvis[:, None]
    arrays["transl"] = (arrays["transl"] + pelvis) @ axes.T - pelvis


def about_origin(arrays, model):
    pelvis = model.joint_template[0] + arrays["betas"] @ model.joint_directions[0].T
    rotation = Rigid.from_rotvec(arrays["global_orient"].astype(float), np.zeros(3)).rotation
    pelvis = pelvis[:, None]
    arrays["transl"] = arrays["transl"] + pelvis - np.einsum("pfab,pqb->pfa", rotation, pelvis)


def late_poses(arrays):
    for name in ("transl", "global_orient", "body_pose"):
        arrays[name] = np.roll(arrays[name], 1, axis=1)
        arrays[name][:, 0] = np.nan


def zeros_for_missing(arrays):
    for name in ("transl", "global_orient", "body_pose"):
        arrays[name] = np.nan_to_num(arrays[name])


def in_degrees(arrays):
    for name in ("global_orient", "body_pose"):
        arrays[name] = np.degrees(arrays[name])


def scaled(name, size):
    def change(arrays):
        arrays[name] = arrays[name] * size

    return change


def axes_of(name, axes):
    def change(arrays):
        arrays[name] = arrays[name] @ np.asarray(axes, dtype=float).T

    return change


def test_a_sound_data_set_passes(written, model):
    for kind, compared in (("static", True), ("plain", False), ("challenge", True)):
        figures, found = findings(written / kind, model)
        assert found == []
        assert (figures.frames, figures.persons) == (FRAMES, PERSONS)
        assert figures.plausible_share == 1.0
        assert (figures.reprojection_median_px is not None) == compared
        if compared:
            # COCO is rounded to a hundredth of a pixel, poses and submissions to single precision.
            assert figures.reprojection_median_px < 0.05


CAMERA = {
    "transposed_rotation": transpose_rotation,
    "translation_is_center": center_for_translation,
    "camera_to_world": camera_to_world,
    "negated_translation": scaled("t", -1.0),
    "camera_in_millimetres": scaled("t", 1000.0),
}


@pytest.mark.parametrize("kind", ["static", "plain", "challenge"])
@pytest.mark.parametrize("fault", CAMERA)
def test_a_fault_of_cameras_is_named(data_set, model, kind, fault):
    folder = data_set(kind)
    edit_cameras(folder, CAMERA[fault])
    _, found = findings(folder, model)
    assert {each.fault for each in found} == {fault}
    places = {place for each in found for place in each.where if place.startswith("cameras/")}
    expected = {f"cameras/{path.stem}" for path in (folder / "cameras").glob("*.npz")}
    if kind == "plain":
        # Looking straight along -y, R is nearly symmetric, and without 2D nothing is amiss.
        expected -= {"cameras/north"} - places
    assert places == expected


def test_a_camera_of_a_part_of_the_pitch_where_nobody_comes_is_sound(data_set, model):
    folder = data_set("plain")
    corner = looking([60.0, 40.0, 12.0], [50.0, 32.0, 0.0], 4000.0)
    write_static_camera(folder / "cameras" / "corner.npz", corner.to_calibration("corner"))
    assert findings(folder, model)[1] == []
    # Turned by half a turn about the vertical it looks out of the stadium.
    half = np.diag([-1.0, -1.0, 1.0])
    edit(
        folder / "cameras" / "corner.npz",
        lambda a: a.update(
            R=a["R"] @ half, t=a["t"] + (a["R"] @ half - a["R"])[0] @ [-60.0, -40.0, -12.0]
        ),
    )
    (found,) = findings(folder, model)[1]
    assert (found.fault, found.where) == ("sees_nobody", ("cameras/corner",))


def test_the_one_camera_that_is_wrong_is_named(data_set, model):
    folder = data_set("static")
    edit(folder / "cameras" / "east.npz", transpose_rotation)
    _, found = findings(folder, model)
    assert {each.fault for each in found} == {"transposed_rotation"}
    assert {p for f in found for p in f.where if p.startswith("cameras/")} == {"cameras/east"}


@pytest.mark.parametrize("order", [[0, 1, 4, 2, 3], [2, 3, 0, 1, 4]])
def test_a_lens_in_the_wrong_order_is_named(data_set, model, order):
    folder = data_set("static")
    edit_cameras(folder, lambda a: a.update(k=a["k"][:, order]))
    assert {each.fault for each in findings(folder, model)[1]} == {"distortion_order"}


def test_a_lens_of_two_coefficients_in_the_place_of_others_is_named(data_set, model):
    folder = data_set("challenge")
    edit_cameras(folder, lambda a: a.update(k=a["k"][:, [2, 3, 0, 1, 4]]))
    found = findings(folder, model)[1]
    assert {each.fault for each in found} == {"distortion_order"}
    assert {each.says[:19] for each in found} == {"k is p1 p2 k1 k2 k3"}


POSES = {
    "millimetres": lambda a, model: scaled("transl", 1000.0)(a),
    "centimetres": lambda a, model: scaled("transl", 100.0)(a),
    "y_down_world": lambda a, model: turn_poses(a, Y_DOWN, model),
    "y_up_world": lambda a, model: turn_poses(a, Y_DOWN.T, model),
    "root_about_origin": about_origin,
    "degrees": lambda a, model: in_degrees(a),
    "zeros_for_missing": lambda a, model: zeros_for_missing(a),
}


@pytest.mark.parametrize("kind", ["static", "plain", "challenge"])
@pytest.mark.parametrize("fault", POSES)
def test_a_fault_of_poses_is_named(data_set, model, kind, fault):
    folder = data_set(kind)
    edit_poses(folder, lambda arrays: POSES[fault](arrays, model))
    _, found = findings(folder, model)
    assert {each.fault for each in found} == {fault}
    assert all(each.where[0].startswith("poses/A_1.npz") for each in found)


@pytest.mark.parametrize("kind", ["static", "challenge"])
def test_a_slip_of_one_frame_is_named(data_set, model, kind):
    folder = data_set(kind)
    edit_poses(folder, late_poses)
    _, found = findings(folder, model)
    assert {each.fault for each in found} == {"frame_offset"}
    assert "3D is 1 frame late" in found[0].says


@pytest.mark.parametrize("late", [-2, 0, 1])
def test_a_slip_is_named_where_the_camera_has_the_pose_of_the_first_frame_alone(
    data_set, model, late
):
    folder = data_set("challenge")
    edit_cameras(folder, lambda a: a.update(R=a["R"][:1], t=a["t"][:1]))
    (folder / "poses" / "A_1.npz").unlink()
    joints = np.roll(read_submission(folder / "submission.zip")["A_1"], late, axis=1)
    gone = slice(0, late) if late > 0 else slice(FRAMES + late, FRAMES)
    joints[:, gone] = np.nan
    write_submission(folder / "submission.zip", {"A_1": joints})
    found = findings(folder, model)[1]
    expected = {1: "the 3D is 1 frame late", -2: "the 3D is 2 frames early"}
    assert [each.says[: len(expected[late])] for each in found] == (
        [expected[late]] if late else []
    )


def test_a_slip_of_the_moving_camera_is_named(data_set, model):
    folder = data_set("challenge")

    def late(arrays):
        for name in "KkRt":
            arrays[name] = np.roll(arrays[name], 2, axis=0)

    edit_cameras(folder, late)
    _, found = findings(folder, model)
    assert {each.fault for each in found} == {"frame_offset"}
    assert "the camera is 2 frames late" in found[0].says


JOINTS = {
    "swapped_axes": [[0, 1, 0], [1, 0, 0], [0, 0, 1]],
    "mirrored_world": [[-1, 0, 0], [0, 1, 0], [0, 0, 1]],
    "turned_world": [[-1, 0, 0], [0, -1, 0], [0, 0, 1]],
    "y_down_world": Y_DOWN,
    "other_axes": [[0, -1, 0], [1, 0, 0], [0, 0, 1]],
}


@pytest.mark.parametrize("fault", JOINTS)
def test_axes_of_joints_are_named(data_set, model, fault):
    folder = data_set("static")
    edit_joints(folder, axes_of("joints", JOINTS[fault]))
    _, found = findings(folder, model)
    assert {(each.fault, each.where[0]) for each in found} == {(fault, "joints.npz")}


def test_axes_of_transl_alone_are_named(data_set, model):
    folder = data_set("static")
    edit_poses(folder, axes_of("transl", JOINTS["swapped_axes"]))
    (found,) = findings(folder, model)[1]
    assert found.fault == "swapped_axes"
    assert "in transl alone" in found.says


def test_a_whole_data_set_in_other_axes_is_named_though_it_agrees(data_set, model):
    folder = data_set("static")
    edit_cameras(folder, lambda a: a.update(R=a["R"] @ Y_DOWN.T))
    edit_poses(folder, lambda arrays: turn_poses(arrays, Y_DOWN, model))
    edit_joints(folder, axes_of("joints", Y_DOWN))
    figures, found = findings(folder, model)
    assert figures.reprojection_median_px < 0.05
    assert {each.fault for each in found} == {"y_down_world"}


def test_a_world_without_a_pitch_may_have_any_axes(data_set, model):
    folder = data_set("static")
    edit_cameras(folder, lambda a: a.update(R=a["R"] @ Y_DOWN.T))
    edit_poses(folder, lambda arrays: turn_poses(arrays, Y_DOWN, model))
    edit_joints(folder, axes_of("joints", Y_DOWN))
    assert findings(folder, model, pitch=False)[1] == []
    edit_cameras(folder, transpose_rotation)
    found = findings(folder, model, pitch=False)[1]
    assert {each.fault for each in found} == {"transposed_rotation"}


def test_joints_in_millimetres_are_named_with_and_without_cameras(data_set, model):
    folder = data_set("static")
    edit_joints(folder, scaled("joints", 1000.0))
    assert {each.fault for each in findings(folder, model)[1]} == {"millimetres"}
    for path in (folder / "cameras").glob("*.npz"):
        path.unlink()
    assert {each.fault for each in findings(folder, model)[1]} == {"millimetres"}


@pytest.mark.parametrize("kind", ["static", "alone"])
def test_mirrored_joints_are_named_without_cameras_too(data_set, model, kind):
    folder = data_set("static")
    edit_joints(folder, axes_of("joints", JOINTS["mirrored_world"]))
    if kind == "alone":
        for path in (folder / "cameras").glob("*.npz"):
            path.unlink()
    assert {each.fault for each in findings(folder, model)[1]} == {"mirrored_world"}


def test_garbage_has_no_known_reason(data_set, model):
    folder = data_set("static")
    rng = np.random.default_rng(0)

    def scatter(arrays):
        arrays["joints"] = arrays["joints"] + rng.uniform(-5.0, 5.0, (1, PERSONS, 1, 3)) * [1, 1, 0]

    edit_joints(folder, scatter)
    assert {each.fault for each in findings(folder, model)[1]} == {"reprojection"}


def test_noise_of_a_detector_is_no_fault(data_set, model, written):
    folder = data_set("challenge")
    rng = np.random.default_rng(0)
    path = folder / "skel_2d" / "A_1.npy"
    # 2 px at a height of some 65 px: a good detector.
    np.save(path, np.load(path) + rng.normal(0.0, 2.0, np.load(path).shape))
    figures, found = findings(folder, model)
    assert found == []
    assert 1.5 < figures.reprojection_median_px < 3.5


@pytest.mark.parametrize("late", [False, True])
def test_a_slip_is_found_below_a_detectors_noise(data_set, model, late):
    folder = data_set("challenge")
    rng = np.random.default_rng(1)
    path = folder / "skel_2d" / "A_1.npy"
    # A step at 5 m/s is 0.1 m or 4 px here; the noise of a point is as large.
    np.save(path, np.load(path) + rng.normal(0.0, 3.0, np.load(path).shape))
    if late:
        edit_poses(folder, late_poses)
    found = findings(folder, model)[1]
    assert [each.fault for each in found] == (["frame_offset"] if late else [])


def test_a_submission_with_frames_first_is_named(data_set, model):
    folder = data_set("challenge")
    joints = read_submission(folder / "submission.zip")
    write_submission(folder / "submission.zip", {"A_1": joints["A_1"].swapaxes(0, 1)})
    assert {each.fault for each in findings(folder, model)[1]} == {"frames_before_persons"}


def opengl(array):
    return array * [1.0, -1.0, -1.0]


def box_sides(boxes):
    return np.concatenate([boxes[..., :2], boxes[..., 2:] - boxes[..., :2]], axis=-1)


@pytest.mark.parametrize(
    ("kind", "change", "fault", "words"),
    [
        ("skel_3d", opengl, "skeleton_axes", "are the camera's x, -y, -z"),
        ("skel_3d", lambda a: a[..., [0, 2, 1]], "skeleton_axes", "are the camera's x, z, y"),
        ("skel_3d", lambda a: 1000.0 * a, "millimetres", "skeletons"),
        ("boxes", box_sides, "box_format", "x y width height"),
        ("boxes", lambda a: a + 80.0, "boxes", "not around"),
    ],
)
def test_boxes_and_skeletons_in_other_conventions_are_named(
    data_set, model, kind, change, fault, words
):
    folder = data_set("challenge")
    # As the layout has it: the pose of the first frame alone.
    edit_cameras(folder, lambda a: a.update(R=a["R"][:1], t=a["t"][:1]))
    path = folder / kind / "A_1.npy"
    np.save(path, change(np.load(path)))
    (found,) = findings(folder, model)[1]
    assert (found.fault, found.where) == (fault, (f"{kind} of A_1",))
    assert words in found.says


def test_skeletons_that_were_not_turned_into_the_camera_are_named(data_set, model, main_camera):
    folder = data_set("challenge")
    path = folder / "skel_3d" / "A_1.npy"
    # r' = r R for rows r turns back into the world.
    turned = np.einsum("fpjb,fba->fpja", np.load(path), main_camera.cam_from_world.rotation)
    np.save(path, turned)
    (found,) = findings(folder, model)[1]
    assert (found.fault, "the world's x, y, z" in found.says) == ("skeleton_axes", True)


DAMAGE = {
    "rotation_not_orthonormal": lambda f: edit_cameras(f, scaled("R", 1.01)),
    "moving_center": lambda f: edit(
        f / "cameras" / "A_1.npz", lambda a: a["t"].__setitem__((20, 0), a["t"][20, 0] + 0.5)
    ),
    "missing_values_disagree": lambda f: edit_poses(
        f, lambda a: a["body_pose"].__setitem__((2, 5), np.nan)
    ),
    "limb_length": lambda f: edit_poses(f, lambda a: a["betas"].__setitem__((0, 0), 40.0)),
    "speed": lambda f: edit_poses(
        f, lambda a: a["transl"].__setitem__((0, 7, 0), a["transl"][0, 7, 0] + 2.0)
    ),
    "feet_off_the_ground": lambda f: edit_poses(
        f, lambda a: a["transl"].__setitem__((..., 2), a["transl"][..., 2] - 0.7)
    ),
}


@pytest.mark.parametrize("fault", DAMAGE)
def test_what_is_implausible_is_named(data_set, model, fault):
    folder = data_set("plain")
    DAMAGE[fault](folder)
    assert fault in {each.fault for each in findings(folder, model)[1]}


def test_a_folder_without_data_is_refused(tmp_path):
    with pytest.raises(InputError, match="an exported data set"):
        clips_in(tmp_path)
