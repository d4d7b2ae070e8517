"""Layers of settings: one resolution for every door, origins, and errors that name file and key."""

import json
import shutil
from concurrent.futures import ThreadPoolExecutor
from contextlib import nullcontext, suppress
from dataclasses import replace
from pathlib import Path
from threading import Barrier, BrokenBarrierError
from types import SimpleNamespace

import pytest
import yaml
from command_line import TINY, invoke

from flows import layers, reprocess
from flows.cli import run as run_command
from flows.cli import settings as cli_settings
from flows.layers import project_layers, read_layer, write_layer
from flows.progress import reporting_to
from flows.registering import open_match, register
from flows.reports.match_pictures import shown_pitch
from flows.results.best_results import Origin
from flows.run_plan import plan_run
from flows.running import RunRequest, settle
from flows.service import deployed
from flows.service.plan import ServePlan
from flows.settings import parse_overrides, resolve
from flows.web import app_context
from flows.web import settings as page_settings
from worldpose.body.body_file import load_open_body, save_body
from worldpose.errors import InputError
from worldpose.ingest.match_folder import read_match
from worldpose.store.run_queue import queue_of
from worldpose.store.store import Run, Store

BODY = "smpl-test"


def command(*arguments, code=0):
    answer = invoke(*arguments)
    assert answer.exit_code == code, answer.output + repr(answer.exception)
    return answer.stdout


def shown(store, *arguments):
    told = json.loads(command("settings", *arguments, "--project", store.url, "--json"))
    return {name: (each["value"], each["from"]) for name, each in told["settings"].items()}


class CapturedError(BaseException):
    """A door has come to where it would compute; it handles this as little as a kill."""


@pytest.fixture
def keys_of_run(store, monkeypatch):
    """The content keys that a door computes, captured where it would begin to."""
    found = []

    def capture(store, match, request, *_):
        if isinstance(match, str):  # a flow has only the id
            match = open_match(store, match)
        assert request.is_settled
        for number in range(1, request.most_iterations + 1):
            planned = plan_run(store, match, request.settings, iteration=number)
            found.append({unit.name: unit.key for unit in planned})
        assert str(match.body_folder) == found_folder
        raise CapturedError

    found_folder = ""
    for place in (run_command, reprocess):
        monkeypatch.setattr(place, "iterate_match", capture)
        monkeypatch.setattr(place, "run_match", capture)
    monkeypatch.setattr(deployed, "_iterate_until_decided", capture)
    monkeypatch.setattr(deployed, "_run_until_decided", capture)

    def take(door, folder):
        nonlocal found_folder
        found_folder = str(folder)
        found.clear()
        with suppress(CapturedError):
            door()
        return list(found)

    return take


@pytest.fixture
def smpl(store, tmp_path):
    """A project with a body of its own, two iterations and another setting of a stage."""
    folder = tmp_path / "bodies"
    folder.mkdir()
    save_body(folder / f"{BODY}.npz", replace(load_open_body(), name=BODY))
    stated = {
        "body_folder": str(folder),
        "body_fitting.body_model": BODY,
        "iterations": 2,
        "detection.stride": 2,
        "tracking.gate_m": 0.6,
    }
    write_layer(store, "project", stated)
    return folder


class Runs:
    """The runs of a service: parameters of the deployment that processes matches."""

    def __init__(self, url):
        self.url, self.started, self.queue = url, [], queue_of(url)

    def start(self, match_id, *, priority="normal", key=None, **given):
        self.started.append({"match_id": match_id, **{n: it for n, it in given.items() if it}})
        return SimpleNamespace(flow_run="run")

    def at_prefect(self, runs):
        return {}

    def link(self, run):
        return ""

    def run_all(self):
        for given in self.started:
            deployed.match.fn(self.url, **given)


def test_every_door_computes_the_same_keys(store, smpl, tiny, keys_of_run, tmp_path, monkeypatch):
    runs = Runs(store.url)
    machines = nullcontext(lambda missing: RunRequest({}))
    monkeypatch.setattr(reprocess, "shared_machines", lambda *_: machines)
    monkeypatch.setattr(deployed, "match_runs_of", lambda url: None)
    monkeypatch.setattr(app_context, "match_runs_of", lambda url: runs)
    monkeypatch.setattr(deployed.MatchRuns, "of_plan", lambda plan: runs)

    def by_command():
        invoke("run", TINY, "--project", store.url)

    def by_page():
        app_context.Continuing(store).go_on(TINY)
        runs.run_all()

    def from_inbox():
        inbox = tmp_path / "inbox"
        shutil.copytree(tiny, inbox / "arrived")
        moved = store.registration(TINY).model_copy(update={"folder": str(tmp_path / "gone")})
        store.register(moved)  # it arrives as a match whose folder has moved
        own = {"project": store.url, "inbox": inbox, "state": tmp_path}
        plan = ServePlan(**own, prefect="", settle_seconds=0.0)
        for _ in range(2):
            deployed.ingest.fn(plan.model_dump(mode="json"))
        runs.run_all()

    def by_schedule():
        deployed.match.fn(store.url, TINY)

    def by_reprocess():
        list(reprocess.reprocess_matches(store, [TINY], RunRequest({})))

    first = keys_of_run(by_command, smpl)
    assert len(first) == 2 and first[0] != first[1]
    for door in (by_page, from_inbox, by_schedule, by_reprocess):
        runs.started.clear()
        assert keys_of_run(door, smpl) == first, door
    write_layer(store, "project", {})
    assert keys_of_run(by_schedule, None)[0] != first[0]


def test_each_value_is_from_the_last_layer_that_states_it(store, tiny):
    project = ("--project", store.url)
    command("settings", "--set", "tracking.gate_m=0.45", "--set", "iterations=3", *project)
    command("settings", "--venue", "hall", "--set", "tracking.gate_m=0.6", *project)
    command("settings", TINY, "--set", "venue=hall", *project)
    venue = {"tracking.gate_m": (0.6, "venue hall"), "venue": ("hall", "match")}
    assert shown(store, TINY) == {**venue, "iterations": (3, "project")}
    assert shown(store) == {"tracking.gate_m": (0.45, "project"), "iterations": (3, "project")}
    settle(store, open_match(store, TINY), RunRequest({"tracking": {"gate_m": 0.7}}, iterations=1))
    assert shown(store, TINY)["tracking.gate_m"] == (0.7, "match")
    # One iteration, as built in, replaces three of the project.
    assert "iterations" not in shown(store, TINY)
    _, request = settle(store, open_match(store, TINY), RunRequest({}))
    assert (request.iterations, request.settings) == (1, {"tracking": {"gate_m": 0.7}})
    # To forget what runs stated leaves the venue, and what it and the project state.
    _, request = settle(store, open_match(store, TINY), RunRequest({}, default_settings=True))
    assert (request.iterations, request.settings) == (3, {"tracking": {"gate_m": 0.6}})
    command("settings", TINY, "--unset", "venue", *project)
    assert shown(store, TINY)["tracking.gate_m"] == (0.45, "project")


@pytest.mark.parametrize(
    ("text", "key", "found"),
    [
        ("detection.strid: 2", "detection.strid", "Did you mean 'detection.stride'.*settings"),
        ("tracking.gate_m: -1", "tracking.gate_m", "-1"),
        ("iterations: many", "iterations", "many"),
        ("body_folder: bodies", "body_folder", "relative path 'bodies'"),
        ("exports: [joints, docx]", "exports", "docx"),
        ("venue: hall", "venue", "project"),
        ("- 1", "", "1"),
        ("gates: [auto]", "gates", "auto"),
        ("pitch: {length: -4}", "pitch", "-4"),
    ],
)
def test_a_layer_that_is_wrong_is_refused_with_file_and_key(store, text, key, found):
    store.blobs.put("settings/project.yaml", text.encode())
    with pytest.raises(InputError, match=found) as refused:
        resolve(open_match(store, TINY).layers)
    assert refused.value.where.startswith(f"{store.url}/settings/project.yaml")
    assert key in refused.value.where


def without_pitch(tiny, folder, **changes):
    """A copy of the match without pitch.json; its match.yaml before the changes."""
    shutil.copytree(tiny, folder)
    (folder / "pitch.json").unlink()
    text = yaml.safe_load((folder / "match.yaml").read_text())
    (folder / "match.yaml").write_text(yaml.safe_dump({**text, **changes}))
    return text


def test_match_yaml_names_its_venue_and_the_venue_gives_pitch_and_side(store, tiny, tmp_path):
    text = without_pitch(tiny, tmp_path / "at_parken", match_id="final", venue="parken")
    camera = text["cameras"][0]["id"]
    venue = {"pitch": {"length": 101.0}, "sides": {camera: "near"}, "tracking.gate_m": 0.6}
    write_layer(store, "venues/parken", venue)
    match, _ = register(store, tmp_path / "at_parken")
    assert match.folder.pitch.length == match.pitch_source["length"] == 101.0
    assert match.folder.spec.camera(camera).side == "near"
    assert resolve(match.layers).overrides == {"tracking": {"gate_m": 0.6}}


def test_clicks_have_the_names_of_the_venues_game(store, tiny, tmp_path):
    folder, copy = tmp_path / "hall", tmp_path / "copy"
    text = without_pitch(tiny, folder, match_id="hall", venue="hall")
    places = ("backboard_left_near_top", "free_throw_left_center", "center_mark", "halfway_near")
    points = [{"name": name, "xy": [100.0, 100.0 + n]} for n, name in enumerate(places)]
    camera = next(each["id"] for each in text["cameras"] if each.get("kind") != "broadcast")
    shutil.rmtree(folder / "annotations")
    shutil.copytree(folder, copy)
    file = folder / "annotations" / "static_calibration" / f"{camera}.json"
    file.parent.mkdir(parents=True)
    file.write_text(json.dumps({"contract": 1, "points": points}))
    assert read_match(folder).clicked.keys() == {camera}  # the venue is not known here
    for template in ("futsal", "basketball"):
        write_layer(store, "venues/hall", {"pitch": {"template": template}})
        wrong = "a point of the futsal pitch in the settings of the venue hall"
        with nullcontext() if template == "basketball" else pytest.raises(InputError, match=wrong):
            register(store, folder, unfinished=True)
    images = [{"id": 1, "file_name": f"{camera}.png", "width": 1920, "height": 1080}]
    numbers = [n for x in range(5) for n in (100 + x, 100, 2)]
    coco = {
        "images": images,
        "categories": [{"id": 1, "name": "p", "keypoints": [*places, places[0]]}],
        "annotations": [{"id": 1, "image_id": 1, "category_id": 1, "keypoints": numbers}],
    }
    (folder / "again.json").write_text(json.dumps(coco))
    given = ("import", "--clicks", folder / "again.json", "--out", copy, "--project")
    command(*given, tmp_path / "other", code=1)
    command(*given, store.url)
    found = json.loads((copy / "pitch.json").read_text())
    assert found["template"] == "basketball" and [*found["points"]] == [f"{places[0]}.again"]


def test_a_venue_that_the_clicks_do_not_fit_can_be_taken_back(store, tiny, tmp_path, ada):
    folder = tmp_path / "m"
    without_pitch(tiny, folder, match_id="other")
    write_layer(store, "venues/hall", {"pitch": {"template": "futsal"}})
    for match in (folder, "other"):
        given = ("settings", match, "--project", store.url)
        command(*given, "--set", "venue=hall")
        assert shown(store, match)["pitch"][1] == "venue hall"
        with pytest.raises(InputError, match="the settings of the venue hall"):
            register(store, folder, unfinished=True)
        command(*given, "--unset", "venue")
        register(store, folder, unfinished=True)
    write_layer(store, "matches/other", {"venue": "hall"})
    *_, own = ada.get("/api/settings?match=other").json()["layers"]
    sent = {"layer": own["layer"], "values": {}, "revision": own["revision"]}
    assert ada.post("/api/settings?match=other", json=sent).status_code == 200
    register(store, folder, unfinished=True)


def test_the_list_has_one_short_line_per_setting_and_the_rest_by_name():
    lines = command("settings", "--list").splitlines()
    assert any(line.startswith("  min_views = 2  ") for line in lines)
    assert command("run", "any", "--set", "list").splitlines() == lines
    about = command("settings", "--describe", "triangulation.min_views")
    assert about.startswith("triangulation.min_views = 2, built in\n")


def test_a_page_shows_and_saves_the_layers(store, ada, bob):
    found = ada.get(f"/api/settings?match={TINY}").json()
    names = ["project", f"matches/{TINY}"]
    assert [each["layer"] for each in found["layers"]] == names
    path, sent = f"/api/settings?match={TINY}", {"layer": "project", "revision": ""}
    saved = ada.post(path, json={**sent, "values": {"tracking.gate_m": 0.45}}).json()
    (row,) = saved["in_force"]
    assert (row["name"], row["value"], row["from"]) == ("tracking.gate_m", 0.45, "project")
    # Another person, who saw the page before, replaces nothing.
    late = bob.post(path, json={**sent, "values": {}})
    assert late.status_code == 409
    assert read_layer(store, "project").values == {"tracking.gate_m": 0.45}
    sent["revision"] = saved["layers"][0]["revision"]
    wrong = ada.post(path, json={**sent, "values": {"tracking.gate_m": -1}})
    assert wrong.json()["error"].startswith("settings of the project: tracking.gate_m")
    mistyped = ada.post(path, json={**sent, "values": {"tracking.gate": 1}}).json()["error"]
    assert "Did you mean 'tracking.gate_m'?" in mistyped and page_settings.ON_PAGE in mistyped
    assert store.url not in mistyped and "operator" not in mistyped
    for layer in ("matches/none", "venues/../x", "elsewhere"):
        answer = ada.post(path, json={"layer": layer, "values": {}, "revision": ""})
        assert answer.status_code == 404
    assert ada.get("/api/settings?match=none").status_code == 404
    assert layers.list_venues(store) == ()


def test_a_page_names_no_file_of_the_server_and_keeps_those_that_are_named(store, ada):
    stated = {"body_folder": "/data/bodies", "detection.detector": "onnx:/nets/x.onnx"}
    write_layer(store, "project", stated)

    def save(**values):
        revision = read_layer(store, "project").revision
        sent = {"layer": "project", "values": values, "revision": revision}
        return ada.post("/api/settings", json=sent).status_code

    assert save(**stated, iterations=2) == 200
    for name, value in (
        ("body_folder", "/etc"),
        ("exports_folder", "/etc"),
        ("detection.detector", ["embedded", "mmdet:upload.py"]),
        ("detection.pose", "embedded:../x"),
    ):
        assert save(**{**stated, name: value}) == 422
    assert read_layer(store, "project").values == {**stated, "iterations": 2}
    assert save(**{"detection.detector": "model:rtdetr-v2-r18", "detection.stride": 3}) == 200


def test_a_stray_file_among_the_venues_closes_no_door(tmp_path):
    store = Store.create(tmp_path)
    write_layer(store, "venues/hall", {})
    store.blobs.put("settings/venues/._arena.yaml", b"\0")
    routes = page_settings.routes(SimpleNamespace(store=store)).routes
    page = next(each.endpoint for each in routes if "GET" in each.methods)
    assert page()["problem"] == ""
    store.blobs.put("settings/venues/Köln Arena.yaml", b"")
    found = page()
    assert [each["layer"] for each in found["layers"]] == ["project", "venues/hall"]
    assert "settings/venues/Köln Arena.yaml is not used: " in found["problem"]
    answer = invoke("settings", "--project", store.url)
    assert (answer.exit_code, found["problem"] in answer.stderr) == (0, True)


@pytest.mark.usefixtures("server")
def test_exports_follow_each_run_and_a_failed_one_says_that_the_run_is_kept(store):
    write_layer(store, "project", {"exports": ["joints"]})
    told = json.loads(command("run", TINY, "--project", store.url, "--json"))
    (file,) = [each for each in told["exports"] if each.endswith("joints.npz")]
    assert file == f"{store.url}/exports/{TINY}/joints.npz"
    write_layer(store, "project", {"exports": ["joints"], "exports_folder": "/dev/null/x"})
    command("run", TINY, "--project", store.url, code=1)
    assert store.runs(TINY) == ("0001",)


def test_a_venue_that_does_not_exist_is_refused_and_a_wrong_one_can_be_corrected(store):
    write_layer(store, "venues/parken", {"tracking.gate_m": 0.6})
    given = ("settings", TINY, "--project", store.url)
    command(*given, "--set", "venue=parkn", code=1)
    assert not read_layer(store, f"matches/{TINY}").values
    write_layer(store, f"matches/{TINY}", {"venue": "gone"})  # as by another program
    command(*given, "--set", "venue=parken")
    assert shown(store, TINY)["tracking.gate_m"] == (0.6, "venue parken")


def test_exports_have_the_pitch_of_the_layers(store):
    registration = open_match(store, TINY).registration
    folder = registration.model_copy(update={"folder": store.url})  # without pitch.json
    write_layer(store, "project", {"pitch": {"length": 101.0, "width": 66.0}})
    assert layers.pitch_of(store, Path(store.url), folder.spec).length == 101.0
    # The results of a run keep the pitch that it used, in exports and in reports.
    used = open_match(store, TINY).folder.pitch
    origin = Origin(Run(store, store.run(TINY)), folder)
    assert used.length == 105.0 and origin.pitch == used
    now = open_match(store, TINY)
    other = used.model_copy(update={"length": 100.0, "width": 64.0})
    now = replace(now, folder=replace(now.folder, pitch=other))
    shown = shown_pitch(origin.run, now)
    assert (shown.length, shown.width) == (105.0, 68.0)
    # Of a part without any of these, the tracks say the size.
    tracks = {n: key for n, key in origin.run.record.results.items() if n.startswith("tracking/")}
    part = Run(store, origin.run.record.model_copy(update={"results": tracks}))
    assert layers.pitch_of_run(part, lambda: other).length == 105.0
    assert layers.pitch_of_run(part, lambda: used) is used


def test_weights_have_the_same_path_at_every_door(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    given = parse_overrides(["detection.detector=onnx-rtmdet:net.onnx", "detection.pose=embedded"])
    path = f"onnx-rtmdet:{tmp_path / 'net.onnx'}"
    assert given["detection"] == {"detector": path, "pose": "embedded"}
    store = Store.create(str(tmp_path / "project"))
    given = "detection.detector=onnx-rtmdet:net.onnx"
    command("settings", "--set", given, "--project", store.url)
    assert read_layer(store, "project").values == {"detection.detector": path}


def test_a_value_that_no_run_can_use_is_not_kept(store, tmp_path):
    typo, told = {"detection": {"detector": f"onnx:{tmp_path}/none.onnx"}}, []
    kept = {"detection.detector": "embedded"}
    write_layer(store, f"matches/{TINY}", kept)
    with (
        reporting_to(SimpleNamespace(tell_kept_settings=told.append)),
        pytest.raises(InputError, match=r"none\.onnx"),
    ):
        settle(store, open_match(store, TINY), RunRequest(typo))
    assert (read_layer(store, f"matches/{TINY}").values, told) == (kept, [])
    # A part of the method, and a match with given 2D poses, do not need what they do not use.
    gone = {"detection.detector": typo["detection"]["detector"], "refitting.body_model": "gone"}
    write_layer(store, f"matches/{TINY}", {**gone, "body_fitting.body_model": "gone"})
    asked = RunRequest({"filtering": {"min_keypoints": 5}}, from_stage="filtering")
    settle(store, open_match(store, TINY), asked)
    with pytest.raises(InputError, match="gone"):
        settle(store, open_match(store, TINY), RunRequest({"tracking": {"gate_m": 0.7}}))
    write_layer(store, f"matches/{TINY}", gone)
    settle(store, open_match(store, TINY), RunRequest({"tracking": {"gate_m": 0.7}}))


@pytest.fixture
def at_once(monkeypatch):
    """Runs a function for two arguments, whose saves by a module begin together."""

    def run(module, change, given):
        both, save = Barrier(2), module.save_layer

        def save_late(*layer):
            with suppress(BrokenBarrierError):
                both.wait(timeout=0.5)
            save(*layer)

        monkeypatch.setattr(module, "save_layer", save_late)
        with ThreadPoolExecutor(2) as pool:
            return list(pool.map(change, given))

    return run


def test_of_two_saves_of_one_revision_one_is_refused(store, ada, bob, at_once):
    def post(given):
        sent = {"layer": "project", "revision": "", "values": given[1]}
        return given[0].post("/api/settings", json=sent).status_code

    codes = at_once(page_settings, post, [(ada, {"iterations": 2}), (bob, {"gates": "auto"})])
    assert sorted(codes) == [200, 409]


def test_two_commands_that_change_one_layer_both_count(store, at_once):
    opened, layers = open_match(store, TINY), project_layers(store)

    def change(text):
        cli_settings.change_layer(store, "project", layers, [text], [])

    at_once(cli_settings, change, ("detection.stride=2", "triangulation.min_views=3"))
    stated = {"detection.stride": 2, "triangulation.min_views": 3}
    assert read_layer(store, "project").values == stated
    # A run that was opened before keeps what another command has stated since.
    write_layer(store, f"matches/{TINY}", {"tracking.gate_m": 0.6})
    settle(store, opened, RunRequest({"triangulation": {"min_views": 4}}))
    own = {"tracking.gate_m": 0.6, "triangulation.min_views": 4}
    assert read_layer(store, f"matches/{TINY}").values == own
