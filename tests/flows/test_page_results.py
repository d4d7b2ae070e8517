"""The page of a match shows and downloads the results of a complete run."""

import io
import shutil
import zipfile
from importlib.util import find_spec

import numpy as np
import page_client
import pytest
from command_line import TINY, invoke, worldpose
from page_client import MATCH

from data_contracts.release import EXPORT_FORMATS
from data_contracts.review import SplitTrack
from data_contracts.run import UnitFailure, WaitingUnit
from flows.registering import open_match
from flows.reports.cameras import camera_table
from flows.results.best_results import fitted_bodies
from flows.results.evaluation import score
from flows.results.possible_exports import OF_BODIES, OF_BROADCAST, OF_EXTRAS, impossible_exports
from flows.review.corrections import keep_edits
from worldpose.formats.viewer_file import decode_bodies, decode_part, read_viewer
from worldpose.store.store import Run, Store, open_run


def test_a_complete_run_gives_its_report_and_its_exports(reader):
    found = reader.get(f"{MATCH}/results").json()
    absent = {form for form, name in OF_EXTRAS.items() if find_spec(name) is None}
    assert set(found["impossible"]) == {*OF_BROADCAST, *absent}
    possible = [form for form in EXPORT_FORMATS if form not in found["impossible"]]
    assert (found["run"], found["formats"]) == ("0001", possible)
    judged = reader.get(MATCH).json()["run"]["usability"]
    assert judged["verdict"] == "usable with reservations"
    assert [text.partition(" contradict")[0] for text in judged["reservations"]] == [
        "clicks of cam03"
    ]
    assert found["purposes"]["bvh"].startswith("a skeleton in motion for Blender")
    clip = {"id": "clip", "video": None, "without_joints": None}
    assert found["clips"] == [clip]  # given keypoints: nothing is filmed
    health = reader.get(f"{MATCH}/results/health/clip")
    assert health.headers["content-type"] == "image/png"
    assert health.content.startswith(b"\x89PNG")
    assert reader.get(f"{MATCH}/results/health/other").status_code == 404
    page = reader.get(f"{MATCH}/results/report")
    assert page.headers["content-type"].startswith("text/html")
    assert "3D view" in page.text
    # Its scripts run without a session: they can neither read nor change anything here.
    policy = page.headers["content-security-policy"]
    assert policy.startswith("sandbox allow-scripts")
    assert "allow-same-origin" not in policy
    assert "default-src 'none'" in policy
    answer = reader.get(f"{MATCH}/results/exports/joints")
    assert "0001-joints.zip" in answer.headers["content-disposition"]
    with zipfile.ZipFile(io.BytesIO(answer.content)) as archive:
        joints = np.load(io.BytesIO(archive.read("joints.npz")))["joints"]
    assert joints.shape[2:] == (17, 3)
    assert np.isfinite(joints).any()
    # Asked again, it is the file that was drawn.
    assert reader.get(f"{MATCH}/results/exports/joints").content == answer.content
    refused = {"videos/clip": 404, "videos/other": 404, "exports/fbx": 404, "scenes/other": 404}
    refused |= {"scenes/clip/frames?first=-1&count=2": 422, "exports/slahmr-cameras": 422}
    for path, status in refused.items():
        assert reader.get(f"{MATCH}/results/{path}").status_code == status, path
    assert "expected" in reader.get(f"{MATCH}/results/exports/slahmr-cameras").json()["error"]


def parts(ada):
    """The scene, and all ranges of frames as the page asks for them."""
    scene = ada.get(f"{MATCH}/results/scenes/clip").content
    header, _ = decode_part(scene)
    step = header["range_frames"]
    asked = (f"first={first}&count={step}" for first in range(0, header["frames"], step))
    return scene, [ada.get(f"{MATCH}/results/scenes/clip/frames?{each}").content for each in asked]


def test_the_page_gets_the_bodies_of_the_store(reader, tiny_run):
    scene, ranges = parts(reader)
    model, poses, persons, _ = fitted_bodies(open_run(str(tiny_run), TINY), "clip")
    header, _ = decode_part(scene)
    assert [person["id"] for person in header["people"]] == persons.tolist()
    assert {person["kind"] for person in header["people"]} == {"triangulated"}
    assert header["notes"]["units"] == "metres, seconds"
    found = [decode_bodies(scene, each) for each in ranges]
    placed = np.concatenate([joints for _, joints in found])
    joints = model.joints(poses).swapaxes(0, 1)
    known = np.isfinite(joints).all(axis=(-1, -2))
    assert np.array_equal(known, np.isfinite(placed).all(axis=(-1, -2)))
    assert known.sum() > 10
    assert np.linalg.norm(placed - joints, axis=-1)[known].max() < 1e-4


def test_a_command_writes_one_file(tiny_run, tmp_path):
    out = tmp_path / "view.html"
    command = ["export", TINY, "--format", "viewer", "--project", tiny_run, "--out", out]
    done = invoke(*command)
    assert done.exit_code == 0, done.output
    assert f"{out.stat().st_size / 1e6:.1f} MB" in done.output.replace("\n", "")
    assert len(read_viewer(out)) == 1
    refused = invoke(*command, "--video")
    assert "--video: expected a camera with a video" in str(refused.exception)
    refused = invoke(*command, "--format", "joints")
    assert "expected a folder" in str(refused.exception)
    # Options are checked before the project is opened.
    other = ["export", TINY, "--format", "joints", "--video", "--project", tmp_path]
    for command, said in (
        ([*other, "--out", tmp_path], "--video: expected --format viewer"),
        (["unpin", "v1", "--project", tmp_path], "unpin v1: expected MATCH/NAME"),
    ):
        assert said in str(invoke(*command).exception)


def add_run(project, state, stages):
    """Record a later run of a state, with the results of some stages of the first run."""
    store = Store.open(str(project))
    first, number = store.run(TINY, "0001"), store.reserve_run(TINY)
    kept = {name: key for name, key in first.results.items() if name.startswith(stages)}
    unit = "static_calibration/cam03"
    waiting = (WaitingUnit(request="static_calibration.cam03.1", unit=unit, reasons=("x",)),)
    changed = {"run_id": number, "parent": first.run_id, "state": state, "results": kept}
    changed["waiting"] = waiting if state == "waiting" else ()
    store.finish_run(first.model_copy(update=changed))


@pytest.mark.slow
def test_results_stay_reachable_when_a_later_run_has_none(ada, project_copy, tmp_path):
    says = {
        "failed": (("ingest",), "0002 failed and has no people"),
        "waiting": (("ingest", "tracking", "triangulation"), "0003 waits for review"),
    }
    for state, (stages, said) in says.items():
        add_run(project_copy, state, stages)
        found = ada.get(f"{MATCH}/results").json()
        later = f"These are results of run 0001. The later run {said}."
        assert (found["run"], found["later"]) == ("0001", later)
    for path in ("metrics", "scenes/clip", "exports/joints"):
        assert ada.get(f"{MATCH}/results/{path}").status_code == 200, path
    for command in (
        ["report", TINY, "--no-videos", "--out", str(tmp_path / "report.html")],
        ["export", TINY, "--format", "joints", "--out", str(tmp_path / "out")],
    ):
        answer = worldpose(*command, "--project", project_copy)
        assert (answer.code, later in answer.err) == (0, True), answer.err
    assert score(TINY, str(tmp_path / "out"), str(project_copy)).age == later


def test_an_open_page_gets_the_run_that_it_shows_until_it_shows_the_next(ada, project_copy):
    asked = ("scenes/clip?", "scenes/clip/frames?first=0&count=2&", "metrics?", "exports/joints?")

    def answers(run):
        return [ada.get(f"{MATCH}/results/{each}{run}").content for each in asked]

    before = answers("")
    stages = ("ingest", "static", "camera", "detection", "tracking", "triangulation")
    add_run(project_copy, "complete", stages)  # without bodies
    assert all(new != old for new, old in zip(answers(""), before, strict=True))
    assert answers("run_id=0001") == before
    store = Store.open(str(project_copy))
    spec = store.registration(TINY).spec.model_copy(update={"pitch": "none"})
    lacking = impossible_exports(open_run(project_copy, TINY, "0002"), spec)
    assert lacking["minimap"] == "The match has no pitch."
    bodies = {lacking[form] for form in {*OF_BODIES} - {*OF_BROADCAST}}
    assert bodies == {"The run has no fitted bodies yet."}
    assert ada.get(f"{MATCH}/results").json()["formats"] == [
        form for form in EXPORT_FORMATS if form not in lacking or form == "minimap"
    ]
    assert "no such run" in ada.get(f"{MATCH}/results/metrics?run_id=0009").json()["error"]
    assert ada.get(f"{MATCH}/results/metrics?run_id=../x").status_code == 422


def test_results_say_which_change_made_them_old(ada, project_copy, tmp_path):
    store = Store.open(str(project_copy))
    edits = {"split": SplitTrack(clip="clip", person=0, first_frame_of_new=12)}
    keep_edits(store, lambda: open_match(store, TINY), edits, who="Ada", note="")
    said = "These results are out of date because of 1 correction. Run it again."
    assert ada.get(f"{MATCH}/results").json()["later"] == ""  # the state of the match says it
    out = ["--out", str(tmp_path / "out"), "--project", project_copy]
    answer = worldpose("export", TINY, "--format", "joints", *out)
    assert (answer.code, said in answer.err) == (0, True), answer.err
    store.reserve_run(TINY)  # of this process, which is at work
    answer = worldpose("export", TINY, "--format", "joints", *out)
    assert "Of these results, a run would compute tracking/clip" in answer.err


def test_a_run_without_people_is_a_clear_message(ingested, tmp_path):
    ada = page_client.log_in(page_client.served(shutil.copytree(ingested, tmp_path / "data")), "A")
    found = ada.get(f"{MATCH}/results").json()
    assert (found["clips"], found["impossible"]["joints"]) == ([], "The run has no people yet.")
    for path in ("metrics", "report", "scenes/clip", "videos/clip", "exports/joints"):
        answer = ada.get(f"{MATCH}/results/{path}")
        assert answer.status_code == 422, path
        assert "run 0001 of" in answer.json()["error"]
        assert "found results of ingest" in answer.json()["error"]


def test_results_are_there_while_the_folder_of_the_match_is_away(ada, store, tiny, tmp_path):
    away = {"folder": str(tmp_path / "away")}
    store.register(store.registration(TINY).model_copy(update=away))
    page = ada.get(MATCH)
    assert page.status_code == 200
    assert "registered as" in page.json()["problem"]
    paths = ["results", "results/metrics", "results/scenes/clip", "results/exports/joints", "runs"]
    assert {path: ada.get(f"{MATCH}/{path}").status_code for path in paths} == dict.fromkeys(
        paths, 200
    )
    out = tmp_path / "report.html"
    given = ["report", TINY, "--out", out, "--no-videos", "--project", store.url]
    done = invoke(*given)
    assert (done.exit_code, "the report has no images" in done.stderr) == (0, True), done.output
    assert out.stat().st_size > 100_000
    done = invoke(*given, "--out", tmp_path)
    assert "expected a file, found a folder" in str(done.exception)
    # It has images although a camera's clicks are gone; a damaged file is named.
    folder = shutil.copytree(tiny, tmp_path / "copy")
    (folder / "annotations" / "static_calibration" / "cam00.json").unlink()
    done = invoke("report", folder, *given[2:])
    assert (done.exit_code, "no images" in done.stderr) == (0, False), done.exception
    spec = folder / "match.yaml"
    spec.write_text(spec.read_text().replace(TINY, "other"))
    (folder / "detections" / "cam00.npz").write_bytes(b"PK")
    done = invoke("report", folder, *given[2:])
    assert "cam00.npz" in str(done.exception)


def test_a_camera_that_failed_has_its_reason_in_the_table(store):
    record, unit = store.run(TINY), "static_calibration/cam03"
    failure = UnitFailure(unit=unit, error="TaskTimeoutError", message="was stopped", key=None)
    kept = {name: key for name, key in record.results.items() if name != unit}
    failed = record.model_copy(update={"results": kept, "failed": (failure,)})
    table = camera_table(Run(store, failed), open_match(store, TINY).folder.spec)
    (row,) = (row for row in table.rows if row[0] == "cam03")
    assert row[-1] == "was stopped"


def test_the_report_is_drawn_again_with_the_journal_and_while_its_folder_is_away(
    ada, store, monkeypatch, tmp_path
):
    drawn = []

    def draw(store, match, file, **given):
        drawn.append(match)
        file.write_text(f"report {len(drawn)}")

    monkeypatch.setattr("flows.web.results.write_report", draw)
    assert [ada.get(f"{MATCH}/results/report").text for _ in range(2)] == ["report 1"] * 2
    edits = {"split": SplitTrack(clip="clip", person=0, first_frame_of_new=12)}
    keep_edits(store, lambda: open_match(store, TINY), edits, who="Ada", note="")
    assert ada.get(f"{MATCH}/results/report").text == "report 2"
    here = store.registration(TINY)
    for folder, said in ((str(tmp_path / "away"), "report 3"), (here.folder, "report 2")):
        store.register(here.model_copy(update={"folder": folder}))
        assert ada.get(f"{MATCH}/results/report").text == said
    copy = shutil.copytree(here.folder, tmp_path / "copy")
    store.register(here.model_copy(update={"folder": str(copy)}))
    assert ada.get(f"{MATCH}/results/report").text == "report 4"
    (copy / "reference" / "joints.npz").write_bytes(b"PK")
    assert ada.get(f"{MATCH}/results/report").text == "report 5"
