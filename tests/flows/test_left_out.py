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
    page = tmp_path / "report.html"
    succeed("report", TINY, "--project", project, "--out", page)
    assert "camera cam01 is left out" in page.read_text()
    truth = ("--prediction", TINY, "--reference", tiny / "reference")
    scores = succeed("evaluate", *truth, "--project", project, "--json").json
    assert scores["coverage"] > 0.9
    assert scores["cameras"]["static"]["ground_error_median_m"] < 0.1
    out = tmp_path / "out"
    succeed("export", TINY, "--project", project, "--format", "worldpose", "--out", out)
    succeed("check", out)
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


def click_the_other_end(folder, camera):
    """Give every click of a camera the name of its place at the pitch's other end."""
    file = folder / "annotations" / "static_calibration" / f"{camera}.json"
    clicked = json.loads(file.read_text())
    for marking in (*clicked["points"], *clicked["drawn"]):
        words = marking["name"].split("_")
        marking["name"] = "_".join(OTHER_END.get(word, word) for word in words)
    file.write_text(json.dumps(clicked))


@pytest.mark.usefixtures("server")
def test_a_camera_with_clicks_of_the_other_end_is_named_and_left_out(tiny, tmp_path):
    match, project = shutil.copytree(tiny, tmp_path / "match"), tmp_path / "project"
    click_the_other_end(match, "cam02")
    answer = worldpose("run", match, "--project", project, "--until", "tracking")
    assert answer.code == 0, answer.err
    warning = " ".join(answer.err.split())
    assert "camera cam02 is left out: its calibration is turned by half a turn" in warning
    run = open_run(project, TINY)
    assert list(run.record.left_out) == ["cam02"]
    (fault,) = run["camera_consistency/clip"].attrs["faults"]
    assert (fault["camera"], fault["kind"]) == ("cam02", "flipped")
    assert fault["share_now"] < 0.3 < 0.8 < fault["share_corrected"]
    tracks = run["tracking/clip"]
    assert "cam02" not in tracks["camera"].values.tolist()
    assert len(tracks["camera"].values.tolist()) == 5
    assert run.record.figures["tracking/clip"]["unmatched_share"] < 0.1


@pytest.mark.slow
def test_a_camera_without_clicks_has_its_place_in_the_report(tiny, tmp_path):
    folder, project = shutil.copytree(tiny, tmp_path / "match"), ("--project", tmp_path / "project")
    (folder / "annotations" / "static_calibration" / "cam00.json").unlink()
    true = read_camera(tiny / "reference" / "cameras" / "cam00.npz", (1920, 1080))
    x, y = true.center[:2] / [52.5, 34.0]
    ends, place = (("left", "right"), x) if abs(x) > abs(y) else (("near", "far"), y)
    spec = yaml.safe_load((folder / "match.yaml").read_text())
    spec["cameras"][0] |= {"side": ends[int(place > 0.0)], "still": "stills/cam00.png"}
    (folder / "match.yaml").write_text(yaml.safe_dump(spec))
    still = render_pitch(true, PitchTemplate.standard(), None, 1)
    write_still(folder / "stills" / "cam00.png", still)
    listed = succeed("ingest", folder, *project)
    assert "to be clicked" not in listed.out
    succeed("run", folder, *project, "--until", "triangulation")
    succeed("report", folder, *project, "--out", tmp_path / "report.html")
    page = (tmp_path / "report.html").read_text()
    assert "proposed markings" in page


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


def test_the_end_of_a_partial_run_says_what_is_missing(project_copy, monkeypatch):
    store = Store.open(str(project_copy))
    (match,) = store.matches()
    why = "one camera alone shows people"
    changed = {"run_id": store.reserve_run(match), "state": "partial", "warnings": (why,)}
    record = store.run(match).model_copy(update=changed)
    store.finish_run(record)
    text = str(IncompleteRunError(record))
    assert why in text
    assert "0 " not in text
    last = SimpleNamespace(state="failed", message=text, changed_at=datetime.now(UTC))
    served = SimpleNamespace(link=lambda run: "http://prefect")
    seen = SimpleNamespace(open=[], ended={match: last}, served=served)
    monkeypatch.setattr(Continuing, "_look", lambda self: seen)
    state = Continuing(store).state(match)
    assert (state["code"], state["lines"]) == (4, [text])


@pytest.mark.slow
def test_one_camera_gives_positions_on_the_pitch_with_their_uncertainty(server, tmp_path):
    one = ("--scenario", "match", "--seed", 5, "--duration", 1, "--no-stills", "--cameras", 1)
    succeed("simulate", *one, "--out", tmp_path / "one")
    (tmp_path / "one/videos").mkdir()
    grey = (np.full((1080, 1920, 3), 90, np.uint8) for _ in range(50))
    write_video(tmp_path / "one/videos/cam00.mp4", grey, 50.0)
    project = ("--project", tmp_path / "worldpose-data")
    answer = worldpose("run", tmp_path / "one", *project)
    assert answer.code == 4, answer.err
    assert "one camera alone shows people" in answer.err
    assert "people are placed on the pitch from their feet" in answer.err
    assert "placed no joint" not in answer.err
    match = library.read_match(tmp_path / "one").spec.match_id
    succeed("export", match, *project, "--format", "positions", "--out", tmp_path / "out")
    with (tmp_path / "out/positions/clip.csv").open() as file:
        rows = list(csv.DictReader(file))
    view = tmp_path / "view.html"
    succeed("export", match, *project, "--format", "viewer", "--out", view)
    (parts,) = read_viewer(view)
    scene, _ = decode_part(parts["scene"])
    header, arrays = decode_part(parts["0"])
    assert {person["kind"] for person in scene["people"]} == {"plane"}
    shown = [scene["people"][column]["id"] for column in header["plane"]]
    for row in rows:
        at = int(row["frame"]) - scene["first"], shown.index(int(row["person"]))
        assert (
            np.abs(arrays["ground"][at][:2] - [float(row["x_m"]), float(row["y_m"])]).max() < 1e-3
        )
    page = tmp_path / "report.html"
    succeed("report", match, "--out", page, "--no-videos", *project)
    assert page.read_text().count("<td>plane</td>") == len({row["person"] for row in rows})
    tiles = page.read_text()
    assert f"{len(shown)}</b>" in tiles
    assert "people on the pitch, 0 with joints" in tiles
    assert "people per frame" not in tiles
    measured = ("clock_error_frames", "noise_factor", "offset_rms_m", "people_shift_m")
    assert not [name for name in measured if name in tiles]
    assert "<b>0 m</b>" not in tiles
    refused = worldpose("export", match, *project, "--format", "trc", "--out", tmp_path / "trc")
    assert refused.code == 1
    assert "expected a person with joints" in refused.err
    check_pages(tmp_path, match)
    errors, inside, people = errors_of(tmp_path / "out/positions/clip.csv", tmp_path / "one")
    assert people >= 10
    assert np.median(errors) < 0.3
    assert inside > 0.9
    heights = [float(row["height_m"]) for row in rows]
    assert 1.6 < np.median(heights) < 2.0


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
