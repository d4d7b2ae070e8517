"""A correction on a page is stored, shown to all users, and overwrites no other user's edit."""

import shutil
from dataclasses import replace
from pathlib import Path

import pytest
from command_line import TINY
from page_client import MATCH, a_click, moved

from flows.registering import open_match, register
from flows.review import corrections
from flows.web import app_context
from worldpose.errors import StoreError
from worldpose.review.journal import read_journal
from worldpose.store.store import Store


def test_a_correction_is_kept_with_who_and_shown_to_all(ada, bob, project_copy):
    name, was = a_click(ada)
    answer = ada.post(f"{MATCH}/corrections", json=moved(name, was, [was[0] + 1.5, was[1]]))
    assert answer.status_code == 200, answer.text
    assert bob.get(f"{MATCH}/pictures/cam03").json()["points"][name] == [was[0] + 1.5, was[1]]
    (kept,) = open_match(Store.open(str(project_copy)), TINY).corrections
    assert (kept.who, kept.edit.marking) == ("Ada", name)


def test_an_edit_of_what_somebody_changed_meanwhile_gets_the_difference(ada, bob, project_copy):
    name, was = a_click(ada)
    theirs, mine = [was[0] + 2.0, was[1]], [was[0] - 3.0, was[1]]
    assert bob.post(f"{MATCH}/corrections", json=moved(name, was, theirs, 1)).status_code == 200
    answer = ada.post(f"{MATCH}/corrections", json=moved(name, was, mine, 2))
    assert answer.status_code == 409
    difference = answer.json()["difference"]
    assert (difference["was"], difference["now"], difference["who"]) == (was, theirs, "Bob")
    assert difference["marking"] == name
    # Another point of the same camera does not conflict with her edit.
    clicked = ada.get(f"{MATCH}/pictures/cam03").json()["points"]
    other = max(clicked)
    assert other != name
    place = clicked[other]
    assert ada.post(
        f"{MATCH}/corrections", json=moved(other, place, [place[0], place[1] - 1.0], 3)
    ).is_success
    assert ada.post(f"{MATCH}/corrections", json=moved(name, theirs, mine, 4)).is_success
    assert len(open_match(Store.open(str(project_copy)), TINY).corrections) == 3


def test_an_edit_that_was_kept_but_not_acknowledged_is_kept_once(ada, project_copy, monkeypatch):
    name, was = a_click(ada)
    edit = moved(name, was, [was[0] + 1.0, was[1]])
    keep = corrections.append

    def cut_off(store, journal, records):
        keep(store, journal, records)
        raise StoreError("cut off after the entry was durable")

    monkeypatch.setattr(corrections, "append", cut_off)
    assert ada.post(f"{MATCH}/corrections", json=edit).status_code == 500
    monkeypatch.setattr(corrections, "append", keep)
    assert ada.post(f"{MATCH}/corrections", json=edit).status_code == 200
    assert len(open_match(Store.open(str(project_copy)), TINY).corrections) == 1


def test_edits_are_kept_all_or_none(ada, project_copy):
    name, was = a_click(ada)
    both = moved(name, was, [was[0] + 1.0, was[1]])
    both["edits"] += moved("no_such_point", None, [5.0, 5.0], 2)["edits"]
    answer = ada.post(f"{MATCH}/corrections", json=both)
    assert (answer.status_code, "no_such_point" in answer.text) == (422, True)
    assert read_journal(Store.open(str(project_copy)), TINY).entries == ()


def test_the_preview_is_a_camera_or_says_what_to_click(reader):
    clicked = reader.get(f"{MATCH}/pictures/cam00").json()["points"]
    few = dict(list(clicked.items())[:2])
    path = f"{MATCH}/pictures/cam00/preview"
    advice = reader.post(path, json={"points": few}).json()
    assert advice["camera"] is None
    assert advice["todo"]
    found = reader.post(path, json={"points": clicked}).json()
    assert {each["name"] for each in found["residuals"]} == set(clicked)
    # Where the camera puts a click that it rests on is where it was clicked, less its residual.
    for each in found["residuals"]:
        expected = [a + b for a, b in zip(clicked[each["name"]], each["residual"], strict=True)]
        # Sent to a hundredth of a pixel, residuals to a thousandth.
        assert found["points"][each["name"]] == pytest.approx(expected, abs=0.011)
    assert 0 < found["median"] < found["p95"]
    assert len(found["markings"]) > 3


def test_a_match_that_nobody_clicked_is_clicked_from_nothing(
    app, ada, project_copy, tiny, tmp_path
):
    folder = Path(shutil.copytree(tiny, tmp_path / "match"))
    file = folder / "match.yaml"
    file.write_text(file.read_text().replace(TINY, "new"))
    (folder / "annotations" / "static_calibration" / "cam00.json").unlink()
    detections = folder / "detections"
    spare = min(detections.iterdir())
    shutil.copy(max(detections.iterdir()), spare)  # another match's content
    store = Store.open(str(project_copy))
    register(store, folder, unfinished=True)
    path = "/api/matches/new"
    assert ada.get(path).json()["to_click"] == ["cam00"]
    assert ada.get(f"{path}/pictures/cam00").json()["points"] == {}
    edit = moved("center_mark", None, [900.0, 500.0], camera="cam00")
    assert ada.post(f"{path}/corrections", json=edit).is_success
    assert ada.get(f"{path}/pictures/cam00").json()["points"] == {"center_mark": [900.0, 500.0]}
    assert ada.get(path).json()["to_click"] == []
    # Before a run the match has the expected errors of the last preview, if its clicks are saved.
    errors = "expected_ground_error_median_m", "expected_ground_error_p95_m"

    def expected():
        return {each["id"]: each["figures"] for each in ada.get(path).json()["cameras"]}

    assert not any(expected().values())
    pictures = f"{path}/pictures/cam01"
    seen = ada.get(pictures).json()
    clicked = {"points": seen["points"], "drawn": seen["drawn"]}
    found = ada.post(f"{pictures}/preview", json=clicked).json()
    assert [expected()["cam01"][name] for name in errors] == pytest.approx(
        [found["median"], found["p95"]], rel=1e-3
    )
    name, place = next(iter(seen["points"].items()))
    clicked["points"][name] = [place[0] + 0.5, place[1]]
    ada.post(f"{pictures}/preview", json=clicked)  # while it is dragged
    assert expected()["cam01"] == {}


def test_a_page_shows_the_pitch_as_it_was_corrected(ada, project_copy, monkeypatch):
    store, path = Store.open(str(project_copy)), f"{MATCH}/pictures/cam00"
    opened = open_match(store, TINY)
    for length in (105.0, 101.0):
        pitch = opened.folder.pitch.model_copy(update={"length": length, "points": {}})
        match = replace(opened, folder=replace(opened.folder, pitch=pitch))
        monkeypatch.setattr(app_context, "open_for_review", lambda *_, match=match: match)
        assert ada.get(path).json()["pitch"]["length"] == length
