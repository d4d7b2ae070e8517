"""The page of a match lists and compares runs, keeps and cancels them, and fills in keypoints."""

import sys
import time
from datetime import UTC, datetime, timedelta
from types import SimpleNamespace

import cv2
import numpy as np
import pytest
from command_line import TINY
from page_client import MATCH
from run_records import review_request

from data_contracts.conventions import COCO17
from data_contracts.operations import MatchSummary
from data_contracts.review import Correction, MovedKeypoint, Withdrawal
from flows import registering
from flows.match_state import corrections_since
from flows.registering import open_match, open_stored
from flows.reports.clip_video import clip_view
from flows.review.detections import detections_now
from flows.review.identities import identities_now
from flows.running import RunRequest, run_match
from flows.web import app_context
from flows.web.app_context import Continuing, PageContext
from flows.web.evidence import asked_run, thin_curve
from flows.web.history import _find_cause
from worldpose.errors import InputError
from worldpose.review.journal import say
from worldpose.store.store import open_run
from worldpose.video import VideoReader


def test_runs_are_listed_compared_and_kept_by_name(ada, store, monkeypatch):
    first = store.run(TINY)
    figures = {name: dict(each) for name, each in first.figures.items()}
    figures["static_calibration/cam00"]["expected_ground_error_median_m"] *= 2.0
    changed = {"run_id": store.reserve_run(TINY), "parent": "0001", "figures": figures}
    changed["overrides"] = {"tracking": {"x": 1}}
    store.finish_run(first.model_copy(update=changed))
    late, early = ada.get(f"{MATCH}/runs").json()
    assert [(each["id"], each["cause"]) for each in (late, early)] == [
        ("0002", "other settings"),
        ("0001", "first run"),
    ]
    assert late["verdict"] == "usable with reservations"
    ingested = {name: "0" * 64 for name in first.results if name.startswith("ingest/")}
    added = first.model_copy(
        update={"parent": "0001", "run_id": "0009", "results": {**first.results, **ingested}}
    )
    assert _find_cause(open_stored(store, TINY), added, first) == "new files"
    assert "tracking.x = 1" in late["settings"]
    store.finish_run(first.model_copy(update={"run_id": store.reserve_run(TINY), "parent": "0"}))
    assert ada.get(f"{MATCH}/runs").json()[0]["cause"] == "the run before was removed"
    # Its number tells that another one began before, and was killed.
    store.finish_run(first.model_copy(update={"run_id": store.reserve_run(TINY), "parent": None}))
    assert ada.get(f"{MATCH}/runs").json()[0]["cause"] == "first run that ended"
    (worse,) = ada.get(f"{MATCH}/runs/0001/0002").json()
    assert (worse["kind"], worse["name"], worse["mark"]) == ("camera", "cam00", "worse")
    assert ada.get(f"{MATCH}/runs/0001/0009").status_code == 404
    pin = {"run": "0001", "name": "v1"}
    assert ada.post(f"{MATCH}/pins", json=pin).status_code == 200
    assert ada.get(f"{MATCH}/runs").json()[3]["pins"] == ["v1"]
    # Neither needs the match folder.
    monkeypatch.setattr(registering, "_is_there", lambda folder: False)
    assert ada.post(f"{MATCH}/pins/v1/removal", json={}).status_code == 200
    assert ada.post(f"{MATCH}/pins/v1/removal", json={}).status_code == 422


def test_what_is_withdrawn_later_changes_no_cause_of_a_run():
    start = datetime(2026, 1, 1, tzinfo=UTC)

    def at(hours):
        return start + timedelta(hours=hours)

    edit = MovedKeypoint(camera="c", frame=1, detection=0, joint="nose", was=None, xy=(1.0, 2.0))
    made = [
        Correction(id=name, match_id="m", edit=edit, who="Ada", made_at=at(1), based_on={})
        for name in "ab"
    ]
    undone = Withdrawal(match_id="m", correction="a", who="Ada", withdrawn_at=at(3))
    journal = SimpleNamespace(records=[*made, undone], corrections={each.id: each for each in made})
    assert [corrections_since(journal, at(0), at(end)) for end in (0, 2, 4)] == [0, 2, 1]
    assert corrections_since(journal, at(2)) == 1


def test_a_run_is_cancelled(ada, monkeypatch):
    assert ada.post(f"{MATCH}/cancellation", json={}).status_code == 409

    def ended(script, *further):
        script = f"import os, signal, time; signal.signal(2, signal.SIG_DFL); {script}"
        monkeypatch.setattr(app_context, "_COMMAND", [sys.executable, "-c", script])
        for path in ("runs", *further):
            ada.post(f"{MATCH}/{path}", json={}).raise_for_status()
        end = time.monotonic() + 40.0
        while (found := ada.get(MATCH).json()["at_work"])["state"] == "running":
            assert time.monotonic() < end
            time.sleep(0.2)
        return found

    cancelled = ended("time.sleep(90)", "cancellation")  # before its process has begun, too
    assert cancelled["code"] == 130  # as the command itself ends
    stopped = MatchSummary(match_id="m", kind="stopped", words="stopped before its end")
    said = app_context.say_cancelled(stopped, cancelled)
    assert (said.words, "by Ada. Its finished steps" in said.why) == ("cancelled", True)
    killed = ended("os.kill(os.getpid(), 2); time.sleep(9)")
    assert killed["code"] == -2  # by nobody here
    assert app_context.say_cancelled(stopped, killed) == stopped


def test_a_run_that_cannot_start_has_its_reason_and_delays_no_other(store, monkeypatch):
    full, real = ["first"], app_context.tempfile.mkdtemp

    def make(**given):
        if full and full.pop():
            raise OSError(28, "No space left on device")
        return real(**given)

    monkeypatch.setattr(app_context.tempfile, "mkdtemp", make)
    monkeypatch.setattr(app_context, "_COMMAND", [sys.executable, "-c", "print('ran')"])
    runs, said = app_context.LocalRuns(store), {}
    for name in ("first", "second", TINY):
        runs.go_on(name, None)
        end = time.monotonic() + 40.0
        while runs.state(name)["state"] == "running":
            assert time.monotonic() < end
            time.sleep(0.05)
        said[name] = runs.state(name)["lines"]
    assert "No space left" in said["first"][0] and said["second"] == ["ran"]
    # What ended here is old news once the match has run elsewhere.
    done = {"run_id": store.reserve_run(TINY), "finished_at": datetime.now(UTC)}
    store.finish_run(store.run(TINY).model_copy(update=done))
    assert runs.state(TINY) is None


def test_a_keypoint_is_filled_in_between_two_corrections(ada, store):
    found = identities_now(store, open_match(store, TINY), "clip").identities
    row, k = 5, int((found.detection_index[5:11] >= 0).all(axis=0).sum(axis=0).argmax())
    c = int(np.flatnonzero((found.detection_index[row : row + 6, :, k] >= 0).all(axis=0))[0])
    camera, path = found.cameras[c], f"{MATCH}/detections/{found.cameras[c]}/interpolation"

    def place(offset):
        frame, detection = int(found.frame[row + offset]), found.detection_index[row + offset, c, k]
        seen = detections_now(store, open_match(store, TINY), camera, frame)
        return {"frame": frame, "detection": int(detection)}, seen.keypoints[0, detection]

    def say(number, kind, offset, **more):
        edit = {"kind": kind, "camera": camera, **place(offset)[0], **more}
        edits = {"edits": [{"id": f"{kind}.{number}", "edit": edit}]}
        return ada.post(f"{MATCH}/corrections", json=edits).status_code

    joint = int(np.isfinite(np.stack([place(n)[1] for n in range(6)])).all(axis=(0, 2)).argmax())
    asked = {**place(5)[0], "joint": COCO17[joint]}
    for odd in ({}, {"joint": "zz"}, {"detection": 5000}):  # nothing is corrected yet
        assert ada.post(path, json=asked | odd).status_code == 422
    assert say("zz", "moved_keypoint", 5, joint="zz", xy=None) == 409
    # The last correction of a frame counts.
    moves = ((0, (700.0, 20.0)), (0, (100.0, 200.0)), (3, None), (5, (150.0, 210.0)))
    for number, (offset, xy) in enumerate(moves):
        given = {"joint": COCO17[joint], "xy": xy, "was": place(offset)[1][joint].tolist()}
        assert say(number, "moved_keypoint", offset, **given) == 200
    assert say(4, "deleted_detection", 4) == 200
    assert len(ada.post(path, json=asked).json()["kept"]) == 2
    filled = [place(n)[1][joint].tolist() for n in (0, 1, 2, 5)]
    assert filled == [[100, 200], [110, 202], [120, 204], [150, 210]]
    assert np.isnan(place(3)[1][joint]).all()  # it was said to be invisible there
    assert np.isnan(place(4)[1]).all()


@pytest.fixture
def going_on(monkeypatch):
    asked = []
    go_on = lambda self, name, gates=None: asked.append(name) or {"state": "running"}  # noqa: E731
    monkeypatch.setattr(Continuing, "go_on", go_on)
    return asked


def waiting(store, state="waiting"):
    record = run_match(store, open_match(store, TINY), RunRequest({}, gates="auto"))
    assert record.state == state


def test_a_page_keeps_the_policy_of_a_run_that_did_not_come_to_the_end(ada, store, monkeypatch):
    asked, first = [], store.run(TINY)
    monkeypatch.setattr(Continuing, "go_on", lambda self, name, gates: asked.append(gates) or {})
    early = {name: key for name, key in first.results.items() if name.startswith("ingest/")}
    for gates, results in (("always", early), ("never", early), ("always", first.results)):
        changes = {"run_id": store.reserve_run(TINY), "gates": gates, "results": results}
        store.finish_run(first.model_copy(update=changes))
        ada.post(f"{MATCH}/runs", json={}).raise_for_status()
    assert asked == [None, "auto", "auto"]


def test_the_run_goes_on_when_the_last_question_is_approved(ada, bob, store, going_on):
    waiting(store)
    reviews = ada.get(MATCH).json()["reviews"]
    (row,) = (each for each in ada.get("/api/matches").json()["matches"] if each["match"] == TINY)
    assert len(row["waiting"]) == len(reviews) > 1
    assert max(each["excess"] for each in row["waiting"]) > 0
    for number, each in enumerate(reviews):
        verdict = {"reviews": [each["id"]], "verdict": "approve", "seen": {each["id"]: "waits"}}
        answer = ada.post(f"{MATCH}/decisions", json=verdict)
        assert answer.json()["waiting"] == len(reviews) - number - 1
    assert going_on == [TINY]
    # Bob's page still shows the question.
    answer = bob.post(f"{MATCH}/decisions", json={**verdict, "verdict": "reject", "why": "no"})
    difference = answer.json()["difference"]
    assert answer.status_code == 409
    assert (difference["now"], difference["who"]) == ("approve", "Ada")
    waiting(store, "complete")


def test_a_run_that_is_answered_while_it_ends_is_run_once_more(store, tmp_path, monkeypatch):
    ran, gate = tmp_path / "ran", tmp_path / "gate"
    ran.touch()
    script = (
        "import pathlib, sys, time\n"
        f"open({str(ran)!r}, 'a').write(sys.argv[1] + '\\n')\n"
        f"while not pathlib.Path({str(gate)!r}).exists(): time.sleep(0.01)\n"
    )
    monkeypatch.setattr(app_context, "_COMMAND", [sys.executable, "-c", script])
    monkeypatch.delenv("PREFECT_API_URL", raising=False)
    runs = Continuing(store)
    for _ in range(3):  # the second and third come while the first is at work
        assert runs.go_on(TINY)["state"] == "running"
    gate.touch()
    end = time.monotonic() + 60.0
    while ran.read_text().splitlines() != [TINY, TINY] or runs.state(TINY)["state"] != "ended":
        assert time.monotonic() < end
        time.sleep(0.02)
    assert runs.state(TINY)["code"] == 0


def test_an_empty_verdict_approves_nothing(ada, store, going_on):
    waiting(store)
    name = ada.get(MATCH).json()["reviews"][0]["id"]
    nothing = {"reviews": [], "verdict": "approve", "seen": {}}
    for body in ({}, {"reviews": [name]}, {"reviews": [name], "verdict": "", "seen": {}}, nothing):
        assert ada.post(f"{MATCH}/decisions", json=body).status_code == 422
    assert going_on == []


def test_a_clip_is_accepted_with_its_video_and_its_figures_over_time(
    ada, store, tmp_path, monkeypatch
):
    unit, name = "body_fitting/clip", "body_fitting.clip.asked"
    key = store.run(TINY).results[unit]
    manifest = store.manifest(TINY, *unit.split("/"), key)
    about = {"keys": {unit: key}, "contents": {unit: manifest.content}, "gate": "body_fitting"}
    about |= {"reasons": ("every result is asked about",), "figures": manifest.figures}
    say(store, TINY, lambda journal: [review_request(name, match_id=TINY, **about)])
    path, frames = f"{MATCH}/reviews/{name}", tmp_path / "cam02"
    run, match = open_run(store.url, TINY), open_match(store, TINY)
    spec = match.folder.spec
    (clip,) = spec.clips
    assert clip_view(run, match, "clip") is None  # no camera of this match has a video
    frames.mkdir()
    size = spec.camera("cam02")
    grey = np.full((size.height, size.width, 3), 90, dtype=np.uint8)
    for number in range(clip.frame_count - 1):  # the last image is missing
        cv2.imwrite(str(frames / f"{number:04d}.png"), grey, [cv2.IMWRITE_PNG_COMPRESSION, 1])
    opened = PageContext.match

    def with_video(self, name):
        match = opened(self, name)
        match.folder.videos["cam02"] = frames
        return match

    monkeypatch.setattr(PageContext, "match", with_video)
    away = frames.rename(tmp_path / "away")
    evidence = ada.get(f"{path}/evidence").json()
    assert (evidence["video"], evidence["tables"][-1]["rows"]) == (None, [["cam02"]])
    away.rename(frames)  # what was drawn without the images is not kept
    evidence = ada.get(f"{path}/evidence").json()
    assert evidence["video"] == "cam02" and evidence["pictures"] and evidence["tables"]
    assert (evidence["first_frame"], evidence["frames_per_value"]) == (clip.first_frame, 1)
    assert [len(each["values"]) for each in evidence["curves"]] == [clip.frame_count] * 4
    assert max(evidence["curves"][0]["values"]) <= len(run[unit]["person"])
    answer = ada.get(f"{path}/video", headers={"range": "bytes=0-99"})
    assert (answer.status_code, answer.headers["content-type"]) == (206, "video/mp4")
    (tmp_path / "shown.mp4").write_bytes(ada.get(f"{path}/video").content)
    with VideoReader(tmp_path / "shown.mp4") as video:
        pictures = [picture for _, picture in video.frames()]
    assert len(pictures) == len(range(0, clip.frame_count, max(1, round(spec.fps / 25))))
    # Coloured lines over grey.
    assert min(np.ptp(picture.astype(int), axis=2).max() for picture in pictures) > 40


def test_a_curve_of_a_long_clip_keeps_its_least_and_largest_values_in_order():
    gap = [np.nan] * 4
    found = thin_curve(np.array([1.0, 5.0, 0.0, 1.0, *gap, 3.0, 2.0]), every=2)
    assert np.array_equal(found, [5.0, 0.0, np.nan, np.nan, 3.0, 2.0], equal_nan=True)


def test_evidence_is_of_the_newest_run_with_the_results_asked_about(store):
    keys = {"tracking/clip": store.run(TINY).results["tracking/clip"]}
    killed = "0009"  # before its record was stored
    request = review_request("tracking.clip.1", match_id=TINY, run_id=killed, keys=keys)
    assert asked_run(store, request).record.run_id == "0001"
    gone = request.model_copy(update={"keys": {"tracking/clip": "0" * 32}})
    with pytest.raises(InputError, match="Run the match again"):
        asked_run(store, gone)
