"""Corrections of a match on its page: in groups, with first clicks apart, and undone together."""

from datetime import timedelta

import page_client
import pytest
from command_line import TINY
from long_journal import SESSION, write_corrections
from page_client import MATCH

from data_contracts.review import Withdrawal
from flows.registering import open_for_review, register
from flows.web.corrections import SESSION_GAP
from worldpose.review.journal import read_journal
from worldpose.store.store import Store


@pytest.fixture
def store(tiny, tmp_path):
    """A project with a match that was not run."""
    store = Store.create(str(tmp_path / "project"))
    register(store, tiny, unfinished=True)
    return store


@pytest.fixture
def ada(store, tmp_path):
    return page_client.log_in(page_client.served(tmp_path / "project"), "Ada")


def groups(browser):
    return browser.get(MATCH).json()["groups"]


def test_corrections_are_grouped_by_person_camera_and_session(store, ada):
    count = 3 * SESSION + 10
    write_corrections(store, TINY, count)
    found = groups(ada)
    assert timedelta(hours=1) > SESSION_GAP  # sessions of the journal are an hour apart
    assert [group["who"] for group in found] == ["Bob", "Ada", "Bob", "Ada"]
    assert [group["count"] for group in found] == [11, SESSION, SESSION, SESSION - 1]
    assert {group["owner"] for group in found} == {"cam00"}
    assert found[1]["kinds"] == {"moved_point": SESSION // 10, "moved_keypoint": SESSION * 9 // 10}
    assert ada.get("/api/matches").json()["matches"][0]["corrections"] == count
    path = f"{MATCH}/corrections/{found[1]['id']}"
    pages = [ada.get(f"{path}?skip={skip}").json()["corrections"] for skip in (0, 200, 400, 600)]
    assert [len(page) for page in pages] == [200, 200, 100, 0]
    ids = [each["id"] for page in pages for each in page]
    assert len(set(ids)) == SESSION
    assert ids[-1] == found[1]["id"]


def test_a_group_is_undone_as_a_whole_and_only_as_it_was_seen(store, ada):
    write_corrections(store, TINY, SESSION + 10)
    last, first = groups(ada)
    path = f"{MATCH}/corrections/{last['id']}/withdrawal"
    assert ada.post(path, json={"count": last["count"] - 1}).status_code == 409
    entries = len(open_for_review(store, TINY).journal.entries)
    answer = ada.post(path, json={"count": last["count"], "why": "wrong camera"})
    assert answer.json() == {"withdrawn": last["count"]}
    assert groups(ada) == [first]
    journal = open_for_review(store, TINY).journal
    assert len(journal.entries) == entries + 1  # all or none, however many there are
    assert {each.why for each in journal.entries[-1].records} == {"wrong camera"}
    assert ada.post(path, json={"count": last["count"]}).status_code == 409
    assert ada.post(f"{MATCH}/corrections/none/withdrawal", json={"count": 0}).status_code == 409


def test_an_undo_that_is_repeated_is_done_and_goes_on_to_the_one_before(ada, store):
    write_corrections(store, TINY, 3)
    ids = [*read_journal(store, TINY).standing]
    for name in (ids[2], ids[2], ids[1]):  # the answer to the first was lost
        answer = ada.post(f"{MATCH}/withdrawals", json={"correction": name})
        assert answer.json() == {"withdrawn": name}
    journal = read_journal(store, TINY)
    assert [*journal.standing] == ids[:1]
    assert sum(isinstance(each, Withdrawal) for each in journal.records) == 2
    # What a page sends again, whose answer was lost as well, does not undo the withdrawal.
    edit = journal.corrections[ids[2]].edit.model_dump(mode="json")
    again = ada.post(f"{MATCH}/corrections", json={"edits": [{"id": ids[2], "edit": edit}]})
    assert [each["id"] for each in again.json()["kept"]] == [ids[2]]
    assert [*read_journal(store, TINY).standing] == ids[:1]


def test_what_is_refused_on_a_page_names_no_command(ada):
    gone = ada.post(f"{MATCH}/withdrawals", json={"correction": "none"})
    assert gone.status_code == 422
    assert "no such correction" in gone.json()["error"]
    note = ada.get(f"{MATCH}/detections/cam00").json()["note"]
    assert "found none. Run the match on its page." in note
    for path in ("results", "results/report", "identities/clip"):
        answer = ada.get(f"{MATCH}/{path}")
        assert answer.status_code >= 400
        said = str(answer.json().get("error", answer.json()))
        assert "worldpose run" not in said
        assert "`worldpose" not in said
    for page in ("/login", "/login/page.js", "/status"):
        text = ada.get(page).text
        assert "worldpose serve" not in text
        assert "command" not in text
