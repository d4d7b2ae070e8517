"""Cameras that are left out, or proposed without a click, and what pages say of them."""

import csv
import json
import shutil
from dataclasses import replace
from datetime import UTC, datetime
from pathlib import Path
from types import SimpleNamespace
from unittest.mock import patch

import numpy as np
import page_client
import pytest
import yaml
from camera_builders import plain_camera
from chromium import IN_BROWSER, drive
from command_line import TINY, succeed, worldpose
from fastapi import HTTPException
from filmed import write_filmed
from page_client import MATCH
from test_broadcast_run import errors_of

import worldpose as library
from flows.match import IncompleteRunError
from flows.registering import open_for_review, open_match
from flows.reports.cameras import camera_table
from flows.stages.broadcast_calibration import uncalibrated_warnings
from flows.web.app_context import Continuing
from flows.web.calibration import Pictures
from flows.web.evidence import draw_evidence
from flows.web.images import file_mark
from worldpose.formats.calibration_forms import read_calibration
from worldpose.formats.calibration_writer import write_calibration_toml
from worldpose.formats.release_cameras import read_camera
from worldpose.formats.viewer_file import decode_part, read_viewer
from worldpose.ingest.footage import write_still
from worldpose.ingest.match_folder import read_spec
from worldpose.pitch.template import PitchTemplate
from worldpose.simulation.renderer import render_pitch
from worldpose.simulation.scene import look_at
from worldpose.store.store import Store, open_run
from worldpose.video.files import write_video


def spoil(folder, camera):
    """Leave a camera two clicks, which determine nothing."""
    file = folder / "annotations" / "static_calibration" / f"{camera}.json"
    clicked = json.loads(file.read_text())
    clicked["points"], clicked["drawn"] = clicked["points"][:2], []
    file.write_text(json.dumps(clicked))


@pytest.mark.slow
def test_a_match_with_a_camera_that_cannot_be_calibrated_is_complete_and_warns(tiny, tmp_path):
    folder = shutil.copytree(tiny, tmp_path / "match")
    spoil(folder, "cam01")
    project = tmp_path / "project"
    done = worldpose("run", folder, "--project", project, "--json")
    assert done.code == 0, done.err
    assert list(done.json["left_out"]) == ["cam01"]
    (warning,) = [text for text in done.json["warnings"] if "left out" in text]
    assert warning in " ".join(done.err.split())
    run = open_run(project, TINY)
    assert run.record.state == "complete"
    assert run.record.left_out == done.json["left_out"]
    cameras = run["tracking/clip"]["camera"].values.tolist()
    assert "cam01" not in cameras
    assert run["bundle_adjustment/cameras"]["camera"].values.tolist() == cameras
    assert run["body_fitting/clip"].sizes["person"] > 0

    status = succeed("status", "--project", project, "--json").json
    assert warning in status["matches"][0]["warnings"]
    out = tmp_path / "out"
    succeed("export", TINY, "--project", project, "--format", "worldpose", "--out", out)
    assert not list(out.rglob("*cam01*"))
    # Run again: nothing is computed, and the warning is not forgotten.
    again = succeed("run", folder, "--project", project, "--json").json
    assert (again["executed"], again["left_out"]) == (0, done.json["left_out"])


def test_a_match_with_one_usable_camera_is_partial_and_gates_ask_first(tiny, tmp_path):
    folder = shutil.copytree(tiny, tmp_path / "match")
    project = tmp_path / "project"
    names = sorted(f.stem for f in (folder / "annotations" / "static_calibration").iterdir())
    for camera in names[1:]:
        spoil(folder, camera)
    asked = worldpose("run", folder, "--project", project, "--gates", "auto", "--json")
    assert asked.code == 3, asked.err
    reasons = {each["unit"]: each["reasons"] for each in asked.json["reviews"]}
    assert "would be left out" in reasons[f"static_calibration/{names[1]}"][0]
    done = worldpose("run", folder, "--project", project, "--gates", "never", "--json")
    assert done.code == 4, done.err
    assert done.json["failed"] == 0
    assert done.json["blocked"] > 0
    assert sorted(done.json["left_out"]) == names[1:]
    assert f"1 of {len(names)} static cameras can be used ({names[0]})" in done.json["warnings"][-1]


def test_a_broken_video_leaves_its_camera_out_and_a_lost_one_hides_no_results(tmp_path):
    folder, project = tmp_path / "match", tmp_path / "project"
    dark = [9, 9, 9, 9]
    write_filmed(folder, {"a": dark, "b": dark, "c": dark}, [("clip", 0, 4)])
    file = folder / "videos" / "b.mp4"
    file.write_bytes(file.read_bytes()[:40])
    first = ("run", folder, "--project", project, "--until", "static_calibration", "--json")
    done = worldpose(*first)
    assert done.code == 0, done.err
    assert list(done.json["left_out"]) == ["b"]
    assert done.json["left_out"]["b"].startswith("b.mp4: expected a video file")

    keys = open_run(project, "filmed").record.results
    (folder / "videos" / "c.mp4").unlink()
    again = succeed(*first).json
    assert (again["executed"], open_run(project, "filmed").record.results) == (0, keys)
    assert succeed("status", folder, "--project", project, "--json").json["matches"]
    run = open_run(project, "filmed")
    rows = {row[0]: row[-1] for row in camera_table(run, read_spec(folder)).rows}
    assert rows["b"].startswith("left out: b.mp4")


OTHER_END = {"left": "right", "right": "left", "near": "far", "far": "near"}


def other_end(marking):
    return "_".join(OTHER_END.get(word, word) for word in marking.split("_"))


@pytest.mark.usefixtures("server")
def test_a_camera_with_clicks_of_the_other_end_is_named_and_left_out(tiny, tmp_path):
    match, project = shutil.copytree(tiny, tmp_path / "match"), tmp_path / "project"
    given = read_calibration(tiny / "reference" / "calibration.toml")
    del given["cam02"]
    write_calibration_toml(match / "calibration.toml", given)
    file = match / "annotations" / "static_calibration" / "cam02.json"
    clicked = json.loads(file.read_text())
    for marking in (*clicked["points"], *clicked["drawn"]):
        marking["name"] = other_end(marking["name"])
    file.write_text(json.dumps(clicked))
    answer = worldpose("run", match, "--project", project, "--until", "tracking")
    assert answer.code == 0, answer.err
    warning = " ".join(answer.err.split())
    assert "camera cam02 is left out: its calibration is turned by half a turn" in warning
    run = open_run(project, TINY)
    assert list(run.record.left_out) == ["cam02"]
    (fault,) = run["camera_consistency/clip"].attrs["faults"]
    assert (fault["camera"], fault["kind"]) == ("cam02", "flipped")
    assert fault["share_now"] < 0.3 < 0.8 < fault["share_corrected"]
    cameras = run["tracking/clip"]["camera"].values.tolist()
    assert len(cameras) == 5 and "cam02" not in cameras
    assert run.record.figures["tracking/clip"]["unmatched_share"] < 0.1


def test_a_broadcast_video_that_nothing_calibrates_is_reported(store):
    match = open_match(store, TINY)
    assert uncalibrated_warnings(match) == ()
    videos = {"clip": match.folder.folder / "broadcast" / "clip.mp4"}
    (said,) = uncalibrated_warnings(replace(match, folder=replace(match.folder, videos=videos)))
    assert "of clip clip is not used: it needs clicks in" in said


def check_pages(folder, match):
    """The pages reach the positions of the run, and say why there is no 3D."""
    project = folder / "worldpose-data"
    ada, path = page_client.log_in(page_client.served(project), "Ada"), f"/api/matches/{match}"
    found = ada.get(f"{path}/results").json()
    assert (found["state"], found["later"]) == ("partial", "")
    assert set(found["formats"]) == {"positions", "minimap", "csv", "parquet", "viewer"}
    for form in found["formats"]:
        assert ada.get(f"{path}/results/exports/{form}").status_code == 200, form
    assert ada.get(f"{path}/results/report").status_code == 200
    (clip,) = found["clips"]
    assert "one camera alone shows people" in clip["without_joints"]
    assert "people are placed on the pitch from their feet" in clip["without_joints"]
    # A person without joints is seen, too: the image is where the detection is.
    person, *_ = ada.get(f"{path}/identities/clip").json()["people"]
    assert any(person["way"])  # from above, the person is where the feet are
    crop = {"person": person["id"], "frame": person["segments"][0][0]}
    answer = ada.get(f"{path}/identities/clip/crop", params=crop)
    assert (answer.status_code, answer.headers["content-type"]) == (200, "image/png"), answer.text

    # A question about the tracks shows the paths of the feet.
    store = Store.open(str(project))
    keys = {"tracking/clip": store.run(match).results["tracking/clip"]}
    asked = SimpleNamespace(gate="tracking", match_id=match, keys=keys)
    with patch("flows.web.evidence.plot_paths") as plot:
        draw_evidence(store, open_for_review(store, match), asked)
    assert np.isfinite(plot.call_args[0][0].joints).all(axis=-1).any(axis=(0, 2)).sum() >= 10


def test_the_end_of_a_partial_run_says_what_is_missing(store, monkeypatch):
    why = "one camera alone shows people"
    changed = {"run_id": store.reserve_run(TINY), "state": "partial", "warnings": (why,)}
    store.finish_run(store.run(TINY).model_copy(update=changed))
    text = str(IncompleteRunError(store.run(TINY)))
    assert why in text and "0 " not in text
    last = SimpleNamespace(state="failed", message=text, changed_at=datetime.now(UTC))
    served = SimpleNamespace(link=lambda run: "http://prefect")
    seen = SimpleNamespace(open=[], ended={TINY: last}, served=served)
    monkeypatch.setattr(Continuing, "_look", lambda self: seen)
    state = Continuing(store).state(TINY)
    assert (state["code"], state["lines"]) == (4, [text])


@pytest.mark.slow
def test_one_camera_gives_positions_on_the_pitch_with_their_uncertainty(server, tmp_path):
    folder, project = tmp_path / "one", ("--project", tmp_path / "worldpose-data")
    one = ("--scenario", "match", "--seed", 5, "--duration", 1, "--no-stills", "--cameras", 1)
    succeed("simulate", *one, "--out", folder)
    (folder / "videos").mkdir()
    grey = (np.full((1080, 1920, 3), 90, np.uint8) for _ in range(50))
    write_video(folder / "videos/cam00.mp4", grey, 50.0)
    answer = worldpose("run", folder, *project)
    assert answer.code == 4, answer.err
    assert "one camera alone shows people" in answer.err
    match = library.read_match(folder).spec.match_id
    succeed("export", match, *project, "--format", "positions", "--out", tmp_path / "out")
    with (tmp_path / "out/positions/clip.csv").open() as file:
        rows = list(csv.DictReader(file))
    view, page = tmp_path / "view.html", tmp_path / "report.html"
    succeed("export", match, *project, "--format", "viewer", "--out", view)
    (parts,) = read_viewer(view)
    scene, _ = decode_part(parts["scene"])
    assert {person["kind"] for person in scene["people"]} == {"plane"}
    succeed("report", match, "--out", page, "--no-videos", *project)
    assert page.read_text().count("<td>plane</td>") == len({row["person"] for row in rows})
    assert "people on the pitch, 0 with joints" in page.read_text()
    assert "<b>0 m</b>" not in page.read_text()
    check_pages(tmp_path, match)
    errors, inside, people = errors_of(tmp_path / "out/positions/clip.csv", folder)
    assert people >= 10
    assert np.median(errors) < 0.3
    assert inside > 0.9
    assert 1.6 < np.median([float(row["height_m"]) for row in rows]) < 2.0


SIZE = (1920, 1080)


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
    assert {other_end(name) for name in near["drawn"]} == set(found["drawn"])
    edit = {"kind": "redrawn_marking", "camera": "cam01", "was": []}
    edits = [
        {"id": f"redrawn_marking.{number:012x}", "edit": {**edit, "marking": name, "xy": pixels}}
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
    # One line and a part of a circle: no single camera explains them.
    pose = look_at(np.array([0.0, -60.0, 22.0]), np.array([0.0, -9.0, 0.0]), 0.005)
    camera = plain_camera(3600.0, 0.5 * (np.array(SIZE) - 1.0), pose, SIZE)
    write_image(folder, "cam01", render_pitch(camera, PITCH, None, 3), side="far")
    project = tmp_path / "project"
    asked = ("--gates", "auto", "--until", "static_calibration")
    ended = worldpose("run", folder, "--project", project, *asked)
    assert ended.code == 3, ended.err
    ada = page_client.log_in(page_client.served(project), "Ada")
    reviews = ada.get(MATCH).json()["reviews"]
    (review,) = (each for each in reviews if each["unit"] == "static_calibration/cam01")
    assert any("one camera that explains the paint" in each for each in review["reasons"])
    evidence = ada.get(f"{MATCH}/reviews/{review['id']}/evidence").json()
    (caption,) = evidence["pictures"]
    assert "accept the proposal" in caption
    picture = ada.get(f"{MATCH}/reviews/{review['id']}/pictures/0")
    assert picture.content.startswith(b"\x89PNG")
    found = ada.post(f"{MATCH}/pictures/cam01/proposal", json={"side": "far"}).json()
    assert "Click four or more named points" in found["reason"]
    assert found["drawn"]


@IN_BROWSER[0]
@IN_BROWSER[1]
@IN_BROWSER[2]
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
