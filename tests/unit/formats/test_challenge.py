"""The challenge's layouts: what others would read, and what others have written."""

from dataclasses import replace

import cv2
import numpy as np
import pandas as pd
import pytest
from camera_builders import plain_camera

from worldpose.body.keypoints import BODY25, fold_keypoints
from worldpose.body.model import BodyParameters
from worldpose.errors import InputError
from worldpose.formats.challenge import (
    challenge_truth,
    fill_submission,
    is_submission,
    read_challenge,
    read_submission,
    submission_clips,
    write_challenge,
    write_challenge_camera,
    write_submission,
)
from worldpose.formats.release_cameras import read_camera_rows, read_kit_camera
from worldpose.geometry.rigid import Rigid

FRAMES = 3
K1 = 0.2


@pytest.fixture(scope="module")
def camera():
    """The main camera, panning; x_cam = R x + t with the centre at (0, -70, 14)."""
    pan = np.radians([0.0, 0.2, 0.4])
    tilted = cv2.Rodrigues(np.array([np.pi / 2 + np.arctan2(14.0, 70.0), 0.0, 0.0]))[0]
    rotation = np.array([tilted @ cv2.Rodrigues(np.array([0.0, 0.0, a]))[0] for a in pan])
    translation = -rotation @ np.array([0.0, -70.0, 14.0])
    return plain_camera(
        np.full(FRAMES, 4000.0),
        (960.0, 540.0),
        Rigid(rotation, translation),
        lens=(K1, 0.0, 0.0, 0.0, 0.0),
    )


@pytest.fixture(scope="module")
def poses():
    """Three people: at the centre spot, far out of the image, and missing in one frame."""
    transl = np.zeros((3, FRAMES, 3)) + [0.0, 0.0, 1.1]
    transl[1, :, 0] = 45.0
    transl[2, :, 0] = 3.0
    transl[2, 1] = np.nan
    upright = np.array([np.pi / 2, 0.0, 0.0])
    return BodyParameters(np.zeros((3, 1, 10)), upright, np.zeros(69), transl)


@pytest.fixture(scope="module")
def truth(model, poses, camera):
    return challenge_truth(model, poses, camera)


def test_skeletons_are_where_opencv_projects_the_bodies(model, poses, camera, truth):
    joints = fold_keypoints(model, BODY25)(poses)
    for frame in range(FRAMES):
        pose = camera.cam_from_world[frame]
        matrix = np.array([[4000.0, 0.0, 960.0], [0.0, 4000.0, 540.0], [0.0, 0.0, 1.0]])
        pixels, _ = cv2.projectPoints(
            joints[0, frame],
            cv2.Rodrigues(np.array(pose.rotation))[0],
            np.array(pose.translation),
            matrix,
            np.array([K1, 0.0, 0.0, 0.0, 0.0]),
        )
        # Two float64 implementations of one formula.
        np.testing.assert_allclose(truth.clip.skel_2d[frame, 0], pixels[:, 0], atol=1e-8)
        x0, y0, x1, y1 = truth.clip.boxes[frame, 0]
        assert (pixels[:, 0] > [x0, y0]).all()
        assert (pixels[:, 0] < [x1, y1]).all()


@pytest.mark.parametrize("edition", [2025, 2026])
def test_both_editions_come_back(truth, camera, tmp_path, edition):
    files = write_challenge(tmp_path, {"A_1": truth.clip, "B_2": truth.clip}, edition)
    names = {path.relative_to(tmp_path).as_posix() for path in files}
    if edition == 2025:
        assert names == {"boxes.npz", "skel_2d.npz", "skel_3d.npz"}
        with np.load(tmp_path / "boxes.npz") as file:
            assert sorted(file.files) == ["A_1", "B_2"]
    else:
        kinds = ("boxes", "skel_2d", "skel_3d")
        assert names == {f"{kind}/{clip}.npy" for kind in kinds for clip in ("A_1", "B_2")}
        assert np.load(tmp_path / "boxes" / "A_1.npy").dtype == np.float64
    back = read_challenge(tmp_path)
    assert sorted(back) == ["A_1", "B_2"]
    for kind in ("boxes", "skel_2d", "skel_3d"):
        np.testing.assert_array_equal(getattr(back["B_2"], kind), getattr(truth.clip, kind))


@pytest.mark.parametrize("edition", [2025, 2026])
def test_a_camera_file_has_the_pose_of_the_first_frame_alone(camera, tmp_path, edition):
    path = tmp_path / "cameras" / "A_1.npz"
    write_challenge_camera(path, camera, edition)
    with np.load(path) as file:
        shapes = {name: file[name].shape for name in file.files}
        if edition == 2025:
            np.testing.assert_array_equal(
                file["Rt"][0], np.column_stack([file["R"][0], file["t"][0]])
            )
    assert shapes.pop("Rt", (1, 3, 4)) == (1, 3, 4)
    assert shapes == {"K": (FRAMES, 3, 3), "k": (FRAMES, 5), "R": (1, 3, 3), "t": (1, 3)}
    rows = read_camera_rows(path)
    np.testing.assert_array_equal(rows.rotation[0], camera.cam_from_world.rotation[0])
    assert np.isnan(rows.rotation[1:]).all()
    points = np.zeros((1, 3))
    np.testing.assert_allclose(rows.camera().project(points)[0], camera.project(points)[0])


@pytest.mark.parametrize("sign", [1.0, -1.0])
def test_a_lens_with_other_terms_becomes_one_of_the_kit(camera, tmp_path, sign):
    path, lens = tmp_path / "A_1.npz", camera.distortion.copy()
    lens[:, 4], lens[:, 2] = sign * 30.0, 1e-5  # k3: 14 px in the corner
    bent = replace(camera, distortion=lens)
    error = write_challenge_camera(path, bent, 2026)
    size = tuple(camera.image_size.reshape(-1, 2)[0].tolist())
    kit = read_kit_camera(path, size)
    assert not kit.distortion[:, 2:].any()
    rays = bent[0].normalize(bent[0].image_grid())
    pose = bent[0].cam_from_world
    points = (np.column_stack([rays, np.ones(len(rays))]) - pose.translation) @ pose.rotation
    shift = kit[0].project(points) - bent[0].project(points)
    assert np.nanmax(np.linalg.norm(shift, axis=-1)) == pytest.approx(error, rel=1e-3)
    plain = replace(kit, distortion=camera.distortion)
    without = plain[0].project(points) - bent[0].project(points)
    assert np.linalg.norm(without, axis=-1).max() > 10.0 * error


@pytest.mark.parametrize(
    ("name", "content", "message"),
    [
        ("boxes", np.ones((4, 2, 5)), r"boxes/A_1\.npy: expected float numbers of shape"),
        ("skel_2d", np.ones((5, 2, 25, 2)), r"skel_2d of A_1: expected shape \(4, 2\)"),
        ("skel_3d", np.array({"a": 1}, dtype=object), r"skel_3d/A_1\.npy: expected an npy array"),
    ],
)
def test_what_is_no_challenge_is_refused_by_file(tmp_path, name, content, message):
    arrays = {
        "boxes": np.ones((4, 2, 4)),
        "skel_2d": np.ones((4, 2, 25, 2)),
        "skel_3d": np.ones((4, 2, 25, 3)),
        name: content,
    }
    for kind, array in arrays.items():
        (tmp_path / kind).mkdir()
        np.save(tmp_path / kind / "A_1.npy", array, allow_pickle=True)
    with pytest.raises(InputError, match=message):
        read_challenge(tmp_path)


def test_a_clip_without_a_camera_in_its_first_frame_is_refused(camera, tmp_path):
    lost = replace(camera, focal=np.where(np.arange(FRAMES)[:, None] == 0, np.nan, camera.focal))
    with pytest.raises(InputError, match="first frame"):
        write_challenge_camera(tmp_path / "A_1.npz", lost, 2026)


def drawn_joints():
    joints = np.random.default_rng(3).normal(0.0, 20.0, (3, 4, 15, 3))
    joints[1, 2] = np.nan
    return joints


@pytest.mark.parametrize("ending", ["zip", "npz", "parquet"])
def test_a_submission_of_each_form_is_read_as_written(tmp_path, ending):
    if ending == "parquet":
        pytest.importorskip("pyarrow")
    joints = drawn_joints()
    file = tmp_path / f"submission.{ending}"
    write_submission(file, {"A": joints, "B": joints[:2]})
    assert is_submission(file)
    assert submission_clips(file) == ("A", "B")
    read = read_submission(file)
    np.testing.assert_allclose(read["A"], joints, atol=1e-5)
    np.testing.assert_allclose(read["B"], joints[:2], atol=1e-5)


def test_a_table_with_a_row_twice_or_text_is_refused(tmp_path):
    pytest.importorskip("pyarrow")
    file, twice, text = (tmp_path / f"{name}.parquet" for name in "abc")
    write_submission(file, {"A": drawn_joints()})
    table = pd.read_parquet(file)
    pd.concat([table, table.tail(1)]).to_parquet(twice)
    with pytest.raises(
        InputError, match=r"b\.parquet: A: .*several of frame 3, person 2, joint 14"
    ):
        read_submission(twice)
    table.assign(x="far").to_parquet(text)
    with pytest.raises(InputError, match=r"c\.parquet: x, y, z: expected numbers"):
        read_submission(text)


def test_a_frame_without_a_body_takes_the_nearest_one_at_the_place_of_the_feet():
    joints = drawn_joints()
    joints[2] = np.nan
    places = np.full((3, 4, 2), np.nan)
    places[1:] = [5.0, -7.0]
    filled, added = fill_submission(joints, places)
    assert added == 5
    hips = filled[1:, 2, 7:9, :2].mean(axis=1)
    np.testing.assert_allclose(hips, [[5.0, -7.0]] * 2, atol=1e-9)
    shape = joints[1, 1] - joints[1, 1, 7:9].mean(axis=0)
    np.testing.assert_allclose(filled[1, 2] - filled[1, 2, 7:9].mean(axis=0), shape, atol=1e-9)
    np.testing.assert_array_equal(filled[0], joints[0])
