"""Pages show and download results, and correct whom a camera saw by what the others say."""

import io
import json
import re
import shutil
import subprocess
import zipfile
from importlib.util import find_spec
from pathlib import Path

import numpy as np
import page_client
import pytest
from command_line import TINY, invoke, worldpose
from page_client import MATCH

from data_contracts.conventions import COCO17
from data_contracts.release import EXPORT_FORMATS
from data_contracts.review import SplitTrack
from data_contracts.run import UnitFailure, WaitingUnit
from flows.registering import open_match
from flows.reports.cameras import camera_table
from flows.results.best_results import fitted_bodies
from flows.results.evaluation import score
from flows.results.possible_exports import OF_BODIES, OF_BROADCAST, OF_EXTRAS, impossible_exports
from flows.review.corrections import keep_edits
from flows.run_plan import plan_run
from tasks.ingest import ingest
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
    assert [text[:15] for text in judged["reservations"]] == ["clicks of cam03"]
    clip = {"id": "clip", "video": None, "without_joints": None}
    assert found["clips"] == [clip]  # given keypoints: nothing is filmed
    health = reader.get(f"{MATCH}/results/health/clip")
    assert (health.headers["content-type"], health.content[:4]) == ("image/png", b"\x89PNG")
    assert reader.get(f"{MATCH}/results/health/other").status_code == 404
    page = reader.get(f"{MATCH}/results/report")
    assert page.headers["content-type"].startswith("text/html") and "3D view" in page.text
    # Its scripts run without a session: they can neither read nor change anything here.
    policy = page.headers["content-security-policy"]
    assert policy.startswith("sandbox allow-scripts") and "default-src 'none'" in policy
    assert "allow-same-origin" not in policy
    answer = reader.get(f"{MATCH}/results/exports/joints")
    assert "0001-joints.zip" in answer.headers["content-disposition"]
    with zipfile.ZipFile(io.BytesIO(answer.content)) as archive:
        joints = np.load(io.BytesIO(archive.read("joints.npz")))["joints"]
    assert joints.shape[2:] == (17, 3) and np.isfinite(joints).any()
    # Asked again, it is the file that was drawn.
    assert reader.get(f"{MATCH}/results/exports/joints").content == answer.content
    refused = {"videos/clip": 404, "videos/other": 404, "exports/fbx": 404, "scenes/other": 404}
    refused |= {"scenes/clip/frames?first=-1&count=2": 422, "exports/slahmr-cameras": 422}
    for path, status in refused.items():
        assert reader.get(f"{MATCH}/results/{path}").status_code == status, path


def test_the_page_gets_the_bodies_of_the_store(reader, tiny_run):
    path = f"{MATCH}/results/scenes/clip"
    scene = reader.get(path).content
    header, _ = decode_part(scene)
    step = header["range_frames"]
    asked = [f"first={first}&count={step}" for first in range(0, header["frames"], step)]
    ranges = [reader.get(f"{path}/frames?{each}").content for each in asked]
    model, poses, persons, _ = fitted_bodies(open_run(str(tiny_run), TINY), "clip")
    assert [person["id"] for person in header["people"]] == persons.tolist()
    assert {person["kind"] for person in header["people"]} == {"triangulated"}
    placed = np.concatenate([decode_bodies(scene, each)[1] for each in ranges])
    joints = model.joints(poses).swapaxes(0, 1)
    assert np.isfinite(joints).all(axis=(-1, -2)).sum() > 10
    np.testing.assert_allclose(placed, joints, atol=1e-4)


def test_a_command_writes_one_file(tiny_run, tmp_path):
    out = tmp_path / "view.html"
    command = ["export", TINY, "--format", "viewer", "--project", tiny_run, "--out", out]
    done = invoke(*command)
    assert done.exit_code == 0, done.output
    assert len(read_viewer(out)) == 1
    refused = invoke(*command, "--video")
    assert "--video: expected a camera with a video" in str(refused.exception)
    assert "expected a folder" in str(invoke(*command, "--format", "joints").exception)
    # Options are checked before the project is opened.
    other = ["export", TINY, "--format", "joints", "--video", "--project", tmp_path]
    said = str(invoke(*other, "--out", tmp_path).exception)
    assert "--video: expected --format viewer" in said


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
    out = str(tmp_path / "out")
    answer = worldpose(
        "export", TINY, "--format", "joints", "--out", out, "--project", project_copy
    )
    assert (answer.code, later in answer.err) == (0, True), answer.err
    assert score(TINY, out, str(project_copy)).age == later


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
    assert (page.status_code, "registered as" in page.json()["problem"]) == (200, True)
    for path in ("results", "results/metrics", "results/scenes/clip", "runs"):
        assert ada.get(f"{MATCH}/{path}").status_code == 200, path
    out = tmp_path / "report.html"
    given = ["report", TINY, "--out", out, "--no-videos", "--project", store.url]
    done = invoke(*given)
    assert (done.exit_code, "the report has no images" in done.stderr) == (0, True), done.output
    assert out.stat().st_size > 100_000
    assert "expected a file, found a folder" in str(invoke(*given, "--out", tmp_path).exception)
    # A damaged file is named.
    folder = shutil.copytree(tiny, tmp_path / "copy")
    spec = folder / "match.yaml"
    spec.write_text(spec.read_text().replace(TINY, "other"))
    (folder / "detections" / "cam00.npz").write_bytes(b"PK")
    assert "cam00.npz" in str(invoke("report", folder, *given[2:]).exception)


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


def test_a_keypoint_that_is_taken_out_is_gone_from_all_that_follows(ada, bob, store):
    seen = open_run(store.url, TINY)["ingest/cam00"]
    frame, joint = int(seen["frame"].values[3]), COCO17.index("left_wrist")
    detection = int(np.argmax(np.isfinite(seen["keypoints"].values[3, :, joint, 0])))
    was = seen["keypoints"].values[3, detection, joint].astype(float).tolist()
    place = {"camera": "cam00", "frame": frame, "detection": detection, "joint": "left_wrist"}
    edit = {"kind": "moved_keypoint", **place, "was": was, "xy": None}
    before = {each.name: each.key for each in plan_run(store, open_match(store, TINY), {})}
    said = [{"edits": [{"id": f"moved_keypoint.{n}", "edit": edit}]} for n in (1, 2)]
    assert ada.post(f"{MATCH}/corrections", json=said[0]).status_code == 200
    answer = bob.post(f"{MATCH}/corrections", json=said[1])
    assert (answer.status_code, "is not seen" in answer.text) == (409, True)
    shown = ada.get(f"{MATCH}/detections/cam00", params={"frame": frame}).json()["people"]
    (person,) = (each for each in shown if each["detection"] == detection)
    assert person["keypoints"][joint] is None
    assert person["keypoints"][0] is not None
    match = open_match(store, TINY)
    units = {each.name: each for each in plan_run(store, match, {})}
    changed = {name for name, unit in units.items() if unit.key != before[name]}
    assert {"ingest/cam00", "tracking/clip", "bundle_adjustment/cameras"} <= changed
    assert not changed & {"ingest/cam01", "static_calibration/cam00"}
    unit = units["ingest/cam00"]
    ingest.fn(unit.work(store.url, match, "0001"))
    found = store.open_result(TINY, "ingest", "cam00", unit.key)["keypoints"].values
    gone = np.isnan(found) & np.isfinite(seen["keypoints"].values)
    assert np.argwhere(gone).tolist() == [[3, detection, joint, axis] for axis in (0, 1)]


def test_other_cameras_say_where_they_expect_a_keypoint(reader, tiny_run):
    tracks = open_run(str(tiny_run), TINY)["tracking/clip"]
    index = tracks["detection_index"].values
    row, column = np.unravel_index((index >= 0).sum(axis=1).argmax(), index.shape[::2])
    frame, person = (int(tracks[n].values[k]) for n, k in (("frame", row), ("person", column)))
    names = tracks["camera"].values.tolist()
    seen = {n: int(k) for n, k in zip(names, index[row, :, column], strict=True) if k >= 0}
    camera, *others = seen
    where = {"frame": frame, "detection": seen[camera]}
    path = f"{MATCH}/detections/{camera}/views"
    found = reader.get(path, params=where).json()
    assert found["person"] == person
    views = {each["camera"]: each["detection"] for each in found["views"]}
    assert views == {name: seen[name] for name in others}
    assert all(each["curves"] == [] for each in found["views"])  # of no joint
    # The page calls the person as the track is called; and it shows the person in 3D in the image.
    shown = reader.get(f"{MATCH}/detections/{camera}", params={"frame": frame}).json()["people"]
    (here,) = (each for each in shown if each["detection"] == seen[camera])
    assert here["called"] == f"person {person}"
    scene = f"{MATCH}/results/scenes/clip/views/{camera}"
    people = reader.get(scene, params={"frame": frame}).json()["people"]
    (placed,) = (each for each in people if each["person"] == person)
    pairs = [*zip(here["keypoints"], placed["keypoints"], strict=True)]
    apart = [np.linalg.norm(np.subtract(*pair)) for pair in pairs if all(pair)]
    assert len(apart) > 8 and np.median(apart) < 8.0  # [px]
    assert reader.get(scene, params={"frame": 99999}).json() == {"people": []}
    joint = int(np.nanargmin(np.array(found["here"]["error"], dtype=float)))
    x, y = found["here"]["expected"][joint]
    # Put where the others expect it, it lies on every curve of theirs; far off, on none.
    for place, least, most in (((x, y), 0.0, 8.0), ((x + 60.0, y + 45.0), 12.0, np.inf)):
        given = {**where, "joint": joint, "x": place[0], "y": place[1]}
        answer = reader.get(path, params=given).json()
        distances = [
            np.linalg.norm(np.concatenate(each["curves"]) - each["keypoints"][joint], axis=1).min()
            for each in answer["views"]
            if each["keypoints"][joint] is not None and each["curves"]
        ]
        assert least <= np.median(distances) <= most
        # A displaced joint has a residual in every image, against the joint from all cameras.
        assert (answer["here"]["error"][joint] > 5.0) == (least > 0)


def test_an_added_person_is_in_all_that_follows(ada, bob, store):
    page = f"{MATCH}/detections/cam00"
    before = open_run(store.url, TINY)["ingest/cam00"]
    frame = int(before["frame"].values[3])
    shown = ada.get(page, params={"frame": frame}).json()
    free = shown["free"]
    assert free not in {each["detection"] for each in shown["people"]}
    keypoints = [[100.0 + k, 200.5] if k % 2 else None for k in range(17)]
    place = {"kind": "added_detection", "camera": "cam00", "frame": frame, "detection": free}
    edit = {**place, "box": [90.0, 180.0, 130.0, 240.0], "keypoints": keypoints}
    said = [{"edits": [{"id": f"added.{n}", "edit": edit}]} for n in (1, 2)]
    assert ada.post(f"{MATCH}/corrections", json=said[0]).is_success
    answer = bob.post(f"{MATCH}/corrections", json=said[1])
    assert (answer.status_code, "already" in answer.text) == (409, True)
    shown = bob.get(page, params={"frame": frame}).json()
    (added,) = (each for each in shown["people"] if each["detection"] == free)
    assert (added["keypoints"], added["score"], shown["free"]) == (keypoints, 1.0, free + 1)
    match = open_match(store, TINY)
    unit = {each.name: each for each in plan_run(store, match, {})}["ingest/cam00"]
    ingest.fn(unit.work(store.url, match, "0001"))
    found = store.open_result(TINY, "ingest", "cam00", unit.key)
    assert found["boxes"].values[3, free].tolist() == edit["box"]
    count, was = (np.isfinite(each["score"].values).sum() for each in (found, before))
    assert count == was + 1


def test_who_is_certain_is_accepted_at_once_and_the_rest_one_by_one(ada, bob, store):
    path = f"{MATCH}/detections/cam00"
    score = open_run(store.url, TINY)["ingest/cam00"]["score"].values
    known = np.sort(score[np.isfinite(score)])
    queue = ada.get(f"{path}/queue").json()
    assert queue["left"] == queue["people"] == len(known)
    assert [each["score"] for each in queue["next"]] == pytest.approx(known[:60], abs=5e-4)
    assert {each["called"].split()[0] for each in queue["next"]} == {"person", "detection"}
    least = float(known[len(known) // 2])
    queue = ada.post(f"{path}/acceptances", json={"at_least": least}).json()
    assert queue["left"] == (known < np.float32(least)).sum()
    first = queue["next"][0]
    one = {"people": [[first["frame"], first["detection"]]]}
    after = bob.post(f"{path}/acceptances", json=one).json()
    assert after["left"] == queue["left"] - 1
    # It causes no recomputation.
    plan = plan_run(store, open_match(store, TINY), {})
    results = store.run(TINY).results
    assert all(results[each.name] == each.key for each in plan if each.name in results)
    for wrong in ({"at_least": 1.5}, {"people": [["a", 1]]}, {"at_least": "nan"}):
        assert ada.post(f"{path}/acceptances", json=wrong).status_code == 422
    # The journal's limits, and detections that are not there.
    for beyond in ([10**30, 0], [0, 10**30], [0, -1], [99999, 5], [first["frame"], 5000]):
        assert ada.post(f"{path}/acceptances", json={"people": [beyond]}).status_code == 422
    assert ada.get(f"{MATCH}/detections/nowhere/queue").status_code == 422


DECIDING = """
import { People } from "./people.mjs";
import { posted } from "./api.mjs";
const people = new People("m", "cam");
await people.load(10);
people.move(0, 0, [10, 0], [5, 5]);
people.choose(1, 0);
people.hide();
people.drop();
people.drop();
await people.load(11);
await new Promise((done) => setTimeout(done, 400));
console.log(JSON.stringify({ posted, shown: people.info.frame }));
"""
ANSWERS = """
export const posted = [];
const wait = (ms) => new Promise((done) => setTimeout(done, ms));
export const newId = (kind) => kind;
export const matchPath = (match) => `/${match}`;
export async function get(path) {
  const frame = Number(new URL(`http://x${path}`).searchParams.get("frame"));
  const box = [0, 0, 1, frame];
  const seen = (detection) => ({ detection, keypoints: [[frame, detection]], box });
  await wait(frame === 10 ? 20 : 5);
  return { frame, joints: ["nose"], people: [seen(0), seen(1)], next: [] };
}
export async function post(path, body) {
  posted.push(body.edits[0].edit);
  await wait(50);
}
export const messages = { tell: (text) => posted.push(text) };
"""


@pytest.mark.skipif(shutil.which("node") is None, reason="no node on this machine")
def test_a_correction_is_of_the_frame_in_which_a_person_made_it(tmp_path):
    source = Path(__file__).parents[2] / "infra" / "review_pages" / "src" / "people.svelte.js"
    text = re.sub(r"\$state\((.*)\);", r"\1;", source.read_text())
    text = re.sub(r'"\./(api|messages\.svelte)\.js"', '"./api.mjs"', text)
    for name, content in (("people", text), ("api", ANSWERS), ("main", DECIDING)):
        (tmp_path / f"{name}.mjs").write_text(content)
    done = subprocess.run(["node", tmp_path / "main.mjs"], capture_output=True, check=True)
    found = json.loads(done.stdout)
    assert found["shown"] == 11
    place = {"camera": "cam", "frame": 10}
    moved = {**place, "kind": "moved_keypoint", "joint": "nose"}
    assert found["posted"] == [
        {**moved, "detection": 0, "was": [10, 0], "xy": [5, 5]},
        {**moved, "detection": 1, "was": [10, 1], "xy": None},
        {**place, "kind": "deleted_detection", "detection": 1, "was": [0, 0, 1, 10]},
    ]
