"""Corrections on pages: kept for all, overwriting no other's, in groups, and undone together."""

import json
import shutil
from dataclasses import replace
from datetime import timedelta

import numpy as np
import page_client
import pytest
import yaml
from command_line import TINY
from long_journal import SESSION, write_corrections
from page_client import MATCH, a_click, moved
from run_records import calibration, match_spec

from data_contracts.review import Withdrawal
from flows.registering import open_for_review, open_match, register
from flows.web import app_context
from flows.web.corrections import SESSION_GAP
from worldpose.formats.calibration_forms import read_calibration
from worldpose.formats.calibration_writer import write_calibration_toml
from worldpose.ingest.footage import write_still
from worldpose.review.journal import read_journal
from worldpose.store.store import Store


def test_a_correction_is_kept_with_who_and_shown_to_all(ada, bob, store):
    name, was = a_click(ada)
    answer = ada.post(f"{MATCH}/corrections", json=moved(name, was, [was[0] + 1.5, was[1]]))
    assert answer.status_code == 200, answer.text
    assert bob.get(f"{MATCH}/pictures/cam03").json()["points"][name] == [was[0] + 1.5, was[1]]
    (kept,) = open_match(store, TINY).corrections
    assert (kept.who, kept.edit.marking) == ("Ada", name)


def test_an_edit_of_what_somebody_changed_meanwhile_gets_the_difference(ada, bob, store):
    def say(who, *edit):
        return who.post(f"{MATCH}/corrections", json=moved(*edit))

    name, was = a_click(ada)
    theirs, mine = [was[0] + 2.0, was[1]], [was[0] - 3.0, was[1]]
    assert say(bob, name, was, theirs, 1).status_code == 200
    answer = say(ada, name, was, mine, 2)
    assert answer.status_code == 409
    difference = answer.json()["difference"]
    assert (difference["was"], difference["now"], difference["who"]) == (was, theirs, "Bob")
    assert difference["marking"] == name
    # Another point of the same camera does not conflict with her edit.
    clicked = ada.get(f"{MATCH}/pictures/cam03").json()["points"]
    other = max(clicked)
    x, y = clicked[other]
    assert other != name and say(ada, other, [x, y], [x, y - 1.0], 3).is_success
    assert say(ada, name, theirs, mine, 4).is_success
    assert len(open_match(store, TINY).corrections) == 3


def test_edits_are_kept_all_or_none(ada, store):
    name, was = a_click(ada)
    both = moved(name, was, [was[0] + 1.0, was[1]])
    both["edits"] += moved("no_such_point", None, [5.0, 5.0], 2)["edits"]
    answer = ada.post(f"{MATCH}/corrections", json=both)
    assert (answer.status_code, "no_such_point" in answer.text) == (422, True)
    assert read_journal(store, TINY).entries == ()


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


def test_a_match_that_nobody_clicked_is_clicked_from_nothing(ada, store, tiny, tmp_path):
    folder = shutil.copytree(tiny, tmp_path / "match")
    file = folder / "match.yaml"
    file.write_text(file.read_text().replace(TINY, "new"))
    (folder / "annotations" / "static_calibration" / "cam00.json").unlink()
    detections = sorted((folder / "detections").iterdir())
    shutil.copy(detections[-1], detections[0])  # another match's content
    register(store, folder, unfinished=True)
    path, picture = "/api/matches/new", "/api/matches/new/pictures/cam00"
    assert ada.get(path).json()["to_click"] == ["cam00"]
    assert ada.get(picture).json()["points"] == {}
    edit = moved("center_mark", None, [900.0, 500.0], camera="cam00")
    assert ada.post(f"{path}/corrections", json=edit).is_success
    assert ada.get(picture).json()["points"] == {"center_mark": [900.0, 500.0]}
    assert ada.get(path).json()["to_click"] == []
    # Before a run the match has the expected errors of the last preview, if its clicks are saved.

    def expected():
        return {each["id"]: each["figures"] for each in ada.get(path).json()["cameras"]}

    assert not any(expected().values())
    picture = f"{path}/pictures/cam01"
    seen = ada.get(picture).json()
    clicked = {"points": seen["points"], "drawn": seen["drawn"]}
    found = ada.post(f"{picture}/preview", json=clicked).json()
    errors = [expected()["cam01"][f"expected_ground_error_{n}_m"] for n in ("median", "p95")]
    assert errors == pytest.approx([found["median"], found["p95"]], rel=1e-3)
    name, (x, y) = next(iter(seen["points"].items()))
    clicked["points"][name] = [x + 0.5, y]
    ada.post(f"{picture}/preview", json=clicked)  # while it is dragged
    assert expected()["cam01"] == {}


def test_a_camera_of_a_match_without_a_pitch_says_where_it_stands(
    unrun_store, ada_before_runs, tmp_path
):
    folder = tmp_path / "lab"
    for name in ("stills", "detections"):
        (folder / name).mkdir(parents=True)
    clips = {"trial": {"frame_count": 10}}
    spec = match_spec("ab", clips, (64, 48), match_id="lab", pitch="none")
    (folder / "match.yaml").write_text(yaml.safe_dump(spec.model_dump(mode="json")))
    # It stands at (1, -3, 2) m, and looks to y, 30 degrees down.
    sine, cosine = 0.5, 3**0.5 / 2
    given = calibration(
        "a",
        image_size=(64, 48),
        principal_point_px=(31.5, 23.5),
        rotation=((1.0, 0.0, 0.0), (0.0, -sine, -cosine), (0.0, cosine, -sine)),
        translation=(-1.0, 2.0 * cosine - 3.0 * sine, 2.0 * sine + 3.0 * cosine),
    )
    write_calibration_toml(folder / "calibration.toml", {"a": given})
    write_still(folder / "stills" / "a.png", np.full((48, 64, 3), 90, np.uint8))
    person = [{"image_id": 0, "keypoints": [30.0, 20.0, 0.9] * 17}]
    for name in "ab":
        (folder / "detections" / f"{name}.json").write_text(json.dumps(person))
    register(unrun_store, folder, unfinished=True)
    path = "/api/matches/lab/pictures"
    seen, other = (ada_before_runs.get(f"{path}/{name}").json() for name in "ab")
    assert (seen["pitch"], seen["given"], seen["clip"]) == (None, True, "trial")
    assert seen["pose"][:2] == [
        "It stands at x 1.00 m, y -3.00 m, z 2.00 m.",
        "It looks 30° down, to 90° from the x axis (y is at 90°).",
    ]
    assert ada_before_runs.get(f"{path}/a/image").status_code == 200
    assert (other["pose"], other["given"]) == (None, False)
    assert ada_before_runs.post(f"{path}/a/preview", json={}).status_code == 404


def test_a_page_shows_the_pitch_as_it_was_corrected(ada, store, tiny, monkeypatch):
    path, opened = f"{MATCH}/pictures/cam00", open_match(store, TINY)

    def shown(**changes):
        match = replace(opened, folder=replace(opened.folder, **changes))
        monkeypatch.setattr(app_context, "open_for_review", lambda *_: match)
        return ada.get(path).json()

    for length in (105.0, 101.0):
        pitch = opened.folder.pitch.model_copy(update={"length": length, "points": {}})
        assert shown(pitch=pitch)["pitch"]["length"] == length
    camera = next(iter(read_calibration(tiny / "reference" / "calibration.toml").values()))
    assert shown(calibrations={"cam00": camera})["markings"]


@pytest.fixture
def unrun_store(tiny, tmp_path):
    """A project with a match that was not run."""
    store = Store.create(str(tmp_path / "project"))
    register(store, tiny, unfinished=True)
    return store


@pytest.fixture
def ada_before_runs(unrun_store, tmp_path):
    return page_client.log_in(page_client.served(tmp_path / "project"), "Ada")


def groups(browser):
    return browser.get(MATCH).json()["groups"]


def test_corrections_are_grouped_by_person_camera_and_session(unrun_store, ada_before_runs):
    count = 3 * SESSION + 10
    write_corrections(unrun_store, TINY, count)
    found = groups(ada_before_runs)
    assert timedelta(hours=1) > SESSION_GAP  # sessions of the journal are an hour apart
    assert [group["who"] for group in found] == ["Bob", "Ada", "Bob", "Ada"]
    assert [group["count"] for group in found] == [11, SESSION, SESSION, SESSION - 1]
    assert {group["owner"] for group in found} == {"cam00"}
    assert found[1]["kinds"] == {"moved_point": SESSION // 10, "moved_keypoint": SESSION * 9 // 10}
    assert ada_before_runs.get("/api/matches").json()["matches"][0]["corrections"] == count
    path = f"{MATCH}/corrections/{found[1]['id']}"
    skipped = (ada_before_runs.get(f"{path}?skip={skip}").json() for skip in (0, 200, 400, 600))
    pages = [[each["id"] for each in page["corrections"]] for page in skipped]
    assert [len(page) for page in pages] == [200, 200, 100, 0]
    ids = [each for page in pages for each in page]
    assert (len(set(ids)), ids[-1]) == (SESSION, found[1]["id"])


def test_a_group_is_undone_as_a_whole_and_only_as_it_was_seen(unrun_store, ada_before_runs):
    def undo(group, count):
        path = f"{MATCH}/corrections/{group}/withdrawal"
        return ada_before_runs.post(path, json={"count": count, "why": "wrong camera"})

    write_corrections(unrun_store, TINY, SESSION + 10)
    last, first = groups(ada_before_runs)
    name, count = last["id"], last["count"]
    assert undo(name, count - 1).status_code == 409
    entries = len(open_for_review(unrun_store, TINY).journal.entries)
    assert undo(name, count).json() == {"withdrawn": count}
    assert groups(ada_before_runs) == [first]
    journal = open_for_review(unrun_store, TINY).journal
    assert len(journal.entries) == entries + 1  # all or none, however many there are
    assert {each.why for each in journal.entries[-1].records} == {"wrong camera"}
    assert undo(name, count).status_code == undo("none", 0).status_code == 409


def test_an_undo_that_is_repeated_is_done_and_goes_on_to_the_one_before(
    ada_before_runs, unrun_store
):
    write_corrections(unrun_store, TINY, 3)
    ids = [*read_journal(unrun_store, TINY).standing]
    for name in (ids[2], ids[2], ids[1]):  # the answer to the first was lost
        answer = ada_before_runs.post(f"{MATCH}/withdrawals", json={"correction": name})
        assert answer.json() == {"withdrawn": name}
    journal = read_journal(unrun_store, TINY)
    assert [*journal.standing] == ids[:1]
    assert sum(isinstance(each, Withdrawal) for each in journal.records) == 2
    # What a page sends again, whose answer was lost as well, does not undo the withdrawal.
    edit = journal.corrections[ids[2]].edit.model_dump(mode="json")
    again = ada_before_runs.post(
        f"{MATCH}/corrections", json={"edits": [{"id": ids[2], "edit": edit}]}
    )
    assert [each["id"] for each in again.json()["kept"]] == [ids[2]]
    assert [*read_journal(unrun_store, TINY).standing] == ids[:1]
