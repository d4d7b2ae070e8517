"""Tables of methods over many clips equal a computation from the definitions, in numpy alone."""

import csv
import io
import json
import shutil

import numpy as np
import pytest
from faulty_data_sets import FRAMES, PERSONS, edit, transpose_rotation
from typer.testing import CliRunner

from data_contracts.conventions import COCO17
from flows.cli.app import app
from worldpose.body.keypoints import fold_keypoints
from worldpose.body.model import BodyParameters
from worldpose.dataset.benchmark import score_folders
from worldpose.errors import InputError, UsageError
from worldpose.formats.archives import write_archive
from worldpose.formats.joints_file import JointTracks, write_joints, write_poses
from worldpose.formats.release_cameras import write_moving_camera

CLIPS = ("A_1", "B_2", "C_3")
OWN = 0.4 * np.array([[0.8, -0.6, 0.0], [0.6, 0.8, 0.0], [0.0, 0.0, 1.0]])
"""Takes the world to that of a method: turned, and smaller."""


@pytest.fixture(scope="module")
def clips(model, poses):
    """True bodies by clip, and their joints (frames, persons, 17, 3)."""
    keypoints = fold_keypoints(model, COCO17)
    found = {}
    for number, clip in enumerate(CLIPS):
        moved = poses.transl + [3.0 * number, 0.0, 0.0]
        some = slice(0, FRAMES - 5 * number)
        body = BodyParameters(poses.betas, poses.global_orient, poses.body_pose, moved)[:, some]
        found[clip] = body, keypoints(body).swapaxes(0, 1)
    return found


@pytest.fixture(scope="module")
def reference(model, clips, main_camera, tmp_path_factory):
    """The layout of the published data set: poses and cameras in single files."""
    folder = tmp_path_factory.mktemp("reference")
    for clip, (body, joints) in clips.items():
        write_poses(folder / "poses" / f"{clip}.npz", body, model.name)
        write_moving_camera(folder / "cameras" / f"{clip}.npz", main_camera[: len(joints)])
    return folder


def project(camera, points):
    """Pixels (frames, ..., 2) of points (frames, ..., 3), with the lens k1 k2 alone."""
    with np.load(camera) as file:
        k, lens, turn, shift = (file[name] for name in "KkRt")
    local = np.einsum("fab,f...b->f...a", turn, points)
    local = local + shift.reshape(-1, *(1,) * (points.ndim - 2), 3)
    plane = local[..., :2] / local[..., 2:]
    radius = (plane**2).sum(-1)
    k1, k2 = (lens[:, n].reshape(-1, *(1,) * (points.ndim - 2)) for n in (0, 1))
    plane = plane * (1.0 + k1 * radius + k2 * radius**2)[..., None]
    focal, middle = k[:, [0, 1], [0, 1]], k[:, :2, 2]
    wide = (-1, *(1,) * (points.ndim - 2), 2)
    return plane * focal.reshape(wide) + middle.reshape(wide)


def made(kind, folder, clips, model, reference):
    """Write a method's folder: truth with that method's typical error; return its joints, boxes."""
    rng = np.random.default_rng(5)
    found = {}
    for clip, (body, joints) in clips.items():
        count, camera = len(joints), reference / "cameras" / f"{clip}.npz"
        time = np.arange(count)[:, None, None, None] / count
        mine = joints
        if kind == "jitter":
            mine = joints + 0.05 * rng.standard_normal(joints.shape)
        if kind == "drift":
            mine = joints + time * rng.uniform(-0.6, 0.6, (1, PERSONS, 1, 3)) * [1.0, 1.0, 0.1]
        if kind == "depth":
            mine = joints + 0.3 * rng.standard_normal((count, PERSONS, 1, 1)) * [0.0, 1.0, 0.0]
        if kind == "poses":
            betas = np.zeros_like(body.betas)
            angles = body.body_pose + 0.1 * rng.standard_normal(body.body_pose.shape)
            mean = BodyParameters(betas, body.global_orient, angles, body.transl)
            write_poses(folder / "poses" / f"{clip}.npz", mean, model.name)
            with np.load(folder / "poses" / f"{clip}.npz") as file:
                single = [file[n].astype(float) for n in ("global_orient", "body_pose", "transl")]
            mine = fold_keypoints(model, COCO17)(BodyParameters(betas, *single)).swapaxes(0, 1)
        seen = project(camera, mine)
        if kind == "split":  # its own world and camera; the first person has a new id in the middle
            half = count // 2
            mine = np.concatenate([joints, joints[:, :1]], axis=1) + 0.02 * rng.standard_normal(
                (count, PERSONS + 1, 17, 3)
            )
            mine[half:, 0], mine[:half, PERSONS] = np.nan, np.nan
            mine[3:9, 2] = np.nan  # lost for a while
            seen = project(camera, mine)
            mine = mine @ OWN.T + [1.0, -2.0, 0.5]
            with np.load(camera) as file:
                own = dict(file)
            scale = np.cbrt(np.linalg.det(OWN))
            own["R"] = own["R"] @ (OWN / scale).T
            own["t"] = scale * own["t"] - own["R"] @ [1.0, -2.0, 0.5]
            write_archive(folder / "cameras" / f"{clip}.npz", own)
        if kind != "poses":
            tracks = JointTracks(np.arange(count), np.arange(mine.shape[1]), mine)
            write_joints(folder / f"{clip}.joints.npz", tracks)
        low, high = np.nanmin(seen, 2, initial=9e9), np.nanmax(seen, 2, initial=-9e9)
        gone = np.isnan(seen).all((-1, -2))[..., None]
        boxes = np.where(gone, np.nan, np.concatenate([low, high], axis=-1))
        found[clip] = mine, boxes
    return found


METHODS = ("jitter", "drift", "depth", "poses", "split")


def fourteen(joints):
    """Nose, neck, and all from the shoulders down."""
    neck = 0.5 * (joints[..., 5:6, :] + joints[..., 6:7, :])
    return np.concatenate([joints[..., :1, :], neck, joints[..., 5:, :]], axis=-2)


def overlap(one, two):
    width, height = np.minimum(one[2:], two[2:]) - np.maximum(one[:2], two[:2])
    shared = max(width, 0.0) * max(height, 0.0)
    sizes = [(box[2] - box[0]) * (box[3] - box[1]) for box in (one, two)]
    return shared / (sum(sizes) - shared)


def matched(mine, boxes, true_boxes):
    """Predicted joints of each true person: greedy by frame, then whole tracks, then merged."""
    frames, people = true_boxes.shape[:2]
    ious = np.full((frames, people, mine.shape[1]), -1.0)
    votes = np.zeros((people, mine.shape[1]))
    for f, p, q in np.ndindex(ious.shape):
        if np.isfinite(true_boxes[f, p]).all() and np.isfinite(boxes[f, q]).all():
            ious[f, p, q] = overlap(true_boxes[f, p], boxes[f, q])
    for f in range(frames):
        left = ious[f].copy()
        while left.size and left.max() >= 0.5:
            p, q = np.unravel_index(left.argmax(), left.shape)
            votes[p, q] += 1
            left[p], left[:, q] = -1.0, -1.0
    out = np.full((frames, people, 17, 3), np.nan)
    for f, p in np.ndindex(frames, people):
        own = [q for q in range(mine.shape[1]) if votes[:, q].any() and votes[:, q].argmax() == p]
        own = [q for q in own if ious[f, p, q] >= 0.0]
        if own:
            out[f, p] = mine[f, max(own, key=lambda q: ious[f, p, q])]
    return out


def aligned(source, target):
    """Errors after the best similarity; NaN where one is missing."""
    known = np.isfinite(source).all(-1) & np.isfinite(target).all(-1)
    errors = np.full(known.shape, np.nan)
    if known.sum() < 3:
        return errors
    a, b = source[known], target[known]
    a, b = a - a.mean(0), b - b.mean(0)
    u, s, v = np.linalg.svd(b.T @ a)
    sign = np.array([1.0, 1.0, np.sign(np.linalg.det(u @ v))])
    errors[known] = np.linalg.norm(
        (s * sign).sum() / (a**2).sum() * a @ (u * sign @ v).T - b, axis=1
    )
    return errors


def by_hand(mine, boxes, true, true_boxes):
    """The sums behind one clip's scores."""
    found = matched(mine, boxes, true_boxes)
    source, target = fourteen(found), fourteen(true)
    whole = aligned(source, target)
    alone = np.stack([aligned(source[:, p], target[:, p]) for p in range(PERSONS)], axis=1)
    local = np.full(whole.shape, np.nan)
    for f, p in np.ndindex(*whole.shape[:2]):
        local[f, p] = aligned(source[f, p], target[f, p])
    drifts = []
    for p in range(PERSONS):
        hips = 0.5 * (true[:, p, 11] + true[:, p, 12])[np.isfinite(whole[:, p]).any(-1)]
        way = np.linalg.norm(np.diff(hips, axis=0), axis=-1).sum()
        assert way > 1.0, "everybody runs"
        drifts.append([100.0 * np.nanmean(each[:, p]) / way for each in (whole, alone)])
    there = np.isfinite(whole).any(-1).sum(), np.isfinite(true).all((-1, -2)).sum()
    return [1000.0 * whole, 1000.0 * alone, 1000.0 * local], np.array(drifts), there


def means(parts):
    errors = [np.concatenate([part[0][n].ravel() for part in parts]) for n in range(3)]
    drifts = np.concatenate([part[1] for part in parts])
    found, there = (sum(part[2][n] for part in parts) for n in range(2))
    return [*(np.nanmean(each) for each in errors), *drifts.mean(0), found / there]


NAMES = (
    "g_mpjpe_mm",
    "per_person_g_mpjpe_mm",
    "pa_mpjpe_mm",
    "per_meter_drift_cm_per_m",
    "per_person_drift_cm_per_m",
    "track_coverage",
)


def test_every_number_equals_a_computation_from_the_definitions(clips, reference, model, tmp_path):
    found = {kind: made(kind, tmp_path / kind, clips, model, reference) for kind in METHODS}
    single = {}
    for clip in CLIPS:
        with np.load(reference / "poses" / f"{clip}.npz") as file:
            betas, *rest = (
                file[n].astype(float) for n in ("betas", "global_orient", "body_pose", "transl")
            )
        body = BodyParameters(betas[:, None], *rest)
        true = fold_keypoints(model, COCO17)(body).swapaxes(0, 1)
        pixels = project(reference / "cameras" / f"{clip}.npz", true)
        single[clip] = true, np.concatenate([pixels.min(2), pixels.max(2)], axis=-1)
    scores, _ = score_folders(reference, {kind: tmp_path / kind for kind in METHODS})
    for score in scores:
        parts = {clip: by_hand(*found[score.method][clip], *single[clip]) for clip in CLIPS}
        tables = {clip: (score.clips[clip], [parts[clip]]) for clip in CLIPS}
        for evaluation, some in (*tables.values(), (score.evaluation, list(parts.values()))):
            ours = [getattr(evaluation, name) for name in NAMES]
            np.testing.assert_allclose(ours, means(some), rtol=0.0, atol=1e-6)
        assert score.notes == {}
    g_mpjpe = {score.method: score.evaluation.g_mpjpe_mm for score in scores}
    assert 20.0 < g_mpjpe["split"] < 50.0 < g_mpjpe["jitter"] < g_mpjpe["drift"]


def run(*arguments):
    return CliRunner().invoke(app, ["evaluate", *map(str, arguments)])


def test_the_command_writes_tables_and_a_picture(clips, reference, model, tmp_path):
    for kind in ("jitter", "split"):
        made(kind, tmp_path / kind, clips, model, reference)
    named = [f"--prediction={kind}={tmp_path / kind}" for kind in ("jitter", "split")]
    asked = ("--reference", reference, *named)
    table = run(*asked, "--table", "csv", "--picture", tmp_path / "methods.png")
    rows = list(csv.DictReader(io.StringIO(table.stdout)))
    assert [row["clip"] for row in rows[::4]] == [*CLIPS, "all clips"]
    assert (tmp_path / "methods.png").read_bytes().startswith(b"\x89PNG")
    told = json.loads(run(*asked, "--json").stdout)
    assert set(told["methods"][0]["clips"]) == set(CLIPS)
    assert f"{told['methods'][1]['evaluation']['g_mpjpe_mm']:.1f}" == rows[-3]["g_mpjpe_mm"]
    assert "all clips & jitter (per-person) & " in run(*asked, "--table", "latex").stdout
    assert "each name once" in str(run("--reference", reference, named[0], named[0]).exception)


def without_model(arrays):
    del arrays["body_model"]


def plural(arrays):
    for name in ("global_orient", "body_pose"):
        arrays[f"{name}s"] = arrays.pop(name)


def shorter(arrays):
    for name in ("global_orient", "body_pose", "transl"):
        arrays[name] = arrays[name][:, 1:]


def late(arrays):
    for name in ("global_orient", "body_pose", "transl"):
        arrays[name] = np.roll(arrays[name], 2, axis=1)


@pytest.mark.parametrize(
    ("side", "file", "change", "told"),
    [
        ("mine", "poses", shorter, "poses/A_1.npz: transl: expected frames 0 to 39 of the clip"),
        ("mine", "cameras", transpose_rotation, "cameras/A_1.npz: R: expected x_cam = R x_world"),
        (
            "mine",
            "poses",
            without_model,
            "poses/A_1.npz: body_model: expected the name of the body",
        ),
        ("true", "cameras", transpose_rotation, "cameras/A_1.npz: R: expected x_cam = R x_world"),
        ("true", "cameras", lambda a: a.update({n: a[n][1:] for n in "KkRt"}), "npz: K: expected"),
    ],
)
def test_wrong_files_are_told_with_file_and_key(reference, tmp_path, side, file, change, told):
    for name in ("mine", "true"):
        shutil.copytree(reference, tmp_path / name)
    edit(tmp_path / side / file / "A_1.npz", change)
    with pytest.raises(InputError, match=told):
        score_folders(tmp_path / "true", {"mine": tmp_path / "mine"})


def test_plural_keys_and_shifted_frames_are_told(reference, model, tmp_path):
    shutil.copytree(reference, tmp_path / "mine")
    edit(tmp_path / "mine" / "poses" / "A_1.npz", plural)
    edit(tmp_path / "mine" / "poses" / "B_2.npz", late)
    edit(tmp_path / "mine" / "poses" / "C_3.npz", without_model)
    (score,), _ = score_folders(reference, {"mine": tmp_path / "mine"}, body=model.name)
    for clip in ("A_1", "C_3"):
        assert score.clips[clip].g_mpjpe_mm == pytest.approx(0.0, abs=1e-6)
    places = tmp_path / "mine" / "poses"
    read, shift = score.notes[f"{places}/A_1.npz"], score.notes[f"{places}/B_2.npz: transl"]
    assert "read global_orients as global_orient, body_poses as body_pose" in read
    assert "people are 2 frames late" in shift


def test_a_clip_that_a_method_lacks_is_refused(reference, tmp_path):
    shutil.copytree(reference, tmp_path / "mine")
    (tmp_path / "mine" / "poses" / "B_2.npz").unlink()
    with pytest.raises(InputError, match=r"mine: clip B_2: expected poses/B_2\.npz"):
        score_folders(reference, {"mine": tmp_path / "mine"})


def test_boxes_are_compared_in_the_same_view(reference, tmp_path):
    """Each side has the cameras main and side; then the method has one of them alone."""
    for name in ("mine", "true"):
        cameras = shutil.copytree(reference, tmp_path / name) / "cameras"
        shutil.copy(cameras / "A_1.npz", cameras / "A_1.side.npz")
        (cameras / "A_1.npz").rename(cameras / "A_1.main.npz")
        edit(cameras / "A_1.side.npz", lambda a: a.update(K=a["K"] * [[[0.7], [0.7], [1.0]]]))
    asked = tmp_path / "true", {"mine": tmp_path / "mine"}
    (score,), _ = score_folders(*asked)
    assert score.clips["A_1"].g_mpjpe_mm == pytest.approx(0.0, abs=1e-6)
    (tmp_path / "mine" / "cameras" / "A_1.main.npz").unlink()
    with pytest.raises(InputError, match=r"mine/cameras/A_1\.main\.npz: expected the camera"):
        score_folders(*asked)
    (tmp_path / "true" / "cameras" / "A_1.side.npz").unlink()
    (tmp_path / "mine" / "cameras" / "A_1.side.npz").unlink()
    shutil.copy(tmp_path / "true/cameras/A_1.main.npz", tmp_path / "mine/cameras/A_1.npz")
    (score,), _ = score_folders(*asked)
    assert score.clips["A_1"].g_mpjpe_mm == pytest.approx(0.0, abs=1e-6)


@pytest.mark.parametrize(
    "option", ["--run=3", "--stage=body_fitting", "--first-frame=3", "--markers=x", "--method=a=x"]
)
def test_an_option_without_effect_is_refused(reference, option):
    answer = run("--reference", reference, "--prediction", f"a={reference}", option)
    assert isinstance(answer.exception, UsageError)
    assert option.split("=")[0] in str(answer.exception)
