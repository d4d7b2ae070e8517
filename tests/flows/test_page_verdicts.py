"""A decision on a page resumes the run, once."""

import sys
import time

import cv2
import numpy as np
import pytest
from command_line import TINY
from page_client import MATCH
from run_records import review_request

from flows.registering import open_match
from flows.reports.clip_video import clip_view
from flows.running import RunRequest, run_match
from flows.web import app_context
from flows.web.app_context import Continuing, PageContext
from flows.web.evidence import asked_run, thin_curve
from worldpose.errors import InputError
from worldpose.review.journal import say
from worldpose.store.store import Store, open_run
from worldpose.video.files import VideoReader


@pytest.fixture
def going_on(monkeypatch):
    asked = []
    monkeypatch.setattr(
        Continuing,
        "go_on",
        lambda self, name, gates=None: asked.append(name) or {"state": "running"},
    )
    return asked


def waiting(store):
    run_match(store, open_match(store, TINY), RunRequest({}, gates="auto"))


def test_a_page_keeps_the_policy_of_a_run_that_did_not_come_to_the_end(ada, store, monkeypatch):
    asked, first = [], store.run(TINY)
    monkeypatch.setattr(Continuing, "go_on", lambda self, name, gates: asked.append(gates) or {})
    early = {name: key for name, key in first.results.items() if name.startswith("ingest/")}
    for gates, results in (("always", early), ("never", early), ("always", first.results)):
        changes = {"run_id": store.reserve_run(TINY), "gates": gates, "results": results}
        store.finish_run(first.model_copy(update=changes))
        ada.post(f"{MATCH}/runs", json={}).raise_for_status()
    assert asked == [None, "auto", "auto"]


def test_the_run_goes_on_when_the_last_question_is_approved(ada, bob, project_copy, going_on):
    waiting(Store.open(str(project_copy)))
    reviews = ada.get(MATCH).json()["reviews"]
    assert len(reviews) > 1
    (row,) = (each for each in ada.get("/api/matches").json()["matches"] if each["match"] == TINY)
    assert len(row["waiting"]) == len(reviews)
    assert max(each["excess"] for each in row["waiting"]) > 0
    for number, each in enumerate(reviews):
        verdict = {"reviews": [each["id"]], "verdict": "approve", "seen": {each["id"]: "waits"}}
        answer = ada.post(f"{MATCH}/decisions", json=verdict)
        assert answer.json()["waiting"] == len(reviews) - number - 1
    assert going_on == [TINY]
    # Bob's page still shows the question.
    answer = bob.post(f"{MATCH}/decisions", json={**verdict, "verdict": "reject", "why": "no"})
    assert answer.status_code == 409
    assert (answer.json()["difference"]["now"], answer.json()["difference"]["who"]) == (
        "approve",
        "Ada",
    )
    assert (
        run_match(
            Store.open(str(project_copy)),
            open_match(Store.open(str(project_copy)), TINY),
            RunRequest({}, gates="auto"),
        ).state
        == "complete"
    )


def test_a_run_that_is_answered_while_it_ends_is_run_once_more(project_copy, tmp_path, monkeypatch):
    ran, gate = tmp_path / "ran", tmp_path / "gate"
    ran.touch()
    script = (
        "import pathlib, sys, time\n"
        f"open({str(ran)!r}, 'a').write(sys.argv[1] + '\\n')\n"
        f"while not pathlib.Path({str(gate)!r}).exists(): time.sleep(0.01)\n"
    )
    monkeypatch.setattr(app_context, "_COMMAND", [sys.executable, "-c", script])
    monkeypatch.delenv("PREFECT_API_URL", raising=False)
    runs = Continuing(Store.open(str(project_copy)))
    for _ in range(3):  # the second and third come while the first is at work
        assert runs.go_on(TINY)["state"] == "running"
    gate.touch()
    end = time.monotonic() + 60.0
    while ran.read_text().splitlines() != [TINY, TINY] or runs.state(TINY)["state"] != "ended":
        assert time.monotonic() < end
        time.sleep(0.02)
    assert runs.state(TINY)["code"] == 0


def test_an_empty_verdict_approves_nothing(ada, project_copy, going_on):
    waiting(Store.open(str(project_copy)))
    name = ada.get(MATCH).json()["reviews"][0]["id"]
    for body in ({}, {"reviews": [name]}, {"reviews": [name], "verdict": "", "seen": {}}):
        assert ada.post(f"{MATCH}/decisions", json=body).status_code == 422
    nothing = {"reviews": [], "verdict": "approve", "seen": {}}
    assert ada.post(f"{MATCH}/decisions", json=nothing).status_code == 422
    assert going_on == []


def test_a_clip_is_accepted_with_its_video_and_its_figures_over_time(
    ada, project_copy, tmp_path, monkeypatch
):
    store = Store.open(str(project_copy))
    key = store.run(TINY).results["body_fitting/clip"]
    manifest = store.manifest(TINY, "body_fitting", "clip", key)
    unit, name = "body_fitting/clip", "body_fitting.clip.asked"
    about = {"keys": {unit: key}, "contents": {unit: manifest.content}, "gate": "body_fitting"}
    about |= {"reasons": ("every result is asked about",), "figures": manifest.figures}
    question = review_request(name, match_id=TINY, **about)
    say(store, TINY, lambda journal: [question])
    path = f"{MATCH}/reviews/{question.id}"
    run = open_run(str(project_copy), TINY)
    match = open_match(store, TINY)
    spec = match.folder.spec
    (clip,) = spec.clips
    assert clip_view(run, match, "clip") is None  # no camera of this match has a video
    frames = tmp_path / "cam02"
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
    assert evidence["video"] == "cam02"
    assert evidence["pictures"] and evidence["tables"]
    assert (evidence["first_frame"], evidence["frames_per_value"]) == (clip.first_frame, 1)
    assert [len(each["values"]) for each in evidence["curves"]] == [clip.frame_count] * 4
    assert max(evidence["curves"][0]["values"]) <= len(run["body_fitting/clip"]["person"])
    answer = ada.get(f"{path}/video", headers={"range": "bytes=0-99"})
    assert (answer.status_code, answer.headers["content-type"]) == (206, "video/mp4")
    (tmp_path / "shown.mp4").write_bytes(ada.get(f"{path}/video").content)
    with VideoReader(tmp_path / "shown.mp4") as video:
        pictures = [picture for _, picture in video.frames()]
    every = max(1, round(spec.fps / 25))
    assert len(pictures) == len(range(0, clip.frame_count, every))
    drawn = [np.ptp(picture.astype(int), axis=2).max() for picture in pictures]
    assert min(drawn) > 40  # coloured lines over grey


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
