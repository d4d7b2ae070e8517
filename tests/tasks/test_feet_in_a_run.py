"""Heels and toes of 2D poses reach the store of every stage, and the exports of a run."""

import shutil
from types import SimpleNamespace

import numpy as np
import pytest
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
from worldpose.formats.joints_file import read_poses
from worldpose.formats.keypoint_files import read_keypoint_arrays, write_keypoint_arrays
from worldpose.formats.release_cameras import read_camera
from worldpose.store.store import Store

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


def compute(folder, project):
    """Compute all units up to bodies in this process; return their results by name."""
    store = Store.create(project)
    match, _ = register(store, folder)
    stages = {stage.name: stage for stage in METHOD}
    found = {}
    for unit in plan_run(store, match, {}):
        if unit.recipe.stage in STAGES:
            task_of(stages[unit.recipe.stage]).fn(unit.work(store.url, match, "0001"))
            found[unit.name] = store.open_result(
                match.match_id, unit.recipe.stage, unit.recipe.unit, unit.key
            )
    return found


@pytest.fixture(scope="module")
def run(tiny, tmp_path_factory):
    """Results by unit, and the true feet (frames, persons, 6, 3) [m]."""
    base = tmp_path_factory.mktemp("feet")
    folder = shutil.copytree(tiny, base / "match")
    shutil.copy(folder / "reference" / "calibration.toml", folder)
    truth = add_feet(folder)
    return compute(folder, base / "project"), truth


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
