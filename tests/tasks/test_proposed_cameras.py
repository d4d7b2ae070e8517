"""Cameras without clicks, from their images and the people whom they share."""

import shutil

import numpy as np
import pytest
import yaml

from flows.match import task_of
from flows.method import METHOD
from flows.registering import register
from flows.run_plan import plan_run
from worldpose.errors import InputError
from worldpose.formats.release_cameras import read_camera
from worldpose.geometry.cameras import camera_from_arrays
from worldpose.ingest.footage import write_still
from worldpose.pitch.template import PitchTemplate
from worldpose.simulation.renderer import render_pitch
from worldpose.store.store import Store

TASKS = {stage.name: task_of(stage) for stage in METHOD}
TURNED = "cam01"
"""Stands on the far side; a proposal without a stated side assumes the near one."""
SIZE = (1920, 1080)


@pytest.fixture
def folder(tiny, tmp_path):
    return shutil.copytree(tiny, tmp_path / "match")


def true_camera(folder, camera_id):
    return read_camera(folder / "reference" / "cameras" / f"{camera_id}.npz", SIZE)


def take_clicks(folder, sides, image=None):
    """Take cameras' clicks away, give them an image, and state their sides unless None."""
    spec = yaml.safe_load((folder / "match.yaml").read_text())
    for camera in spec["cameras"]:
        if camera["id"] not in sides:
            continue
        name = camera["id"]
        (folder / "annotations" / "static_calibration" / f"{name}.json").unlink()
        camera["still"] = f"stills/{name}.png"
        if sides[name] is not None:
            camera["side"] = sides[name]
        drawn = image
        if image is None:
            drawn = render_pitch(true_camera(folder, name), PitchTemplate.standard(), None, 1)
        write_still(folder / camera["still"], drawn)
    (folder / "match.yaml").write_text(yaml.safe_dump(spec))


def state_side(folder, camera_id, side):
    spec = yaml.safe_load((folder / "match.yaml").read_text())
    spec["cameras"] = [
        each | ({"side": side} if each["id"] == camera_id else {}) for each in spec["cameras"]
    ]
    (folder / "match.yaml").write_text(yaml.safe_dump(spec))


def calibrate(folder, tmp_path, *cameras):
    """Return the published static cameras, and the reasons of those that are left out."""
    store = Store.create(tmp_path / "project")
    match, _ = register(store, folder)
    stages = {"ingest", "proposal", "static_calibration"}
    found, reasons = {}, {}
    for unit in plan_run(store, match, {}):
        stage, _, name = unit.name.partition("/")
        if stage not in stages or (stage == "static_calibration" and name not in cameras):
            continue
        TASKS[stage].fn(unit.work(store.url, match, "0001"))
        if stage == "static_calibration":
            found[name] = store.open_result(match.match_id, stage, name, unit.key)
            reasons |= store.manifest(match.match_id, stage, name, unit.key).left_out
    return found, reasons


def test_a_camera_is_calibrated_from_its_image_unless_people_contradict_its_side(folder, tmp_path):
    take_clicks(folder, {TURNED: "near", "cam04": None})
    found, reasons = calibrate(folder, tmp_path, TURNED, "cam04")
    assert list(reasons) == [TURNED]
    assert "only after half a turn about the centre spot" in reasons[TURNED]
    assert "State the opposite side in match.yaml" in reasons[TURNED]
    assert found["cam04"].attrs["decisions"][0].startswith("markings proposed from the image")
    off = camera_from_arrays(found["cam04"].data_vars).center - true_camera(folder, "cam04").center
    assert np.linalg.norm(off) < 0.5


def test_an_image_that_shows_too_little_leaves_its_camera_out(folder, tmp_path):
    grass = np.full((SIZE[1], SIZE[0], 3), (60, 120, 50), np.uint8)
    take_clicks(folder, {TURNED: "far"}, grass)
    _, reasons = calibrate(folder, tmp_path, TURNED)
    assert "image of cam01: expected three straight markings" in reasons[TURNED]
    assert "Click four or more named points" in reasons[TURNED]


def test_one_side_has_to_be_stated(folder, tmp_path):
    store = Store.create(tmp_path / "project")
    grass = np.full((SIZE[1], SIZE[0], 3), (60, 120, 50), np.uint8)
    take_clicks(folder, {f"cam0{number}": None for number in range(6)}, grass)
    with pytest.raises(InputError, match=r"missing camera cam00, cam01.*give one camera a side"):
        register(store, folder)
    state_side(folder, "cam03", "left")
    match, _ = register(store, folder)
    assert match.folder.to_click == ()
