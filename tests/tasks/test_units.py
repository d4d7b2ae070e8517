"""A task computes what its key stands for, or refuses."""

import json
import math
import re
import shutil
import tomllib

import numpy as np
import pytest
import yaml
from camera_builders import look_at_camera
from prefect.states import Failed

from data_contracts.static_calibration import ClickedMarkings
from flows.registering import register
from flows.run_plan import plan_run
from tasks.ingest import ingest
from tasks.static_calibration import static_calibration
from tasks.unit import unit_task
from worldpose.errors import CorruptionError, InputError, StoreError, WorldposeError
from worldpose.formats.release_cameras import read_camera
from worldpose.geometry.cameras import camera_from_arrays
from worldpose.ingest.importing import import_lenses
from worldpose.ingest.match_folder import read_match
from worldpose.pitch.template import PitchTemplate
from worldpose.review.evidence import PitchDrawing, preview
from worldpose.store.recipes import recipe_differences
from worldpose.store.store import Store


@pytest.fixture
def clicked(tiny, tmp_path):
    """A store, a match of its own folder, and its plan by unit."""
    store = Store.create(tmp_path / "project")
    match, _ = register(store, shutil.copytree(tiny, tmp_path / "match"))
    return store, match, {unit.name: unit for unit in plan_run(store, match, {})}


@pytest.fixture
def planned(tiny, tmp_path):
    """The same with given cameras, which are quick, and the plan of its first unit."""
    folder = shutil.copytree(tiny, tmp_path / "match")
    shutil.copy(folder / "reference" / "calibration.toml", folder)
    store = Store.create(tmp_path / "project")
    match, _ = register(store, folder)
    return store, match, plan_run(store, match, {})[0]


def calibrated(store, match, camera=None, unit=None):
    """A camera's calibration, computed in this process, and its manifest."""
    plan = (u for u in plan_run(store, match, {}) if u.recipe.stage == "static_calibration")
    unit = unit or next(u for u in plan if camera in (None, u.recipe.unit))
    static_calibration.fn(unit.work(store.url, match, "0001"))
    place = (match.match_id, "static_calibration", unit.recipe.unit, unit.key)
    return store.open_result(*place), store.manifest(*place)


def test_an_edit_after_planning_does_not_reach_the_result(planned, tmp_path):
    store, match, _ = planned
    unit = next(u for u in plan_run(store, match, {}) if u.recipe.stage == "static_calibration")
    calibration = tmp_path / "match" / "calibration.toml"
    text = calibration.read_text()
    calibration.write_text(text.replace("translation = [", "translation = [1", 1))
    assert calibration.read_text() != text
    stored, _ = calibrated(store, match, unit=unit)
    planned_translation = unit.recipe.sources["calibration"]["translation"]
    assert stored["translation"].values.tolist() == pytest.approx(planned_translation)
    assert stored.attrs["origin"] == "given"


def test_a_run_tells_of_a_given_lens_that_folds_at_the_corners(planned, tmp_path):
    calibration = tmp_path / "match" / "calibration.toml"
    (given, *_) = tomllib.loads(calibration.read_text()).values()
    corner = math.hypot(*given["size"]) / 2 / given["matrix"][0][0]
    # r (1 + k1 r^2) grows up to r = 1 / sqrt(-3 k1), to two thirds of that: 0.9 of the corner.
    folds = f"distortions = [{-((2 / (3 * 0.9 * corner)) ** 2) / 3}, 0, 0, 0, 0]"
    text = re.sub(r"distortions = \[.*\]", folds, calibration.read_text(), count=1)
    calibration.write_text(text)
    match, _ = register(planned[0], tmp_path / "match")
    (said,) = calibrated(planned[0], match)[1].warnings
    assert ": the lens model folds within the image" in said


def test_an_imported_lens_is_the_prior_of_its_camera_and_of_no_other(clicked, tmp_path):
    store, match, units = clicked
    folder = match.folder.folder
    truth = read_camera(folder / "reference" / "cameras" / "cam00.npz")
    (fx, fy), (cx, cy) = np.ravel(truth.focal)[:2], np.ravel(truth.principal_point)[:2]
    matrix = [[fx, 0.0, cx], [0.0, fy, cy], [0.0, 0.0, 1.0]]
    np.savez(tmp_path / "lens.npz", mtx=matrix, dist=np.ravel(truth.distortion)[:5])
    lens = import_lenses([tmp_path / "lens.npz"], folder, "cam00")["cam00"]
    match, is_new = register(store, folder)
    assert is_new and match.registration.digest_of("lenses.toml")
    changed = {u.name for u in plan_run(store, match, {}) if u.key != units[u.name].key}
    assert "static_calibration/cam00" in changed
    assert not {name for name in changed if name.startswith("static_calibration/cam01")}
    stored, _ = calibrated(store, match, "cam00")
    assert stored["focal"].values[0] == pytest.approx(lens.focal_px, rel=0.01)
    assert any("the given lens" in each for each in stored.attrs["decisions"])
    with pytest.raises(InputError, match=r"lenses\.toml: cam00.*expected no lens"):
        import_lenses([tmp_path / "lens.npz"], folder, "cam00")
    shutil.copy(folder / "reference" / "calibration.toml", folder)
    with pytest.raises(InputError, match="Remove them from one of the two files"):
        read_match(folder)


def test_a_moved_click_reaches_its_camera_and_what_sees_through_it_alone(clicked, tmp_path):
    store, match, before = clicked
    file = sorted((tmp_path / "match" / "annotations" / "static_calibration").iterdir())[2]
    content = json.loads(file.read_text())
    content["points"].reverse()  # their order is no part of what was clicked
    file.write_text(json.dumps(content))
    match, _ = register(store, tmp_path / "match")
    after = {unit.name: unit for unit in plan_run(store, match, {})}
    assert [unit.key for unit in after.values()] == [unit.key for unit in before.values()]

    point = content["points"][1]
    point["xy"][0] += 0.5
    file.write_text(json.dumps(content))
    match, _ = register(store, tmp_path / "match")
    after = {unit.name: unit for unit in plan_run(store, match, {})}
    changed = {name for name, unit in after.items() if unit.key != before[name].key}
    camera = f"static_calibration/{file.stem}"
    clip = (
        *("camera_consistency", "tracking", "triangulation"),
        *("retriangulation", "body_fitting", "filtering"),
    )
    assert changed == {camera, "bundle_adjustment/cameras", *(f"{stage}/clip" for stage in clip)}
    # What `worldpose why` and `worldpose diff` say.
    (difference,) = recipe_differences(before[camera].recipe, after[camera].recipe)
    reason = str(difference)
    assert f"annotations/static_calibration/{file.name}.points.{point['name']}[0]: " in reason
    assert reason.endswith(f" -> {point['xy'][0]}")


def test_a_stated_side_decides_clicks_that_both_sides_see_alike(clicked):
    store, match, _ = clicked
    folder, camera = match.folder.folder, look_at_camera((0, -75, 18), (0, 0, 0), 2100.0)
    shutil.rmtree(folder / "reference")
    spec, drawn, found = yaml.safe_load((folder / "match.yaml").read_text()), [], {}
    for name in ("center_circle", "halfway_line"):
        pixels = camera.project(PitchTemplate.standard().marking_points(name, 2.0))
        inside = ((pixels > 0.0) & (pixels < camera.image_size - 1.0)).all(axis=1)
        drawn.append({"name": name, "xy": pixels[inside].tolist()})
    clicks = folder / "annotations" / "static_calibration" / "cam00.json"
    clicks.write_text(json.dumps(json.loads(clicks.read_text()) | {"points": [], "drawn": drawn}))
    pitch, given = PitchDrawing(PitchTemplate.standard()), ClickedMarkings(drawn=drawn)
    for side in (None, "near", "far"):
        spec["cameras"][0] |= {"width": 1920, "height": 1080, "side": side}
        (folder / "match.yaml").write_text(yaml.safe_dump(spec))
        match, _ = register(store, folder)
        stored, _ = calibrated(store, match, "cam00")
        center = camera_from_arrays(stored.data_vars).center if stored.data_vars else np.zeros(3)
        found[side] = np.sign(np.ravel(center)[1])
        if side:  # the page shows what the run takes
            shown = preview(pitch, given, (1920, 1080), side=side).camera
            assert np.sign(shown.center[1]) == found[side]
    assert found == {None: 0.0, "near": -1.0, "far": 1.0}


def test_a_given_camera_wins_over_clicks(clicked, tmp_path):
    store, match, before = clicked
    folder = tmp_path / "match"
    shutil.copy(folder / "reference" / "calibration.toml", folder)
    match, _ = register(store, folder)
    given = {unit.name: unit for unit in plan_run(store, match, {})}
    sources = given["static_calibration/cam00"].recipe.sources
    assert list(sources) == ["calibration"]
    assert given["ingest/cam00"].key == before["ingest/cam00"].key
    # Then its clicks decide nothing any more.
    (folder / "annotations" / "static_calibration" / "cam00.json").unlink()
    match, _ = register(store, folder)
    assert [u.key for u in plan_run(store, match, {})] == [u.key for u in given.values()]


def test_detections_that_changed_after_planning_are_refused(planned, tmp_path):
    store, match, unit = planned
    others = sorted((tmp_path / "match" / "detections").iterdir())
    shutil.copy(others[1], others[0])
    with pytest.raises(InputError, match="registered when the run began"):
        ingest.fn(unit.work(store.url, match, "0001"))
    assert not store.has(match.match_id, "ingest", unit.recipe.unit, unit.key)


@pytest.mark.parametrize(("part", "name"), [("code", "worldpose.errors"), ("libraries", "numpy")])
def test_a_worker_with_other_code_refuses(planned, part, name):
    store, match, unit = planned
    others = getattr(unit.recipe, part) | {name: "another"}
    recipe = unit.recipe.model_copy(update={part: others})
    work = unit.work(store.url, match, "0001").model_copy(update={"recipe": recipe})
    with pytest.raises(InputError, match=f"others in {name}"):
        ingest.fn(work)


@pytest.mark.parametrize(
    ("failure", "retried"),
    [
        (StoreError("disk full"), True),
        (OSError("connection lost"), True),
        (CorruptionError("flipped byte"), False),
        (ValueError("a bug"), False),
    ],
)
def test_what_may_pass_is_tried_again(failure, retried):
    task = unit_task(lambda inputs, result: None)
    assert task.retry_condition_fn(task, None, Failed(data=failure)) is retried


@pytest.mark.parametrize(
    ("raised", "told"),
    [
        (ValueError("odd shapes"), "This is a bug in worldpose, not in your data"),
        (MemoryError("7 GiB"), "not enough memory (7 GiB)"),
    ],
)
def test_a_bug_in_a_unit_is_not_blamed_on_the_match(planned, monkeypatch, raised, told):
    store, match, unit = planned

    def compute(inputs, result):
        raise raised

    monkeypatch.setattr("tasks.unit.require_same_code", lambda work, module: None)
    with pytest.raises(WorldposeError) as caught:
        unit_task(compute).fn(unit.work(store.url, match, "0001"))
    assert unit.name in str(caught.value) and told in str(caught.value)
