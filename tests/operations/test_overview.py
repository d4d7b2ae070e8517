"""Summaries of matches: what waits for review, and none is used that is not of what is there."""

import json
import os
import shutil
from pathlib import Path

import pytest
from command_line import TINY
from many_matches import copy_match
from page_client import MATCH, log_in, served

from data_contracts.review import NamedTrack
from flows import overview
from flows.layers import write_layer
from flows.overview import Overview, make_summary, read_summary
from flows.registering import open_match
from flows.review.corrections import keep_edits
from flows.service import status_page
from flows.web import queue
from worldpose.ingest.match_folder import read_match
from worldpose.ingest.registration import register_match
from worldpose.store.paths import ResultId, summary_path
from worldpose.store.store import Store


@pytest.fixture
def store(project_copy, tmp_path):
    store = Store.open(str(project_copy))
    folder = store.registration(TINY).folder
    own = shutil.copytree(folder, tmp_path / "own", ignore=shutil.ignore_patterns("reference"))
    for file in own.rglob("*.*"):
        os.utime(file, (1e9, 1e9))  # a file that has just changed is read again later
    store.register(register_match(read_match(own), None))
    return store


def correct(store):
    edit = NamedTrack(clip="clip", person=1, name="Ada")
    keep_edits(store, lambda: open_match(store, TINY), {"e1": edit}, who="Ada", note="")


def edit_click(store):
    folder = Path(store.registration(TINY).folder)
    file = next((folder / "annotations").rglob("*.json"))
    content = json.loads(file.read_text())
    content["points"][0]["xy"][0] += 1.0
    text = json.dumps(content)
    file.write_text(text)


def withdraw(store):
    (name, key) = next(iter(store.run(TINY).results.items()))
    store.withdraw(ResultId.from_name(TINY, name, key))


def remove_manifest(store):
    (name, key) = next(iter(store.run(TINY).results.items()))
    (store.blobs.root / ResultId.from_name(TINY, name, key).manifest_path).unlink()


def run_again(store):
    run = store.run(TINY)
    store.finish_run(run.model_copy(update={"run_id": store.reserve_run(TINY), "seconds": 1.5}))


def damage(store):
    file = store.blobs.root / "runs" / TINY / "0001.json"
    file.write_bytes(file.read_bytes()[:200])


CHANGES = {
    "a correction": correct,
    "an edited file of the match": edit_click,
    "a new file of the match": lambda store: (
        Path(store.registration(TINY).folder) / "roster.txt"
    ).write_text("Ada"),
    "a setting of the project": lambda store: write_layer(
        store, "project", {"detection.stride": 2}
    ),
    "a setting of the match": lambda store: write_layer(
        store, f"matches/{TINY}", {"detection.stride": 2}
    ),
    "a withdrawn result": withdraw,
    "a result without its manifest": remove_manifest,
    "a run": run_again,
    "a run that begins": lambda store: store.reserve_run(TINY),
    "damage": damage,
    "another environment": lambda store: os.environ.update(WORLDPOSE_BODY_FOLDER="/somewhere"),
    "other code": lambda store: overview.code_digest.cache_clear(),
}


@pytest.mark.parametrize("change", CHANGES.values(), ids=CHANGES)
def test_a_summary_is_used_until_something_changes_that_it_was_made_from(
    store, change, monkeypatch
):
    monkeypatch.setenv("WORLDPOSE_BODY_FOLDER", "")
    first = make_summary(store, TINY)
    assert first.made_from and first.kind == "ready"
    monkeypatch.setattr(overview, "make_summary", lambda store, match_id: "made again")
    assert read_summary(store, TINY) == first
    change(store)
    if change is CHANGES["other code"]:
        monkeypatch.setattr(overview, "libraries", lambda: {"numpy": "9"})
    assert read_summary(store, TINY) == "made again"
    overview.code_digest.cache_clear()


@pytest.mark.parametrize(
    "settings",
    [
        lambda file: {"detection.detector": f"onnx:{file}"},
        lambda file: {"detection.detector": ["embedded", f"onnx:{file}"]},
        lambda file: {"body_folder": str(file)},
    ],
)
def test_files_that_settings_name_are_watched_even_if_they_are_absent(store, settings, tmp_path):
    file = tmp_path / "named"
    write_layer(store, "project", settings(file))
    first = make_summary(store, TINY)
    assert str(file) in first.watched
    assert read_summary(store, TINY) == first
    file.mkdir()
    assert read_summary(store, TINY).made_from != first.made_from


def test_a_summary_that_is_damaged_or_of_another_match_is_made_again(store):
    first = make_summary(store, TINY)
    path = store.blobs.root / summary_path(TINY)
    whole = path.read_bytes()
    for text in (whole[:-9], whole.replace(b"ready", b"readx"), b"", b"{}"):
        path.write_bytes(text)
        assert (read_summary(store, TINY), path.read_bytes()) == (first, whole)
    path.rename(path.with_name("other.json"))
    assert read_summary(store, "other").problem
    assert read_summary(store, TINY) == first


def test_what_changes_while_a_summary_is_made_leaves_none_behind(store, monkeypatch):
    store.blobs.delete(summary_path(TINY))
    real = overview.open_for_review

    def edit_meanwhile(store, match_id):
        match = real(store, match_id)
        correct(store)
        return match

    monkeypatch.setattr(overview, "open_for_review", edit_meanwhile)
    assert make_summary(store, TINY).made_from == ""
    assert not store.blobs.exists(summary_path(TINY))


def test_a_changed_match_that_was_not_read_yet_is_shown_as_such(project_copy, store):
    copy_match(project_copy, TINY, 2)
    all_read = Overview(store)
    assert [each.kind for each in all_read.look()] == ["ready"] * 3
    for name in store.matches():
        run = store.run(name)
        store.finish_run(run.model_copy(update={"run_id": store.reserve_run(name)}))
    assert sorted(each.is_unseen for each in all_read.look(budget=0.0)) == [False, True, True]
    assert not any(each.is_unseen for each in all_read.look())


def test_lists_have_pages_and_the_server_searches(project_copy, monkeypatch):
    for module in (queue, status_page):
        monkeypatch.setattr(module, "PAGE", 5)
    copy_match(project_copy, TINY, 5)
    ada = log_in(served(project_copy), "Ada")
    while ada.get("/api/matches").json()["left"]:
        pass
    first, second, beyond = (
        ada.get("/api/matches", params={"page": page}).json() for page in (1, 2, 9)
    )
    assert (len(first["matches"]), len(second["matches"]), beyond["page"]) == (5, 1, 2)
    assert (first["total"], first["pages"], first["counts"]) == (6, 2, {"ready": 6})
    found = ada.get("/api/matches", params={"search": " COPY003"}).json()
    assert [each["match"] for each in found["matches"]] == [f"{TINY}-copy003"]
    assert ada.get("/api/matches", params={"kind": "failed"}).json()["matches"] == []
    assert ada.get(MATCH).json()["state"]["name"] == "ready"
    assert ada.get("/status").text.count("/#/match/") == 5
    assert ada.get("/status", params={"page": 2}).text.count("/#/match/") == 1
    for page, count in ((2, 1), (9, 1), (0, 5), (-3, 5)):
        assert len(ada.get("/api/status", params={"page": page}).json()["matches"]) == count
    assert "page 2 of 2" in ada.get("/status", params={"page": 9}).text
