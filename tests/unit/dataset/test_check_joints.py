"""Every broken convention of joints, boxes and skeletons is named; noise is left alone."""

import numpy as np
import pytest
from faulty_data_sets import (
    PERSONS,
    Y_DOWN,
    axes_of,
    edit_cameras,
    edit_joints,
    edit_poses,
    findings,
    late_poses,
    scaled,
)

from worldpose.formats.challenge import read_submission, write_submission

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


def test_joints_in_millimetres_are_named_with_and_without_cameras(data_set, model):
    folder = data_set("static")
    edit_joints(folder, scaled("joints", 1000.0))
    assert {each.fault for each in findings(folder, model)[1]} == {"millimetres"}
    for path in (folder / "cameras").glob("*.npz"):
        path.unlink()
    assert {each.fault for each in findings(folder, model)[1]} == {"millimetres"}


def test_garbage_has_no_known_reason(data_set, model):
    folder = data_set("static")
    rng = np.random.default_rng(0)

    def scatter(arrays):
        arrays["joints"] = arrays["joints"] + rng.uniform(-5.0, 5.0, (1, PERSONS, 1, 3)) * [1, 1, 0]

    edit_joints(folder, scatter)
    assert {each.fault for each in findings(folder, model)[1]} == {"reprojection"}


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


def box_sides(boxes):
    return np.concatenate([boxes[..., :2], boxes[..., 2:] - boxes[..., :2]], axis=-1)


@pytest.mark.parametrize(
    ("kind", "change", "fault", "words"),
    [
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
