"""Every broken convention of cameras and poses is named, and a sound data set is left alone."""

import shutil
from dataclasses import replace
from types import SimpleNamespace

import faulty_data_sets as faulty
import numpy as np
import pytest
import xarray as xr

from flows.results.data_set_subjects import subject_fits
from flows.results.dataset import check
from worldpose.body_fitting.bones import Shape
from worldpose.dataset.contents import list_clips
from worldpose.dataset.subjects import SubjectFit, pool_subjects, read_subjects, write_subjects
from worldpose.errors import InputError
from worldpose.formats.challenge import read_submission, write_submission
from worldpose.formats.joints_file import read_joints
from worldpose.formats.motion_capture import coco_dataset, write_json
from worldpose.formats.release_cameras import write_moving_camera
from worldpose.geometry.rigid import Rigid


def test_a_sound_data_set_passes(written, model):
    for kind, compared in (("static", True), ("plain", False), ("challenge", True)):
        figures, found = faulty.findings(written / kind, model)
        assert (found, (figures.frames, figures.persons)) == ([], (faulty.FRAMES, faulty.PERSONS))
        assert figures.plausible_share == 1.0
        assert (figures.reprojection_median_px is not None) == compared
        if compared:
            # COCO is rounded to a hundredth of a pixel, poses and submissions to single precision.
            assert figures.reprojection_median_px < 0.05


CAMERA = {
    "transposed_rotation": faulty.transpose_rotation,
    "translation_is_center": faulty.center_for_translation,
    "camera_to_world": faulty.camera_to_world,
    "negated_translation": faulty.scaled("t", -1.0),
    "camera_in_millimetres": faulty.scaled("t", 1000.0),
}


def with_kinds(faults):
    """Each fault in a data set without 2D and in one of the two that have it."""
    cases = enumerate(faults)
    return [(f, kind) for n, f in cases for kind in ("plain", ("static", "challenge")[n % 2])]


@pytest.mark.parametrize(("fault", "kind"), with_kinds(CAMERA))
def test_a_fault_of_cameras_is_named(data_set, model, kind, fault):
    folder = data_set(kind)
    faulty.edit_cameras(folder, CAMERA[fault])
    _, found = faulty.findings(folder, model)
    assert {each.fault for each in found} == {fault}
    places = {place for each in found for place in each.where if place.startswith("cameras/")}
    expected = {f"cameras/{path.stem}" for path in (folder / "cameras").glob("*.npz")}
    if kind == "plain":
        # Looking straight along -y, R is nearly symmetric, and without 2D nothing is amiss.
        expected -= {"cameras/north"} - places
    assert places == expected


def test_a_lens_in_the_wrong_order_is_named(data_set, model):
    folder = data_set("static")
    faulty.edit_cameras(folder, lambda a: a.update(k=a["k"][:, [0, 1, 4, 2, 3]]))
    assert {each.fault for each in faulty.findings(folder, model)[1]} == {"distortion_order"}


POSES = {
    "millimetres": lambda a, model: faulty.scaled("transl", 1000.0)(a),
    "centimetres": lambda a, model: faulty.scaled("transl", 100.0)(a),
    "y_down_world": lambda a, model: faulty.turn_poses(a, faulty.Y_DOWN, model),
    "y_up_world": lambda a, model: faulty.turn_poses(a, faulty.Y_DOWN.T, model),
    "root_about_origin": faulty.about_origin,
    "degrees": lambda a, model: faulty.in_degrees(a),
    "zeros_for_missing": lambda a, model: faulty.zeros_for_missing(a),
}


@pytest.mark.parametrize(("fault", "kind"), with_kinds(POSES))
def test_a_fault_of_poses_is_named(data_set, model, kind, fault):
    folder = data_set(kind)
    faulty.edit_poses(folder, lambda arrays: POSES[fault](arrays, model))
    _, found = faulty.findings(folder, model)
    assert {each.fault for each in found} == {fault}
    assert all(each.where[0].startswith("poses/A_1.npz") for each in found)


def test_a_slip_of_the_moving_camera_is_named(data_set, model):
    folder = data_set("challenge")

    def late(arrays):
        for name in "KkRt":
            arrays[name] = np.roll(arrays[name], 2, axis=0)

    faulty.edit_cameras(folder, late)
    _, found = faulty.findings(folder, model)
    assert {each.fault for each in found} == {"frame_offset"}
    assert "the camera is 2 frames late" in found[0].says


DAMAGE = {
    "rotation_not_orthonormal": lambda f: faulty.edit_cameras(f, faulty.scaled("R", 1.01)),
    "moving_center": lambda f: faulty.edit(
        f / "cameras" / "A_1.npz", lambda a: a["t"].__setitem__((20, 0), a["t"][20, 0] + 0.5)
    ),
    "missing_values_disagree": lambda f: faulty.edit_poses(
        f, lambda a: a["body_pose"].__setitem__((2, 5), np.nan)
    ),
    "limb_length": lambda f: faulty.edit_poses(f, lambda a: a["betas"].__setitem__((0, 0), 40.0)),
    "speed": lambda f: faulty.edit_poses(
        f, lambda a: a["transl"].__setitem__((0, 7, 0), a["transl"][0, 7, 0] + 2.0)
    ),
    "feet_off_the_ground": lambda f: faulty.edit_poses(
        f, lambda a: a["transl"].__setitem__((..., 2), a["transl"][..., 2] - 0.7)
    ),
}


@pytest.mark.parametrize("fault", DAMAGE)
def test_what_is_implausible_is_named(data_set, model, fault):
    folder = data_set("plain")
    DAMAGE[fault](folder)
    assert fault in {each.fault for each in faulty.findings(folder, model)[1]}


def test_a_gap_of_the_moving_camera_is_no_slip_and_another_rate_is_said(
    data_set, model, main_camera
):
    """The images of frames without a camera are missing; half as many images tell nothing."""
    folder = data_set("plain")
    tracks = read_joints(data_set("static") / "joints.npz")
    pose, gap = main_camera.cam_from_world, np.zeros((faulty.FRAMES, 1))
    gap[10:20] = np.nan
    unknown = Rigid(pose.rotation + gap[..., None], pose.translation + gap)
    camera = replace(main_camera, cam_from_world=unknown)
    write_moving_camera(folder / "cameras" / "A_1.npz", camera)
    seen = np.ones(tracks.joints.shape[:3], bool)
    write_json(folder / "A_1.json", coco_dataset("A_1", camera, tracks, seen))
    assert faulty.findings(folder, model)[1] == []
    half = coco_dataset("A_1", main_camera, tracks, seen, number=np.arange(faulty.FRAMES) // 2)
    write_json(folder / "A_1.json", half)
    write_moving_camera(folder / "cameras" / "A_1.npz", main_camera)
    faulty.edit_poses(folder, lambda arrays: arrays.pop("body_model"))
    told = check(folder)
    assert told.findings == ()
    assert "poses of A_1 name no body model: open-neutral" in told.notes[0]
    assert "A_1.json: not compared" in told.notes[1]


def test_a_folder_without_data_is_refused(tmp_path, written):
    with pytest.raises(InputError, match="an exported data set"):
        list_clips(tmp_path)
    shutil.copytree(written / "plain", tmp_path / "train")
    with pytest.raises(InputError, match=f"Give a part of this data set: {tmp_path}/train"):
        list_clips(tmp_path)


JOINTS = {
    "swapped_axes": [[0, 1, 0], [1, 0, 0], [0, 0, 1]],
    "mirrored_world": [[-1, 0, 0], [0, 1, 0], [0, 0, 1]],
    "turned_world": [[-1, 0, 0], [0, -1, 0], [0, 0, 1]],
    "y_down_world": faulty.Y_DOWN,
    "other_axes": [[0, -1, 0], [1, 0, 0], [0, 0, 1]],
}


@pytest.mark.parametrize("fault", JOINTS)
def test_axes_of_joints_are_named(data_set, model, fault):
    folder = data_set("static")
    faulty.edit_joints(folder, faulty.axes_of("joints", JOINTS[fault]))
    _, found = faulty.findings(folder, model)
    assert {(each.fault, each.where[0]) for each in found} == {(fault, "joints.npz")}


def test_joints_in_millimetres_are_named_with_and_without_cameras(data_set, model):
    folder = data_set("static")
    faulty.edit_joints(folder, faulty.scaled("joints", 1000.0))
    assert {each.fault for each in faulty.findings(folder, model)[1]} == {"millimetres"}
    for path in (folder / "cameras").glob("*.npz"):
        path.unlink()
    assert {each.fault for each in faulty.findings(folder, model)[1]} == {"millimetres"}


def test_garbage_has_no_known_reason(data_set, model):
    folder = data_set("static")
    rng = np.random.default_rng(0)

    def scatter(arrays):
        arrays["joints"] = arrays["joints"] + rng.uniform(-5.0, 5.0, (1, faulty.PERSONS, 1, 3)) * [
            1,
            1,
            0,
        ]

    faulty.edit_joints(folder, scatter)
    assert {each.fault for each in faulty.findings(folder, model)[1]} == {"reprojection"}


@pytest.mark.parametrize("late", [False, True])
def test_a_slip_is_found_below_a_detectors_noise(data_set, model, late):
    folder = data_set("challenge")
    rng = np.random.default_rng(1)
    path = folder / "skel_2d" / "A_1.npy"
    # A step at 5 m/s is 0.1 m or 4 px here; the noise of a point is as large.
    np.save(path, np.load(path) + rng.normal(0.0, 3.0, np.load(path).shape))
    if late:
        faulty.edit_poses(folder, faulty.late_poses)
    found = faulty.findings(folder, model)[1]
    assert [each.fault for each in found] == (["frame_offset"] if late else [])


def test_a_submission_with_frames_first_is_named(data_set, model):
    folder = data_set("challenge")
    joints = read_submission(folder / "submission.zip")
    write_submission(folder / "submission.zip", {"A_1": joints["A_1"].swapaxes(0, 1)})
    assert {each.fault for each in faulty.findings(folder, model)[1]} == {"frames_before_persons"}


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
    faulty.edit_cameras(folder, lambda a: a.update(R=a["R"][:1], t=a["t"][:1]))
    path = folder / kind / "A_1.npy"
    np.save(path, change(np.load(path)))
    (found,) = faulty.findings(folder, model)[1]
    assert (found.fault, found.where) == (fault, (f"{kind} of A_1",))
    assert words in found.says


def test_skeletons_that_were_not_turned_into_the_camera_are_named(data_set, model, main_camera):
    folder = data_set("challenge")
    path = folder / "skel_3d" / "A_1.npy"
    # r' = r R for rows r turns back into the world.
    turned = np.einsum("fpjb,fba->fpja", np.load(path), main_camera.cam_from_world.rotation)
    np.save(path, turned)
    (found,) = faulty.findings(folder, model)[1]
    assert (found.fault, "the world's x, y, z" in found.says) == ("skeleton_axes", True)


def test_a_subject_has_a_shape_of_each_body_model_and_never_a_mean_of_two(tmp_path):
    def fit(model, clip, first):
        shape = Shape(np.array([first, *np.zeros(9)]), faulty.COVARIANCE)
        return SubjectFit("keeper", model, clip, shape, 0.5)

    fits = [
        fit("neutral", "a", 0.4),
        fit("female", "b", 4.0),
        fit("neutral", "c", 0.6),
        SubjectFit("other", "small", "a", Shape(np.ones(4), 0.2 * np.eye(4)), 0.5),
    ]
    write_subjects(tmp_path / "subjects.npz", fits)
    rows = {row[:3]: row.shape for row in read_subjects(tmp_path / "subjects.npz")}
    # Of two clips 2 x 4.5 of information and 0.5 of the prior: 5 (0.4 + 0.6) / 9.5.
    assert rows["keeper", "neutral", ""].betas[0] == pytest.approx(5.0 / 9.5)
    np.testing.assert_allclose(rows["keeper", "neutral", ""].covariance, np.eye(10) / 9.5)
    assert rows["keeper", "female", ""].betas[0] == pytest.approx(4.0)
    assert rows["other", "small", ""].betas.shape == (4,)
    assert len(rows) == 3 + len(fits)


def fit(clip, first, weight=0.5):
    shape = Shape(np.array([first, *np.zeros(9)]), faulty.COVARIANCE)
    return SubjectFit("keeper", "neutral", clip, shape, weight)


def test_all_pairs_of_clips_have_one_level_together():
    # The square over the variance is 31: 1 of 1700 pairs of one person is as far apart.
    away = np.sqrt(31.0 * 0.4)
    few = pool_subjects([fit("a", 0.0), fit("b", away)])
    many = pool_subjects([fit("b", away), *(fit(f"{n}", 0.0) for n in range(19))])
    assert few["keeper", "neutral"][1] is None and many["keeper", "neutral"][1] is not None
    # An identity as covariance stands for none: it tells nothing of the shape.
    paper = pool_subjects([fit("a", 0.0, 0.0), fit("b", away, 0.0)])
    assert paper["keeper", "neutral"][1].betas[0] == pytest.approx(0.5 * away)


@pytest.mark.parametrize("place", [("betas", (0, 3)), ("covariance", (0, 3, 3))])
def test_a_gap_in_a_shape_is_refused(tmp_path, place):
    write_subjects(tmp_path / "subjects.npz", [fit("a", 0.0)])
    faulty.edit(tmp_path / "subjects.npz", lambda a: a[place[0]].__setitem__(place[1], np.nan))
    with pytest.raises(InputError, match="expected numbers, then NaN to the end"):
        read_subjects(tmp_path / "subjects.npz")


class Run(dict):
    """Results of a run with some settings."""


def fits_of(settings):
    rows = {"betas": (("person", "shape"), np.array([np.ones(10), np.ones(10)]))}
    rows["betas_covariance"] = (("person", "a", "b"), np.stack([faulty.COVARIANCE] * 2))
    fits = xr.Dataset(rows, coords={"person": [3, 4]}, attrs={"body_model": "neutral"})
    again = fits.assign_coords(person=[4, 7])  # 7 is filmed by the broadcast camera alone
    run = Run({"body_fitting/A": fits, "refitting/A": again})
    run.record = SimpleNamespace(settings={"body_fitting": settings}, run_id="0001")
    return list(subject_fits("m_A", ("four", "seven"), SimpleNamespace(run=run), "A"))


def test_every_subject_of_a_clip_has_a_row_and_a_shape_by_static_cameras():
    rows = fits_of({"method": "paper", "of_an_older_version": 3})
    assert [(row.subject, len(row.shape.betas)) for row in rows] == [("four", 10), ("seven", 0)]
    assert (rows[0].in_poses, rows[1].in_poses, rows[0].prior_weight) == (True, False, 0.0)
    assert fits_of({"shape_weight": 2.0})[0].prior_weight == 2.0
    with pytest.raises(InputError, match="shape_weight: expected a number"):
        fits_of({"shape_weight": "heavy"})
