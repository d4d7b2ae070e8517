"""A data set of three matches is written whole, and every fault planted in it is found."""

import hashlib
import json
import shutil
from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pytest
from faulty_data_sets import FPS, HALF, PERSONS, edit, results, transpose_rotation
from run_records import StubRun, match_spec

from data_contracts.conventions import COCO17
from flows.results.best_results import Origin
from flows.results.data_set_release import ASSETS, check_data_set, write_data_set
from worldpose.body.body_file import save_body
from worldpose.body.keypoints import fold_keypoints
from worldpose.body.occlusions import hidden_joints, visible_shares
from worldpose.dataset.benchmark import score_folders
from worldpose.dataset.manifest import read_data_set, read_rigs, released_files
from worldpose.dataset.subjects import read_subjects
from worldpose.errors import InputError, UsageError
from worldpose.store.runs import list_pins
from worldpose.store.store import Store

SPLITS = {"ann-1": "train", "bea-1": "val", "cleo-1": "test"}
CLIP = "ann-1_A"


@pytest.fixture(scope="module")
def origins(model, poses, main_camera, tmp_path_factory):
    store = Store.create(str(tmp_path_factory.mktemp("store") / "project"))
    found = []
    for match, split in SPLITS.items():
        folder = tmp_path_factory.mktemp("matches") / match
        (folder / "broadcast").mkdir(parents=True)
        (folder / "detections").mkdir()
        filmed = {"frame_count": HALF, "broadcast": "main"}
        clips = {name: {"first_frame": n, **filmed} for name, n in (("A", 0), ("B", HALF))}
        cameras = {"north": {}, "main": {"kind": "broadcast"}}
        spec = match_spec(cameras, clips, match_id=match, fps=FPS)
        (folder / "match.yaml").write_text(spec.model_dump_json(exclude_none=True))
        for name in ("north", "A", "B"):
            (folder / "detections" / f"{name}.json").write_text("[]")
        for name in "AB":
            (folder / "broadcast" / f"{name}.mp4").write_text(f"{match} {name}")
        parts = [results(model, poses, main_camera, *each) for each in (("A", 0), ("B", HALF))]

        if split == "test":
            about = {"camera": "north", "kind": "view", "first_frame": 0, "frame_count": HALF}
            change = {**about, "frame": 4, "shift_px": [30.0, 0.0], "std": 0.1}
            parts[0]["triangulation/A"].attrs["changes"] = [change]

        def digest_of(path, folder=folder):
            return hashlib.sha256((folder / path).read_bytes()).hexdigest()

        registration = SimpleNamespace(spec=spec, folder=str(folder), digest_of=digest_of)
        settings = {"body_fitting": {}}
        # The rig is the second clip's in both, as a run has one.
        run = StubRun(parts[0] | parts[1], store, match_id=match, settings=settings)
        found.append((Origin(run, registration), split))
    return store, found


LICENCES = dict.fromkeys(ASSETS, "For tests alone.")


@pytest.fixture(scope="module")
def written(origins, tmp_path_factory):
    folder = tmp_path_factory.mktemp("released")
    registry = folder / "subjects.yaml"
    registry.write_text("keeper: [ann-1/A/0, ann-1/B/0]\nstriker: [bea-1/A/2, bea-1/B/1]\n")
    options = {"hidden": folder / "truth", "footage": "copy", "subjects": registry}
    write_data_set(*origins, folder / "set", "first", LICENCES, **options)
    return folder


def test_a_release_has_the_bodies_of_the_folder_of_its_run(model, origins, tmp_path):
    save_body(tmp_path / "smpl-test.npz", replace(model, name="smpl-test"))
    store, [(origin, split), *_] = origins
    about = {**vars(origin.run.record), "body_folder": str(tmp_path)}
    del about["results"]
    parts = {name: part.copy() for name, part in origin.run.results.items()}
    for name in ("body_fitting/A", "body_fitting/B"):
        parts[name].attrs["body_model"] = "smpl-test"
    run = StubRun(parts, store, **about)
    written = write_data_set(
        store, [(replace(origin, run=run), split)], tmp_path / "set", "own", LICENCES
    )
    assert {clip.body_model for clip in written.clips.values()} == {"smpl-test"}


def test_two_bodies_of_one_name_are_refused(model, origins, tmp_path):
    store, [*_, (origin, _)] = origins
    own = replace(model, name="smpl-test", shape_directions=2.0 * model.shape_directions)
    runs = []
    for match, body in (("ann-1", replace(model, name="smpl-test")), ("bea-1", own)):
        (tmp_path / match).mkdir()
        save_body(tmp_path / match / "smpl-test.npz", body)
        parts = {name: part.copy() for name, part in origin.run.results.items()}
        for name in ("body_fitting/A", "body_fitting/B"):
            parts[name].attrs["body_model"] = "smpl-test"
        about = vars(origin.run.record) | {"body_folder": str(tmp_path / match)}
        del about["results"]
        registration = replace_match(origin.registration, match)
        runs.append((Origin(StubRun(parts, store, **about), registration), "train"))
    with pytest.raises(UsageError, match="smpl-test: expected one body file of this name"):
        write_data_set(store, runs, tmp_path / "set", "own", LICENCES)


def replace_match(registration, match):
    spec = registration.spec.model_copy(update={"match_id": match})
    return SimpleNamespace(**vars(registration) | {"spec": spec})


def test_a_sound_data_set_passes_and_hides_the_truth(model, written):
    report = check_data_set(written / "set", written / "truth")
    assert (report.findings, len(report.clips)) == ((), 6)
    public = {
        path.relative_to(written / "set").as_posix() for path in written.rglob("set/test/*/*")
    }
    views = [f"cleo-1_{clip}" for clip in "AB"]
    kinds = {"boxes": "npz", "cameras": "npz", "footage": "mp4"}
    assert public == {f"test/{kind}/{v}.{end}" for kind, end in kinds.items() for v in views}
    assert np.load(written / "set" / "test" / "cameras" / "cleo-1_A.npz")["R"].shape == (1, 3, 3)
    manifest = read_data_set(written / "set")
    assert {clip.split for clip in manifest.clips.values()} == {"train", "val", "test"}
    # Two people have two clips each; all others count once per clip, and the test part not at all.
    assert manifest.statistics.subjects == 4 * PERSONS - 2
    assert manifest.statistics.frames == 4 * HALF
    assert manifest.clips["cleo-1_A"].frames == HALF
    stated = json.loads((written / "set" / "release.json").read_text())["statistics"]["clips"]
    assert set(stated) == {f"{match}_{clip}" for match in ("ann-1", "bea-1") for clip in "AB"}
    hidden = json.loads((written / "truth" / "statistics.json").read_text())
    assert set(hidden["clips"]) == {"cleo-1_A", "cleo-1_B"}
    clip = manifest.clips["ann-1_B"]
    assert clip.first_images == {"ann-1_B": 0}
    assert clip.rig["north"].image_size == (1920, 1080) and clip.rig["north"].lens is None
    still = written / "set" / "train" / "cameras" / "ann-1_B" / "north.npz"
    assert np.load(still)["R"].shape == (1, 3, 3)
    assert (written / "truth" / "cameras" / "cleo-1_A" / "north.npz").is_file()
    pooled = {row[:3]: row.shape for row in read_subjects(written / "set/train/subjects.npz")}
    several, one = (pooled[who, model.name, ""] for who in ("keeper", "ann-1/A/1"))
    assert several.covariance[0, 0] == pytest.approx(1.0 / 9.5)
    assert one.covariance[0, 0] == pytest.approx(0.2)
    video = clip.footage["ann-1_B"]
    copied = written / "set" / video.path
    assert hashlib.sha256(copied.read_bytes()).hexdigest() == video.sha256
    page = (written / "set" / "datasheet.html").read_text()
    assert "keeper" in page and "For tests alone." in page and "data:image" in page
    assert "ann-1, run 0001: usable" in page and "Static cameras" in page
    # Nor does what is public tell how a camera of the test part changes.
    assert page.count("cleo-1_A") == 0 and manifest.clips["cleo-1_A"].rig is None
    changed = read_rigs(written / "truth")["cleo-1_A"]["north"]
    assert changed.visible is None and changed.changes[0].frame == 4


def test_an_older_data_set_without_rigs_and_shapes_is_checked(written, tmp_path):
    folder, truth = (shutil.copytree(written / each, tmp_path / each) for each in ("set", "truth"))
    for old in (folder, truth):
        for path in (*old.rglob("subjects.npz"), *old.rglob("rigs.json"), *old.rglob("north.npz")):
            path.unlink()
    state(lambda stated: [each.pop("rig") for each in stated["clips"].values()])(folder, truth)
    seal(folder, truth)
    assert check_data_set(folder, truth).findings == ()


def test_a_lens_that_no_coefficients_follow_leaves_out_its_camera(origins, monkeypatch, tmp_path):
    def refuse(cameras, where):
        raise InputError(f"{where}: north", expected="a lens", found="a fisheye", todo="Wait.")

    monkeypatch.setattr("flows.results.run_cameras.with_brown_lenses", refuse)
    store, [first, *_] = origins
    clip = write_data_set(store, [first], tmp_path / "set", "own", LICENCES).clips[CLIP]
    assert "a fisheye" in clip.rig["north"].lens["reason"] and clip.rig["north"].visible is None
    assert check_data_set(tmp_path / "set").findings == ()
    assert not (tmp_path / "set" / f"{NORTH}.npz").exists()
    assert "left out" in (tmp_path / "set" / "datasheet.html").read_text()


def test_people_behind_others_and_outside_the_image_are_less_visible(model, poses, main_camera):
    camera = main_camera[:HALF]
    one = fold_keypoints(model, COCO17)(poses[:1, :HALF]).swapaxes(0, 1)
    ray = one - camera.center[:, None, None]
    behind = one + 3.0 * ray / np.linalg.norm(ray, axis=-1, keepdims=True)
    people = np.concatenate([one, behind, one + [0.0, 0.0, 500.0], np.nan * one], axis=1)
    shares = visible_shares(people, camera)
    assert (shares[:, 0] == 1.0).all() and (shares[:, 2] == 0.0).all()
    assert (shares[:, 1] < 0.3).all() and np.isnan(shares[:, 3]).all()
    people[:, 0, COCO17.index("left_wrist")] = np.nan  # the rest of the body hides all the same
    assert (hidden_joints(people, camera)[:, 1].mean(axis=-1) > 0.6).all()


def test_a_released_folder_is_scored(written):
    for reference, clips in (("set", 4), ("truth", 2)):
        (score,), _ = score_folders(written / reference, {"same": written / reference})
        assert len(score.clips) == clips
        assert score.evaluation.g_mpjpe_mm == pytest.approx(0.0, abs=1e-6)
        assert score.evaluation.track_coverage == 1.0


def seal(folder, truth):
    """Record the files as they are, as an author does who does not see the fault."""
    path = folder / "release.json"
    stated = json.loads(path.read_text())
    for key, place in (("files", folder), ("hidden", truth)):
        files = [each for each in place.rglob("*") if each.is_file() and each != path]
        stated[key] = [file.model_dump() for file in released_files(place, files)]
    path.write_text(json.dumps(stated))


def state(change):

    def plant(folder, truth):
        path = folder / "release.json"
        stated = json.loads(path.read_text())
        change(stated)
        path.write_text(json.dumps(stated))

    return plant


def files(name, change):

    def plant(folder, truth):
        edit(truth / name.removeprefix("hidden/") if "hidden/" in name else folder / name, change)
        seal(folder, truth)

    return plant


def put(name, index, value):
    return lambda arrays: arrays[name].__setitem__(index, value)


def swap(name):
    def change(arrays):
        arrays[name][:, [3, 4]] = arrays[name][:, [4, 3]]

    return change


def later(arrays):
    for name in "KkRt":
        arrays[name] = np.roll(arrays[name], 1, axis=0)


def leave_truth(folder, truth):
    shutil.copytree(truth / "poses", folder / "test" / "poses")
    shutil.copy(truth / "cameras" / "cleo-1_A.npz", folder / "test" / "cameras")
    shutil.copytree(truth / "cameras" / "cleo-1_A", folder / "test" / "cameras" / "cleo-1_A")
    seal(folder, truth)


def exchange_frames(arrays):
    arrays["joints"] = arrays["joints"][[1, 0, *range(2, HALF)]]


def change_unsealed(folder, truth):
    (folder / BOXES).unlink()
    (folder / NEW).touch()
    edit(folder / JOINTS, exchange_frames)


def leave_rigs_unstated(folder, truth):
    (truth / "rigs.json").write_text("{}")
    seal(folder, truth)


def put_keeper_into_val(stated):
    stated["clips"]["bea-1_A"]["subjects"][0] = "keeper"


def count_one_more(stated):
    stated["statistics"]["clips"][CLIP]["poses"] += 1
    stated["statistics"]["poses"] += 1


def clip(name, **changes):
    return state(lambda stated: stated["clips"][name].update(changes))


def footage(name, **changes):
    return state(lambda stated: stated["clips"][name]["footage"][name].update(changes))


def unreadable_camera(folder, truth):
    edit(folder / "test" / "cameras" / "cleo-1_A.npz", lambda arrays: arrays.pop("K"))
    edit(folder / BOXES, put("boxes", (2, 0, 2), 2500.0))
    seal(folder, truth)


POSES, CAMERA, BOXES = (f"train/{kind}/{CLIP}.npz" for kind in ("poses", "cameras", "boxes"))
JOINTS = f"train/{CLIP}.joints.npz"
LEFT, NORTH = (f"train/cameras/{name}/north" for name in (CLIP, "ann-1_B"))
NEW, HIDDEN = "val/x.txt", "test/boxes/cleo-1_B.npz"
HALVED = {"image_size": [960, 540], "visible": 1.0}
BOX, LENS, SHAPES = "test/boxes/cleo-1_A.npz", "test/cameras/cleo-1_A.npz", "train/subjects.npz"
STATED = [
    (state(put_keeper_into_val), "subject_in_two_splits", "keeper"),
    (footage(CLIP, sha256="0" * 64), "footage_differs", CLIP),
    (footage("ann-1_B", path="train/footage/none.mp4"), "footage_differs", "ann-1_B"),
    (clip("ann-1_B", rig={}), "views_differ", "ann-1_B"),
    (clip("cleo-1_A", rig={}), "test_truth", "cleo-1_A"),
    (clip(CLIP, views={CLIP: [3840, 2160]}), "views_differ", CLIP),
    (clip(CLIP, fps=25.0), "statement_differs", CLIP),
    (clip("cleo-1_A", frames=3), "statement_differs", "cleo-1_A"),
    (clip("bea-1_A", match_id="ann-1"), "match_in_two_splits", "ann-1"),
    (state(lambda s: s["licences"].pop("boxes")), "missing_licence", "boxes"),
    (state(count_one_more), "count", CLIP),
    (state(lambda s: s["statistics"].update(frames=7)), "count", "release.json"),
]
"""Faults in release.json that differ in name or place."""


def plant_statements(folder, truth):
    for plant, *_ in STATED:
        plant(folder, truth)


FAULTS = [
    (change_unsealed, ("missing_files", "unlisted_files", "changed_files"), (BOXES, NEW, JOINTS)),
    (files(POSES, swap("transl")), "boxes_differ", BOXES),
    (files(JOINTS, exchange_frames), "joints_differ", JOINTS),
    (files(CAMERA, transpose_rotation), "transposed_rotation", CAMERA[:-4]),
    (files(CAMERA, later), "boxes_differ", BOXES),
    (files(POSES, put("transl", (0, 3), np.nan)), "missing_values_disagree", POSES),
    (leave_truth, ("test_truth",) * 3, ("test/poses/cleo-1_A.npz", LENS, f"{LENS[:-4]}/north.npz")),
    (files(BOXES, put("boxes", (2, 0, 2), 2500.0)), "box_outside", BOXES),
    (files(CAMERA, put("K", (4, 0, 0), -1.0)), "unreadable", f"train: {CLIP}"),
    (files(BOXES, lambda a: a.pop("visibility")), "unreadable", f"train: {CLIP}"),
    (unreadable_camera, ("box_outside", "unreadable"), (BOXES, LENS)),
    (files(BOX, put("boxes", (2, 0, 2), 2500.0)), "box_outside", BOX),
    (files(BOX, lambda a: a.update(boxes=a["boxes"] * 0.9)), "boxes_differ", BOX),
    (files(LENS, transpose_rotation), "camera_differs", LENS),
    (files(f"{NORTH}.npz", put("t", (0, 1), 1.0)), "camera_differs", f"{NORTH}.npz"),
    (files(f"{LEFT}.npz", transpose_rotation), "transposed_rotation", LEFT),
    (leave_rigs_unstated, "views_differ", "cleo-1_A"),
    (files(SHAPES, put("betas", (0, 3), 0.7)), "shape_differs", SHAPES),
    (
        files(SHAPES, lambda a: a.update({k: v[:-1] for k, v in a.items()})),
        "subjects_differ",
        SHAPES,
    ),
    # The pooled shape, row 0, is that of this clip alone.
    (files(SHAPES, lambda a: a["betas"].__imul__(1.1)), "shape_differs", "ann-1/A/1"),
    (files(SHAPES, put("body_models", -1, "smpl-male")), "subjects_differ", SHAPES),
    (files(SHAPES, put("betas", (-1, 0), 9.0)), "subject_shapes", SHAPES),
    (files("hidden/poses/cleo-1_B.npz", put("transl", (0, 3), 0.0)), "boxes_differ", HIDDEN),
    (clip(CLIP, rig={"north": HALVED}), "camera_differs", f"{LEFT}.npz"),
    (clip(CLIP, views={}), "views_differ", CLIP),
    (clip(CLIP, first_frame=3), "statement_differs", CLIP),
    (clip(CLIP, body_model="smpl-male"), "statement_differs", CLIP),
    (plant_statements, *zip(*(each[1:] for each in STATED), strict=True)),
]


@pytest.mark.parametrize(("plant", "faults", "places"), FAULTS)
def test_a_planted_fault_is_found(written, tmp_path, plant, faults, places):
    folder, truth = (shutil.copytree(written / each, tmp_path / each) for each in ("set", "truth"))
    plant(folder, truth)
    found = check_data_set(folder, truth).findings
    told = {(each.fault, place) for each in found for place in each.where}
    pairs = [(faults, places)] if isinstance(faults, str) else zip(faults, places, strict=True)
    assert told.issuperset(pairs), found


@pytest.mark.parametrize(
    ("changes", "told"),
    [
        ({"hidden": None}, "--hidden: expected a folder for the test part"),
        ({"licences": {"poses": "x"}}, "set: joints: expected no contradiction, found no licence"),
        ({"footage": "copy", "licences": dict.fromkeys(ASSETS[:-1], "x")}, "footage: expected no"),
        ({"subjects": "keeper: [ann-1/A/0, bea-1/A/0]"}, "keeper: expected no contradiction"),
        ({"subjects": "keeper: [ann-1/A/77]"}, "keeper: expected a list of MATCH/NAME"),
        ({"subjects": "[keeper]"}, "expected a list of MATCH/NAME"),
        ({"name": "my set"}, "expected 1 to 64 letters, .* found 'release-my set'"),
    ],
)
def test_a_data_set_that_would_be_wrong_is_refused(origins, tmp_path, changes, told):
    if "subjects" in changes:
        changes = {"subjects": tmp_path / "subjects.yaml"} | {"text": changes["subjects"]}
        changes["subjects"].write_text(changes.pop("text"))
    options = {"licences": LICENCES, "hidden": tmp_path / "truth", "name": "second"} | changes
    with pytest.raises((InputError, UsageError), match=told):
        write_data_set(*origins, tmp_path / "set", **options)
    assert "release-second" not in [pin.name for pin in list_pins(origins[0].blobs, "ann-1")]
    assert not (tmp_path / "set").exists() and not (tmp_path / "truth").exists()


def test_a_folder_is_never_overwritten_and_no_truth_is_published(origins, written):
    new = written / "new"
    with pytest.raises(UsageError, match="expected a new folder"):
        write_data_set(*origins, written / "set", "first", LICENCES, hidden=new)
    for out, hidden in ((new, new / "test"), (new, new), (new / "set", new)):
        with pytest.raises(UsageError, match="not in --out nor around it"):
            write_data_set(*origins, out, "first", LICENCES, hidden=hidden)
    assert not new.exists()


def test_a_video_that_changed_since_its_registration_is_not_copied(origins, tmp_path):
    store, ((origin, _), *_) = origins
    registration = SimpleNamespace(**vars(origin.registration) | {"digest_of": lambda _: "0" * 64})
    changed = [(Origin(origin.run, registration), "train")]
    with pytest.raises(InputError, match="Register it again and run: worldpose ingest"):
        write_data_set(store, changed, tmp_path / "set", "third", LICENCES, footage="copy")
