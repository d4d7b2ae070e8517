"""Markings proposed without a click: on the calibration page, and at the gate of its camera."""

import shutil
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import page_client
import pytest
import yaml
from camera_builders import plain_camera
from chromium import IN_BROWSER, drive
from command_line import TINY, succeed, worldpose
from fastapi import HTTPException
from page_client import MATCH

from flows.registering import open_match
from flows.web.calibration import Pictures
from flows.web.images import file_mark
from worldpose.formats.release_cameras import read_camera
from worldpose.ingest.footage import write_still
from worldpose.pitch.template import PitchTemplate
from worldpose.simulation.renderer import render_pitch
from worldpose.simulation.scene import look_at
from worldpose.store.store import Store

SIZE = (1920, 1080)


def in_browser(test):
    """Mark a test that needs a browser."""
    for mark in IN_BROWSER:
        test = mark(test)
    return test


PITCH = PitchTemplate.standard()


def write_image(folder, name, image, **further):
    """Take a camera's clicks away and give it a still."""
    (folder / "annotations" / "static_calibration" / f"{name}.json").unlink()
    spec = yaml.safe_load((folder / "match.yaml").read_text())
    for camera in spec["cameras"]:
        if camera["id"] == name:
            camera |= {"still": f"stills/{name}.png", **further}
    (folder / "match.yaml").write_text(yaml.safe_dump(spec))
    write_still(folder / "stills" / f"{name}.png", image)


def middle_of_the_pitch():
    """An image with one line and a part of a circle: no single camera explains them."""
    camera = plain_camera(
        3600.0,
        0.5 * (np.array(SIZE) - 1.0),
        look_at(np.array([0.0, -60.0, 22.0]), np.array([0.0, -9.0, 0.0]), 0.005),
        SIZE,
    )
    return render_pitch(camera, PITCH, None, 3)


def test_lines_are_sought_in_the_still_that_took_the_place_of_another(tmp_path):
    pictures, shown = Pictures(), []
    for version, level in (("first", 40), ("second", 200)):
        still = tmp_path / version / "cam01.png"
        write_still(still, np.full((48, 64, 3), level, np.uint8))
        spec = SimpleNamespace(camera=lambda name: SimpleNamespace(width=64, height=48))
        known = SimpleNamespace(stills={"cam01": still}, videos={}, spec=spec)
        match = SimpleNamespace(match_id="final", folder=known)
        shown.append(pictures.decode_image(match, "cam01", None).mean())
    assert shown == [40, 200]
    still.unlink()
    for look in (pictures.decode_image, pictures.png):
        with pytest.raises(HTTPException, match="the still is not at hand"):
            look(match, "cam01", None)


def test_an_image_that_is_written_anew_in_its_folder_gives_another_mark(tmp_path):
    image = tmp_path / "000.png"
    image.write_bytes(b"dark")
    (tmp_path / "left_out").symlink_to("nowhere")
    mark = file_mark(tmp_path)
    image.write_bytes(b"bright")
    assert file_mark(tmp_path) != mark == (mark[0], tmp_path.stat().st_size + 4, mark[2])


@pytest.fixture
def folder(tiny, tmp_path):
    return shutil.copytree(tiny, tmp_path / "match")


@pytest.mark.slow
def test_a_proposal_is_drawn_accepted_and_kept(folder, tiny, tmp_path):
    true = read_camera(tiny / "reference" / "cameras" / "cam01.npz", SIZE)
    write_image(folder, "cam01", render_pitch(true, PITCH, None, 1), side="far")
    project = tmp_path / "project"
    succeed("ingest", folder, "--project", project)
    ada = page_client.log_in(page_client.served(project), "Ada")
    path = f"{MATCH}/pictures/cam01"
    assert (ada.get(path).json()["side"], ada.get(path).json()["drawn"]) == ("far", {})
    assert ada.post(f"{path}/proposal", json={"side": "above"}).status_code == 422
    found = ada.post(f"{path}/proposal", json={"side": "far"}).json()
    assert found["reason"] == ""
    assert len(found["drawn"]) >= 4
    for name, pixels in found["drawn"].items():
        truth = true.project(PITCH.marking_points(name, 0.05))
        away = np.linalg.norm(np.array(pixels)[:, None] - truth, axis=-1)
        assert np.median(np.nanmin(away, axis=1)) < 3.0
        drawn = np.concatenate([np.array(each) for each in found["markings"][name]])
        assert np.isfinite(drawn).all()
    # The other side has the same lines under the names of the other half.
    near = ada.post(f"{path}/proposal", json={"side": "near"}).json()
    swap = {"left": "right", "right": "left", "near": "far", "far": "near"}
    turned = {"_".join(swap.get(word, word) for word in name.split("_")) for name in near["drawn"]}
    assert turned == set(found["drawn"])
    edits = [
        {
            "id": f"redrawn_marking.{number:012x}",
            "edit": {
                "kind": "redrawn_marking",
                "camera": "cam01",
                "marking": name,
                "was": [],
                "xy": pixels,
            },
        }
        for number, (name, pixels) in enumerate(found["drawn"].items())
    ]
    answer = ada.post(f"{MATCH}/corrections", json={"edits": edits})
    assert answer.is_success, answer.text
    assert set(ada.get(path).json()["drawn"]) == set(found["drawn"])
    clicked = open_match(Store.open(str(project)), TINY).folder.clicked["cam01"]
    assert {each.name for each in clicked.drawn} == set(found["drawn"])
    camera = ada.post(f"{path}/preview", json={"drawn": found["drawn"]}).json()["camera"]
    assert np.linalg.norm(np.array(camera["center"]) - true.center) < 3.0


@pytest.mark.slow
def test_an_unclear_proposal_waits_with_its_image_and_the_reason(folder, tmp_path):
    write_image(folder, "cam01", middle_of_the_pitch(), side="far")
    project = tmp_path / "project"
    ended = worldpose(
        *("run", folder, "--project", project, "--gates", "auto", "--until", "static_calibration")
    )
    assert ended.code == 3, ended.err
    ada = page_client.log_in(page_client.served(project), "Ada")
    reviews = ada.get(MATCH).json()["reviews"]
    (review,) = (each for each in reviews if each["unit"] == "static_calibration/cam01")
    assert any("one camera that explains the paint" in each for each in review["reasons"])
    evidence = ada.get(f"{MATCH}/reviews/{review['id']}/evidence").json()
    (caption,) = evidence["pictures"]
    assert "accept the proposal" in caption
    (table,) = evidence["tables"]
    assert any(row[0] == "center circle" or "line" in row[0] for row in table["rows"])
    picture = ada.get(f"{MATCH}/reviews/{review['id']}/pictures/0")
    assert picture.content.startswith(b"\x89PNG")
    (tmp_path / "unclear.png").write_bytes(picture.content)
    found = ada.post(f"{MATCH}/pictures/cam01/proposal", json={"side": "far"}).json()
    assert "Click four or more named points" in found["reason"]
    assert found["drawn"]


@in_browser
def test_a_person_accepts_a_proposal_and_takes_it_back_at_once(folder, tiny, tmp_path):
    true = read_camera(tiny / "reference" / "cameras" / "cam01.npz", SIZE)
    write_image(folder, "cam01", render_pitch(true, PITCH, None, 1), side="far")
    project = tmp_path / "project"
    succeed("ingest", folder, "--project", project)
    script = Path(__file__).with_name("proposal_in_browser.mjs")
    with page_client.serving(project, tmp_path) as base:
        task = {"base": base, "token": page_client.TOKEN, "match": TINY, "camera": "cam01"}
        seen = drive(script, task, tmp_path, 600)
    assert seen["side"] == "far"
    assert "Found: " in seen["names"]
    first, undone, redone = seen["drawn"]
    assert first >= 4
    assert (undone, redone) == (0, first)
