"""Whom a camera saw is corrected on a page, with what the other cameras say."""

import json
import re
import shutil
import subprocess
from pathlib import Path

import numpy as np
import pytest
from command_line import TINY
from page_client import MATCH

from data_contracts.conventions import COCO17
from flows.registering import open_match
from flows.results.run_cameras import static_cameras
from flows.run_plan import plan_run
from tasks.ingest import ingest
from worldpose.store.store import Store, open_run


def test_a_keypoint_that_is_taken_out_is_gone_from_all_that_follows(ada, bob, project_copy):
    store = Store.open(str(project_copy))
    seen = open_run(str(project_copy), TINY)["ingest/cam00"]
    frame, joint = int(seen["frame"].values[3]), COCO17.index("left_wrist")
    detection = int(np.argmax(np.isfinite(seen["keypoints"].values[3, :, joint, 0])))
    was = seen["keypoints"].values[3, detection, joint].astype(float).tolist()
    place = {"camera": "cam00", "frame": frame, "detection": detection, "joint": "left_wrist"}
    edit = {"kind": "moved_keypoint", **place, "was": was, "xy": None}
    before = {each.name: each.key for each in plan_run(store, open_match(store, TINY), {})}
    keep = {"edits": [{"id": "moved_keypoint.1", "edit": edit}]}
    assert ada.post(f"{MATCH}/corrections", json=keep).status_code == 200
    again = {"edits": [{"id": "moved_keypoint.2", "edit": edit}]}
    answer = bob.post(f"{MATCH}/corrections", json=again)
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
    assert np.argwhere(gone).tolist() == [[3, detection, joint, 0], [3, detection, joint, 1]]
    assert store.manifest(TINY, "ingest", "cam00", unit.key).figures["corrections_refused"] == 0


def seen_by_two(project):
    """A frame in which several cameras see a person: frame, person, detections by camera."""
    tracks = open_run(str(project), TINY)["tracking/clip"]
    index = tracks["detection_index"].values
    row, person = np.unravel_index((index >= 0).sum(axis=1).argmax(), index.shape[::2])
    names = [str(name) for name in tracks["camera"].values]
    seen = {name: int(k) for name, k in zip(names, index[row, :, person], strict=True) if k >= 0}
    return int(tracks["frame"].values[row]), int(tracks["person"].values[person]), seen


def test_other_cameras_say_where_they_expect_a_keypoint(reader, tiny_run):
    frame, person, seen = seen_by_two(tiny_run)
    camera, *others = seen
    run = open_run(str(tiny_run), TINY)
    cameras = static_cameras(run, open_match(Store.open(str(tiny_run)), TINY).folder.spec)
    where = {"frame": frame, "detection": seen[camera]}
    path = f"{MATCH}/detections/{camera}/views"
    found = reader.get(path, params=where).json()
    assert found["person"] == person
    assert {each["camera"]: each["detection"] for each in found["views"]} == {
        name: seen[name] for name in others
    }
    assert all(each["curves"] == [] for each in found["views"])  # of no joint
    # The page calls the person as the track is called; and it shows the person in 3D in the image.
    shown = reader.get(f"{MATCH}/detections/{camera}", params={"frame": frame}).json()["people"]
    (here,) = (each for each in shown if each["detection"] == seen[camera])
    assert here["called"] == f"person {person}"
    scene = f"{MATCH}/results/scenes/clip/views/{camera}"
    placed = {
        each["person"]: each for each in reader.get(scene, params={"frame": frame}).json()["people"]
    }
    pairs = [
        pair
        for pair in zip(here["keypoints"], placed[person]["keypoints"], strict=True)
        if all(pair)
    ]
    assert len(pairs) > 8
    assert np.median([np.linalg.norm(np.subtract(*pair)) for pair in pairs]) < 8.0  # [px]
    assert reader.get(scene, params={"frame": 99999}).json() == {"people": []}
    errors = np.array(found["here"]["error"], dtype=float)
    joint = int(np.nanargmin(errors))
    expected = found["here"]["expected"][joint]
    # Put where the others expect it, it lies on every curve of theirs; far off, on none.
    x, y = expected
    for place, least, most in (((x, y), 0.0, 8.0), ((x + 60.0, y + 45.0), 12.0, np.inf)):
        given = {**where, "joint": joint, "x": place[0], "y": place[1]}
        answer = reader.get(path, params=given).json()
        distances = []
        for each in answer["views"]:
            theirs = each["keypoints"][joint]
            if theirs is None or not each["curves"]:
                continue
            curve = np.concatenate([np.array(line) for line in each["curves"]])
            distances.append(np.linalg.norm(curve - theirs, axis=1).min())
            # The curve is that of the very camera: one of its places, seen again, is on the ray.
            ray = cameras[camera].unproject(np.array([place]))
            target = cameras[each["camera"]]
            along = np.linalg.norm(ray.origins[0] - target.center)
            shown = target.project(
                ray.origins[0] + along * np.linspace(0.01, 4, 40_000)[:, None] * ray.directions[0]
            )
            assert np.nanmin(np.linalg.norm(shown - curve[len(curve) // 2], axis=1)) < 3.0
        assert least <= np.median(distances) <= most
        # A displaced joint has a residual in every image, against the joint from all cameras.
        assert (answer["here"]["error"][joint] > 5.0) == (least > 0)


def test_an_added_person_is_in_all_that_follows(ada, bob, project_copy):
    store = Store.open(str(project_copy))
    frame = int(open_run(str(project_copy), TINY)["ingest/cam00"]["frame"].values[3])
    page = f"{MATCH}/detections/cam00"
    shown = ada.get(page, params={"frame": frame}).json()
    free = shown["free"]
    assert free not in {each["detection"] for each in shown["people"]}
    keypoints = [[100.0 + k, 200.5] if k % 2 else None for k in range(17)]
    place = {"kind": "added_detection", "camera": "cam00", "frame": frame, "detection": free}
    edit = {**place, "box": [90.0, 180.0, 130.0, 240.0], "keypoints": keypoints}
    assert ada.post(
        f"{MATCH}/corrections", json={"edits": [{"id": "added.1", "edit": edit}]}
    ).is_success
    answer = bob.post(f"{MATCH}/corrections", json={"edits": [{"id": "added.2", "edit": edit}]})
    assert (answer.status_code, "already" in answer.text) == (409, True)
    shown = bob.get(page, params={"frame": frame}).json()
    (added,) = (each for each in shown["people"] if each["detection"] == free)
    assert (added["keypoints"], added["score"]) == (keypoints, 1.0)
    assert shown["free"] == free + 1
    match = open_match(store, TINY)
    unit = {each.name: each for each in plan_run(store, match, {})}["ingest/cam00"]
    ingest.fn(unit.work(store.url, match, "0001"))
    found = store.open_result(TINY, "ingest", "cam00", unit.key)
    assert found["boxes"].values[3, free].tolist() == edit["box"]
    assert (
        np.isfinite(found["score"].values).sum()
        == 1 + np.isfinite(open_run(str(project_copy), TINY)["ingest/cam00"]["score"].values).sum()
    )


def test_who_is_certain_is_accepted_at_once_and_the_rest_one_by_one(ada, bob, project_copy):
    path = f"{MATCH}/detections/cam00"
    score = open_run(str(project_copy), TINY)["ingest/cam00"]["score"].values
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
    store = Store.open(str(project_copy))
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
