"""Stages of small matches: of nobody, with feet, and with proposed cameras."""

import json
import shutil
from types import SimpleNamespace

import numpy as np
import pytest
import yaml
from stand_ins import empty_store

from data_contracts.conventions import FEET
from flows.match import task_of
from flows.method import METHOD
from flows.registering import register
from flows.results.best_results import clip_positions, joint_tracks
from flows.run_plan import plan_run
from worldpose.body.body_file import find_body
from worldpose.body.keypoints import fold_keypoints
from worldpose.body.model import BodyParameters
from worldpose.errors import InputError
from worldpose.formats.joints_file import read_poses
from worldpose.formats.keypoint_files import read_keypoint_arrays, write_keypoint_arrays
from worldpose.formats.release_cameras import read_camera
from worldpose.geometry.cameras import camera_from_arrays
from worldpose.ingest.footage import write_still
from worldpose.pitch.template import PitchTemplate
from worldpose.simulation.renderer import render_pitch
from worldpose.store.store import Store

NOBODY = {"tracking": {"size_range": [3.0, 4.0]}}
"""All detected people are too small, or too tall."""


@pytest.fixture
def empty(tiny, tmp_path):
    """A store and a match of two clips with named people, without any track."""
    folder = shutil.copytree(tiny, tmp_path / "match")
    shutil.copy(folder / "reference" / "calibration.toml", folder)
    (folder / "detections" / "clip.npz").unlink(missing_ok=True)  # of a clip's own camera
    spec = yaml.safe_load((folder / "match.yaml").read_text())
    (folder / "pitch.json").unlink()
    shutil.rmtree(folder / "annotations")
    spec["pitch"] = "none"  # on a pitch, feet would place every person
    spec["roster"] = [{"id": "ann"}]
    spec["clips"] = [
        {"id": "first", "frame_count": 6, "people": {0: "ann"}},
        {"id": "second", "first_frame": 6, "frame_count": 6, "people": {1: "ann"}},
    ]
    (folder / "match.yaml").write_text(yaml.safe_dump(spec))
    store = Store.create(tmp_path / "project")
    return store, register(store, folder)[0]


@pytest.mark.slow
def test_a_match_of_nobody_goes_through_two_iterations(empty):
    store, match = empty
    for iteration in (1, 2):
        results = compute(store, match, NOBODY, iteration=iteration)
        assert results["refitting/first"]["joints"].shape == (6, 0, 17, 3)
        seen = results["filtering/first"]
        assert not seen["rejected"].values.any() and not seen["dropped"].values.any()
        assert (seen["fits"].values == -1).all()
        np.testing.assert_array_equal(seen["clock_late"].values, 0.0)


def test_a_run_says_what_it_changed_in_the_2d_poses_of_a_camera(tiny, tmp_path):
    folder = shutil.copytree(tiny, tmp_path / "match")
    shutil.rmtree(folder / "reference")
    file = sorted((folder / "detections").glob("cam*.npz"))[0]
    file.unlink()
    triples = [[100.0 + 9 * joint, 300.0, 1.2 if joint < 3 else 0.9] for joint in range(17)]
    points = [number for triple in triples for number in triple]
    people = [{"image_id": 0, "keypoints": given} for given in (points, [float("nan")] * 51)]
    file.with_suffix(".json").write_text(json.dumps(people))
    store = Store.create(tmp_path / "project")
    match, _ = register(store, folder)
    unit = next(u for u in plan_run(store, match, {}) if u.name == f"ingest/{file.stem}")
    task_of(METHOD[0]).fn(unit.work(store.url, match, "0001"))
    assert store.manifest(match.match_id, "ingest", file.stem, unit.key).warnings == (
        f"confidences above 1, which count as 1: 3 ({file.stem})",
        f"entries without a known joint, which count as no person: 1 ({file.stem})",
    )


STAGES = (
    *("ingest", "static_calibration", "camera_consistency", "tracking", "triangulation"),
    *("bundle_adjustment", "retriangulation", "body_fitting"),
)
NOISE_PX = 1.0


class Results(dict):
    """Results by name with what joints need of a run's record."""

    store, record = empty_store(), SimpleNamespace(match_id="m", body_folder=None)


def add_feet(folder):
    """Give the 2D poses of all static cameras but the first the feet of their people."""
    poses, _ = read_poses(folder / "reference" / "poses" / "clip.npz")
    feet = fold_keypoints(find_body(), FEET)(poses)  # (persons, frames, 6, 3)
    rng = np.random.default_rng(0)
    for file in sorted((folder / "detections").glob("cam*.npz"))[1:]:
        camera = read_camera(folder / "reference" / "cameras" / file.name)
        with np.load(folder / "reference" / "identities" / file.name) as known:
            person, frame = known["person"], known["frame"]
        people = read_keypoint_arrays(file)
        assert people.frame.tolist() == frame.tolist()
        shown = camera.project(feet[np.maximum(person, 0), np.arange(len(frame))[:, None]])
        shown += NOISE_PX * rng.standard_normal(shown.shape)
        body = np.isfinite(people.confidence).any(axis=-1)
        there = np.isfinite(shown[..., 0]) & ((person >= 0) & body)[..., None]
        pixels = np.where(there[..., None], shown, np.nan).astype(np.float32)
        sure = np.where(there, 0.9, np.nan).astype(np.float32)
        write_keypoint_arrays(file, people.add_points(FEET, pixels, sure))
    return np.asarray(feet.swapaxes(0, 1))


def compute(store, match, overrides, stages=None, **which):
    """Compute units in this process; return their results by name."""
    found, units = {}, plan_run(store, match, overrides, **which)
    for stage in METHOD:
        for unit in units:
            if unit.recipe.stage == stage.name and (stages is None or stage.name in stages):
                place = (match.match_id, *unit.name.split("/"), unit.key)
                if not store.has(*place):
                    task_of(stage).fn(unit.work(store.url, match, "0001"))
                found[unit.name] = store.open_result(*place)
    return found


@pytest.fixture(scope="module")
def run(tiny, tmp_path_factory):
    """Results by unit, and the true feet (frames, persons, 6, 3) [m]."""
    base = tmp_path_factory.mktemp("feet")
    folder = shutil.copytree(tiny, base / "match")
    shutil.copy(folder / "reference" / "calibration.toml", folder)
    truth, store = add_feet(folder), Store.create(base / "project")
    return compute(store, register(store, folder)[0], {}, STAGES), truth


def test_ingest_stores_them_by_name(run):
    found, _ = run
    assert found["ingest/cam01"]["point"].values.tolist() == list(FEET)
    assert np.isfinite(found["ingest/cam01"]["extra_keypoints"].values).any()
    assert "extra_keypoints" not in found["ingest/cam00"]  # the camera without feet


def true_people(result, truth):
    """Return the true feet of the people of a result, who are nearest to their triangulation."""
    joints = result["extra_joints"].values
    away = np.linalg.norm(joints[:, :, None] - truth[:, None], axis=-1)
    return truth[:, np.nanmedian(away, axis=(0, 3)).argmin(axis=1)]


@pytest.mark.parametrize("stage", ["triangulation", "retriangulation"])
def test_triangulation_finds_them(run, stage):
    found, truth = run
    result = found[f"{stage}/clip"]
    assert result["point"].values.tolist() == list(FEET)
    away = np.linalg.norm(result["extra_joints"].values - true_people(result, truth), axis=-1)
    assert np.nanmedian(away) < 0.03
    assert np.isfinite(away).mean() > 0.6
    assert (result["extra_views"].values[np.isfinite(away)] >= 2).all()


def test_bodies_follow_them(run):
    found, truth = run
    result = found["body_fitting/clip"]
    bodies = BodyParameters(
        np.broadcast_to(result["betas"].values, (*result["transl"].shape[:2], 10)),
        *(result[name].values for name in ("global_orient", "body_pose", "transl")),
    )
    feet = fold_keypoints(find_body(), FEET)(bodies)
    np.testing.assert_allclose(feet, result["extra_joints"].values, atol=1e-9)
    # Without points feet are 30 to 50 mm from the truth.
    assert np.nanmedian(np.linalg.norm(feet - true_people(result, truth), axis=-1)) < 0.025


def test_best_joints_are_those_of_bodies_as_detected_and_tell_their_source(run):
    results = Results(run[0])
    fitted = results["body_fitting/clip"].copy(deep=True)
    fitted["joints"][:5, 0] = np.nan  # a person without a body there
    results["body_fitting/clip"] = fitted
    best, seen, body, placed = (
        joint_tracks(results, "clip", stage, definition)
        for stage, definition in (
            (None, "detector"),
            ("body_fitting", "detector"),
            ("body_fitting", "body"),
            ("retriangulation", "detector"),
        )
    )
    there = np.isfinite(seen.joints[..., 0])
    ends = np.isin(np.arange(17), (9, 10, 15, 16))  # wrists and ankles
    for source, tracks, where in (
        (2, seen, there & ~ends),
        (3, body, there & ends),
        (1, placed, ~there & np.isfinite(placed.joints[..., 0])),
    ):
        assert where.any()
        np.testing.assert_array_equal(best.source == source, where)
        np.testing.assert_array_equal(best.joints[where], tracks.joints[where])
        np.testing.assert_array_equal(best.covariance[where], tracks.covariance[where])
    assert ((best.source == 0) == np.isnan(best.joints[..., 0])).all()
    places = clip_positions(results, "clip")
    column = np.searchsorted(places.person, best.person_ids)
    hips = best.joints[:, :, 11:13, :2].mean(axis=2)
    found = np.isfinite(hips)
    assert found[:5, 0].all()
    np.testing.assert_array_equal(places.xy[:, column][found], hips[found])


TASKS = {stage.name: task_of(stage) for stage in METHOD}
TURNED = "cam01"
"""Stands on the far side; a proposal without a stated side assumes the near one."""
SIZE = (1920, 1080)


@pytest.fixture
def folder(tiny, tmp_path):
    return shutil.copytree(tiny, tmp_path / "match")


def true_camera(folder, camera_id):
    return read_camera(folder / "reference" / "cameras" / f"{camera_id}.npz", SIZE)


def change_spec(folder, change):
    """Change the cameras of match.yaml, each a mapping."""
    spec = yaml.safe_load((folder / "match.yaml").read_text())
    for camera in spec["cameras"]:
        change(camera["id"], camera)
    (folder / "match.yaml").write_text(yaml.safe_dump(spec))


def take_clicks(folder, sides, image=None):
    """Take cameras' clicks away, give them an image, and state their sides unless None."""

    def take(name, camera):
        if name not in sides:
            return
        (folder / "annotations" / "static_calibration" / f"{name}.json").unlink()
        camera |= {"still": f"stills/{name}.png"} | ({"side": sides[name]} if sides[name] else {})
        drawn = image
        if image is None:
            drawn = render_pitch(true_camera(folder, name), PitchTemplate.standard(), None, 1)
        write_still(folder / camera["still"], drawn)

    change_spec(folder, take)


def calibrate(folder, tmp_path, *cameras):
    """Return the published static cameras, and the reasons of those that are left out."""
    store = Store.create(tmp_path / "project")
    match, _ = register(store, folder)
    found, reasons = {}, {}
    for unit in plan_run(store, match, {}):
        stage, _, name = unit.name.partition("/")
        if stage in ("ingest", "proposal") or (stage == "static_calibration" and name in cameras):
            TASKS[stage].fn(unit.work(store.url, match, "0001"))
        if stage == "static_calibration" and name in cameras:
            found[name] = store.open_result(match.match_id, stage, name, unit.key)
            reasons |= store.manifest(match.match_id, stage, name, unit.key).left_out
    return found, reasons


@pytest.mark.slow  # the next one runs the same task; unit/static_calibration has its decisions
def test_a_camera_is_calibrated_from_its_image_unless_people_contradict_its_side(folder, tmp_path):
    take_clicks(folder, {TURNED: "near", "cam04": None})
    found, reasons = calibrate(folder, tmp_path, TURNED, "cam04")
    assert list(reasons) == [TURNED]
    assert "only after half a turn about the centre spot" in reasons[TURNED]
    assert "State the opposite side in match.yaml" in reasons[TURNED]
    assert found["cam04"].attrs["decisions"][0].startswith("markings proposed from the image")
    off = camera_from_arrays(found["cam04"].data_vars).center - true_camera(folder, "cam04").center
    assert np.linalg.norm(off) < 0.5


GRASS = np.full((SIZE[1], SIZE[0], 3), (60, 120, 50), np.uint8)


def test_an_image_that_shows_too_little_leaves_its_camera_out(folder, tmp_path):
    take_clicks(folder, {TURNED: "far"}, GRASS)
    _, reasons = calibrate(folder, tmp_path, TURNED)
    assert "image of cam01: expected three straight markings" in reasons[TURNED]
    assert "Click four or more named points" in reasons[TURNED]


def test_one_side_has_to_be_stated(folder, tmp_path):
    store = Store.create(tmp_path / "project")
    take_clicks(folder, {f"cam0{number}": None for number in range(6)}, GRASS)
    with pytest.raises(InputError, match=r"missing camera cam00, cam01.*give one camera a side"):
        register(store, folder)
    change_spec(folder, lambda name, camera: name == "cam03" and camera.update(side="left"))
    match, _ = register(store, folder)
    assert match.folder.to_click == ()
