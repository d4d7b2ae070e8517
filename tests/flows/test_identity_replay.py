"""Corrections of identities over stored tracks, with and without those before the corrections."""

from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pytest
import xarray as xr
from run_records import correction

from data_contracts.review import MergedTracks, MovedPoint, NamedTrack, SplitTrack
from flows.review import corrections, identities
from flows.review.edit_conflicts import StoredResult
from worldpose.errors import StoreError
from worldpose.review.identities import IdentityReplay, replay_identities, stored_identities
from worldpose.review.journal import Journal

FRAMES = 12


def tracks(*edits):
    """Tracks of three people whom two cameras see all the time, as a run stores them."""
    index = np.broadcast_to(np.arange(3, dtype=np.int16), (FRAMES, 2, 3))
    result = xr.Dataset(
        {"detection_index": (("frame", "camera", "person"), index)},
        {"frame": np.arange(FRAMES), "camera": ["a", "b"], "person": np.arange(3, dtype=np.int32)},
        {"joins": [], "changes": [], "objections": []},
    )
    replay = replay_identities(stored_identities(result, with_joints=False), edits)
    found = replay.identities
    return xr.Dataset(
        {"detection_index": (("frame", "camera", "person"), found.detection_index)},
        {"frame": found.frame, "camera": [*found.cameras], "person": found.person},
        result.attrs | {"objections": [*replay.objections]},
    )


def merge(kept, merged):
    return MergedTracks(clip="clip", kept=kept, merged=merged)


def split(person, frame):
    return SplitTrack(clip="clip", person=person, first_frame_of_new=frame)


def named(person, name):
    return NamedTrack(clip="clip", person=person, name=name)


def replay(said, taken=0, stated=None, in_run=None):
    """Replay corrections over the tracks with the first of the merges and splits."""
    moves = [edit for edit in said if not isinstance(edit, NamedTrack)][:taken]
    stored = StoredResult(
        tracks(*moves), "0" * 32, [each.model_dump(mode="json") for each in moves]
    )
    in_run = taken if in_run is None else in_run
    return identities._replay(stored, said, stated or {}, in_run, with_joints=False)


@pytest.mark.parametrize("taken", range(5))
def test_an_edit_made_twice_is_replayed_twice_whatever_the_tracks_contain(taken):
    said = [split(0, 6), named(3, "Bo"), merge(0, 3), split(0, 6), merge(2, 9), named(3, "Al")]
    whole = replay(said).identities
    found = replay(said, taken)
    assert found.identities.person.tolist() == [0, 1, 2, 3]
    assert np.array_equal(found.identities.detection_index, whole.detection_index)
    assert found.identities.names == whole.names == {0: "Bo", 3: "Al"}
    assert [bool(why) for why in found.objections] == [False, False, False, False, True, False]


@pytest.mark.parametrize(("in_run", "taken"), [(n, k) for n in range(5) for k in {0, n}])
def test_a_name_of_the_match_folder_is_of_whom_the_run_gives_the_id(in_run, taken):
    stated = {1: "bea", 2: "cleo", 3: "dora"}
    said = [split(2, 6), merge(2, 3), merge(1, 9), split(1, 6)]
    found = replay(said, taken, stated, in_run).identities
    assert found.person.tolist() == [0, 1, 2, 3]
    # A merge of the run, or one since, removed the id, unless the run has given it again.
    assert found.names == (stated if in_run == 4 else {1: "bea", 2: "cleo"})
    again = [*said, merge(1, 3), split(0, 6)]
    assert replay(again, taken, stated, in_run).identities.names == {1: "bea", 2: "cleo"}
    # A split alone, and merges that do not apply, take no name away.
    refused = [split(1, 6), merge(0, 2), merge(9, 3)]
    taken, in_run = min(taken, 3), min(in_run, 3)
    assert replay(refused, taken, stated, in_run).identities.names == stated


@pytest.mark.parametrize("edit", [merge(0, 3), split(2, 6), named(2, "x")])
def test_an_edit_is_kept_with_sightings_and_applies_to_no_other_person_of_the_id(edit, monkeypatch):
    found = replay([split(0, 6)]).identities
    monkeypatch.setattr(identities, "identities_now", lambda *_: IdentityReplay(found, ()))
    click = MovedPoint(camera="a", marking="corner", xy=None)
    full, kept_click = identities.require_fitting(None, None, [edit, click])
    assert (edit != full, kept_click) == (True, click)
    assert replay_identities(found, [full]).objections == (None,)
    other = replace(
        found, detection_index=np.where(found.detection_index < 0, -1, found.detection_index + 5)
    )
    assert replay_identities(other, [edit]).objections == (None,)
    (why,) = replay_identities(other, [full]).objections
    assert "is not the person that was seen" in why


@pytest.mark.parametrize(
    ("said", "made", "told"),
    [
        ([split(0, 6), named(3, "Al"), merge(2, 9)], [split(0, 6)], {2: "no person 9"}),
        ([split(0, 6), named(3, "Al"), named(4, "Bo")], [], {0: None, 1: None, 2: "no person 4"}),
        ([split(0, 6), named(3, "Al")], [split(0, 6)], {}),
        ([named(3, "Al"), named(1, "Bo")], [merge(0, 1)], {0: "no person 3", 1: None}),  # withdrawn
        ([split(0, 6), merge(0, 3)] * 26, [], {}),  # too many
    ],
)
def test_what_the_latest_tracks_lack_alone_is_replayed_up_to_a_limit(said, made, told, monkeypatch):
    as_json = [edit.model_dump(mode="json") for edit in made]

    def opened(store, run, name, source, moves):
        is_own = made and as_json == [edit.model_dump(mode="json") for edit in moves[: len(made)]]
        return StoredResult(tracks(*(made if is_own else ())), "plain", as_json if is_own else [])

    monkeypatch.setattr(identities, "open_stored", opened)
    results = {"tracking/clip": "own" if made else "plain"}
    store = SimpleNamespace(run=lambda _: SimpleNamespace(match_id="m", results=results))
    match = SimpleNamespace(match_id="m", corrections=[correction(edit, "c") for edit in said])
    found = identities.identity_objections(store, match, "clip")
    assert found.keys() == told.keys()
    assert all(found[n] is why if why is None else why in found[n] for n, why in told.items())


def test_objections_are_replayed_once_for_results_and_corrections(monkeypatch):
    class Kept:
        """A store."""

    store, asked = Kept(), []

    def replay(store, match, clip):
        asked.append(clip)
        if clip == "gone":
            raise StoreError("withdrawn")
        return {0: None, 1: "no person 9"}

    monkeypatch.setattr(corrections, "Run", lambda *_: None)
    monkeypatch.setattr(corrections, "objections_of", lambda _: {"n": "lost", "x": "refused"})
    monkeypatch.setattr(corrections, "identity_objections", replay)
    gone = SplitTrack(clip="gone", person=0, first_frame_of_new=6)
    made = [correction(named(3, "Al"), "n"), correction(merge(2, 9), "m"), correction(gone, "g")]
    match = SimpleNamespace(match_id="m", corrections=made)
    for key in "aab":
        record = SimpleNamespace(results={"tracking/clip": key})
        found = corrections.objections_now(store, match, record)
        assert found == {"x": "refused", "m": "no person 9"}
    assert asked.count("clip") == 2
    assert corrections.objections_now(store, match, None) == {}


def test_corrections_are_replayed_once_until_another_one_or_another_result(monkeypatch):
    class Run(dict):
        """A run, and its store."""

        record = SimpleNamespace(match_id="m", run_id="0001", results={})
        __hash__ = object.__hash__
        run = runs = lambda self, _: self.record
        registration = lambda self, _: None  # noqa: E731
        has = lambda self, *_: True  # noqa: E731
        manifest = lambda self, *_: SimpleNamespace(recipe=SimpleNamespace(sources={}))  # noqa: E731

    run, real, made = Run({"tracking/clip": None}), identities._replay, []
    run.store = run
    monkeypatch.setattr(identities, "_replay", lambda *a, **k: made.append(a) or real(*a, **k))
    monkeypatch.setattr(identities, "open_stored", lambda *_: StoredResult(tracks(), "k", []))
    first, later = {"a": named(0, "Al"), "b": named(7, "Bo")}, {"c": named(1, "Cy")}
    for count, key, said in ((2, "k", first), (4, "k", first | later), (6, "l", first | later)):
        run.record.results["tracking/clip"] = key
        monkeypatch.setattr(identities, "read_journal", lambda *_, said=said: journal(said))
        match = SimpleNamespace(match_id="m", corrections=journal(said).standing.values())
        for _ in range(3):
            assert [*identities.lost_names(run)] == ["b"]
            now = identities.identities_now(run, match, "clip", with_joints=False).identities
        assert (len(made), len(now.names)) == (count, 1 + ("c" in said))


def journal(said, withdrawn=()):
    """A journal of corrections by id, some of which were withdrawn."""
    made = {name: correction(edit, name) for name, edit in said.items()}
    standing = {name: each for name, each in made.items() if name not in withdrawn}
    return Journal("m", corrections=made, standing=standing)


SPLITS = {"a": split(0, 6), "b": split(1, 6), "c": split(0, 6), "n": named(4, "Al")}
ANEW = {"a": split(0, 6), "n": named(3, "Al"), "b": merge(0, 3), "c": split(0, 6)}


@pytest.mark.parametrize(
    ("said", "withdrawn", "taken", "used"),
    [
        (SPLITS, "a", "bc", "bcn"),
        (SPLITS, "", "ab", "abn"),  # a run before the last split
        (SPLITS, "ac", "bc", "bcn"),  # an older run
        (SPLITS, "an", "bc", "bc"),
        (ANEW, "", "a", "an"),  # in force: the split before the name, and not the later one
        (ANEW, "", "abc", "anbc"),
        (ANEW, "b", "abc", "anbc"),
    ],
)
def test_of_equal_corrections_a_result_has_each_once(said, withdrawn, taken, used):
    moves = [said[name].model_dump(mode="json") for name in taken]
    found = identities._said_in(journal(said, withdrawn), "clip", moves)
    assert [*found] == [*used]
    assert identities._said_in(journal(said, withdrawn), "other", []) == {}
