"""Corrections of identities over stored tracks, with and without those before the corrections."""

from dataclasses import replace
from importlib import import_module
from types import SimpleNamespace

import numpy as np
import pytest
import xarray as xr
from command_line import TINY, succeed
from page_client import MATCH
from run_records import correction

from data_contracts.match import PlayerSpec
from data_contracts.review import DeletedDetection, MergedTracks, MovedPoint, NamedTrack, SplitTrack
from flows.registering import open_match
from flows.results.best_results import clip_positions
from flows.review import corrections, identities
from flows.review.corrections import keep_edits, objections_of
from flows.review.edit_conflicts import StaleEditError, StoredResult
from flows.review.identities import identities_now, lost_names, names_of
from flows.review.verdicts import correct, origins_of, withdraw
from flows.run_plan import plan_run
from flows.run_record import RunLog, latest_run
from flows.settings import selected_stages
from tasks.tracking import tracking
from worldpose.errors import StoreError
from worldpose.review.identities import (
    IdentityReplay,
    find_sighting,
    replay_identities,
    stored_identities,
)
from worldpose.review.journal import Journal, append, read_journal
from worldpose.store.paths import ResultId
from worldpose.store.store import Run

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
    store, asked = type("Store", (), {})(), []

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


def say(store, **edits):
    return keep_edits(store, lambda: open_match(store, TINY), edits, who="Ada", note="")


def planned(store):
    """The unit of tracking as the next run would have it."""
    units = plan_run(store, open_match(store, TINY), {})
    return next(unit for unit in units if unit.recipe.stage == "tracking")


def compute(store, unit):
    tracking.fn(unit.work(store.url, open_match(store, TINY), "0009"))
    return store.manifest(TINY, "tracking", unit.recipe.unit, unit.key)


def test_a_split_and_a_merge_are_in_the_tracks_and_replayed_to_the_same_bytes(store):
    before, clip = planned(store), "clip"
    found = identities_now(store, open_match(store, TINY), clip).identities
    middle = int(found.frame[len(found.frame) // 2])
    seen = find_sighting(found, 0)
    say(store, a=SplitTrack(clip=clip, person=0, seen=seen, first_frame_of_new=middle))
    after = planned(store)
    assert before.published and not after.published
    first = compute(store, after)
    data = store.open_result(TINY, "tracking", clip, after.key)
    new = int(found.person.max()) + 1
    assert data["person"].values.tolist() == [*found.person.tolist(), new]
    halves = (data["detection_index"].sel(person=[0, new]) >= 0).any("camera").values
    assert not halves[: len(halves) // 2, 1].any() and not halves[len(halves) // 2 :, 0].any()
    assert data.attrs["objections"] == [None]
    # Without the tracker's own result it tracks again, and gives the same bytes.
    for key in (before.key, after.key):
        store.withdraw(ResultId(TINY, "tracking", clip, key))
    again = compute(store, planned(store))
    assert (again.content, again.figures) == (first.content, first.figures)
    compute(store, before)
    # Merged again, all identities are the former ones.
    say(store, b=MergedTracks(clip=clip, kept=0, merged=new))
    compute(store, planned(store))
    whole = store.open_result(TINY, "tracking", clip, planned(store).key)
    assert (whole["detection_index"].values == found.detection_index).all()


def test_an_edit_of_somebody_who_is_another_by_now_is_refused(store):
    clip = "clip"
    found = identities_now(store, open_match(store, TINY), clip).identities
    middle = int(found.frame[len(found.frame) // 2])
    seen = find_sighting(found, 0, first=middle)
    split = SplitTrack(clip=clip, person=0, seen=seen, first_frame_of_new=middle)
    say(store, a=split)
    say(store, a=split)  # the same edit sent again is kept once
    assert len(open_match(store, TINY).corrections) == 1
    with pytest.raises(StaleEditError, match="person 0 is not the person that was seen"):
        say(store, b=split)
    before, unit = latest_run(store, TINY), planned(store)
    compute(store, unit)
    results = {**before.results, f"tracking/{clip}": unit.key}
    after = before.model_copy(update={"results": results})
    for latest, origin in ((before, "automatic"), (after, "corrected")):
        assert origins_of(store, open_match(store, TINY), latest)[f"tracking/{clip}"] == origin


def test_a_name_recomputes_nothing_and_is_in_the_tables_at_once(store):
    clip = planned(store).recipe.unit
    found = identities_now(store, open_match(store, TINY), clip).identities
    keys = [unit.key for unit in plan_run(store, open_match(store, TINY), {})]
    names = ("José Núñez", "#10 (goal)")  # no ids of a roster
    for person, name in enumerate(names):
        seen = find_sighting(found, person)
        say(store, **{f"n{person}": NamedTrack(clip=clip, person=person, seen=seen, name=name)})
    assert [unit.key for unit in plan_run(store, open_match(store, TINY), {})] == keys
    run = Run(store, latest_run(store, TINY))
    assert clip_positions(run, clip).names[:3] == [*names, ""]
    assert origins_of(store, open_match(store, TINY), run.record)[f"tracking/{clip}"] == "automatic"
    # A split that the run does not contain yet leaves its names; the pages show both.
    middle = int(found.frame[len(found.frame) // 2])
    say(store, split=SplitTrack(clip=clip, person=0, first_frame_of_new=middle))
    new = int(found.person.max()) + 1
    say(store, late=NamedTrack(clip=clip, person=new, name="late"))
    assert names_of(run, clip) == dict(enumerate(names))
    now = identities_now(store, open_match(store, TINY), clip).identities.names
    assert now == {0: names[0], 1: names[1], new: "late"}
    unit = planned(store)
    compute(store, unit)
    results = {**run.record.results, f"tracking/{clip}": unit.key}
    after = Run(store, run.record.model_copy(update={"results": results}))
    assert names_of(after, clip) == now
    say(store, none=NamedTrack(clip=clip, person=0, name=None))
    assert names_of(after, clip) == {1: names[1], new: "late"}
    # Later iterations have no tracks without corrections.
    store.withdraw(ResultId(TINY, "tracking", clip, run.record.results[f"tracking/{clip}"]))
    assert names_of(after, clip) == {1: names[1], new: "late"}


def test_a_name_whose_detection_is_gone_is_reported_until_it_is_given_again(store, ada):
    found = identities_now(store, open_match(store, TINY), "clip").identities
    one, other = found.person.tolist()[:2]
    seen = find_sighting(found, one)
    say(store, a=NamedTrack(clip="clip", person=one, seen=seen, name="Ann"))
    run = Run(store, store.run(TINY))
    assert lost_names(run) == {}
    wrong = find_sighting(found, other)  # as after a run whose tracks have another detection there
    say(store, b=NamedTrack(clip="clip", person=other, seen=wrong, name="Bea"))
    said = read_journal(store, TINY).standing["b"]
    moved = {"id": "c", "edit": said.edit.model_copy(update={"seen": seen})}
    withdraw(store, open_match(store, TINY), ["b"], who="Ada", why="")
    append(store, read_journal(store, TINY), [said.model_copy(update=moved)])
    (told,) = lost_names(run).values()
    assert "'Bea' names no person" in told and names_of(run, "clip") == {one: "Ann"}
    page = ada.get(MATCH).json()
    (group,) = page["groups"]
    assert (page["stale"], group["stale"]) == (1, 1)
    (listed,) = succeed("review", "show", TINY, "--project", store.url, "--json").json["stale"]
    assert (listed["id"], listed["reason"]) == ("c", told)
    say(store, d=NamedTrack(clip="clip", person=other, seen=wrong, name="Bea"))
    assert lost_names(run) == {}


def state(store, people):
    """Name people in match.yaml."""
    registration = store.registration(TINY)
    (clip,) = registration.spec.clips
    named = clip.model_copy(update={"people": people})
    roster = tuple(PlayerSpec(id=name) for name in people.values())
    spec = registration.spec.model_copy(update={"clips": (named,), "roster": roster})
    store.register(registration.model_copy(update={"spec": spec}))


def test_names_of_the_match_folder_are_those_of_people_until_a_page_gives_others(store):
    found = identities_now(store, open_match(store, TINY), "clip").identities
    one, other = found.person.tolist()[:2]
    state(store, {one: "ann", other: "bea", 99: "cleo"})
    run = Run(store, store.run(TINY))
    assert clip_positions(run, "clip").names[:2] == ["ann", "bea"]
    (said,) = lost_names(run).values()
    assert "'cleo' in match.yaml names no person: clip clip has no person 99" in said
    assert objections_of(run) == {}  # of corrections alone
    say(store, a=NamedTrack(clip="clip", person=one, name="Ann"))
    say(store, b=NamedTrack(clip="clip", person=other, name=None))
    assert names_of(run, "clip") == {one: "Ann"}
    assert identities_now(store, open_match(store, TINY), "clip").identities.names[one] == "Ann"


def test_every_door_refuses_what_does_not_fit_the_results(store):
    refused = [
        NamedTrack(clip="clip", person=77, name="p"),
        DeletedDetection(camera="cam01", frame=5, detection=77),
        DeletedDetection(camera="cam01", frame=5, detection=0, was=(1.0, 1.0, 20.0, 20.0)),
    ]
    match = open_match(store, TINY)
    for edit in refused:
        with pytest.raises(StaleEditError):
            correct(store, match, [edit], who="Ada", why="")
        with pytest.raises(StaleEditError):
            say(store, a=edit)
    assert read_journal(store, TINY).entries == ()


@pytest.mark.slow
def test_what_a_run_refused_is_told_so_and_what_no_run_has_yet(store, tmp_path):
    out = DeletedDetection(camera="cam01", frame=5, detection=77)
    edits = {"out": out, "one": MergedTracks(clip="clip", kept=0, merged=88)}
    made = [correction(edit, name, match_id=TINY) for name, edit in edits.items()]
    append(store, read_journal(store, TINY), made)  # as an older version kept them

    def run(stages):
        def compute_units(stage, units):
            for unit in units:
                if not unit.published:
                    task = getattr(import_module(stage.task_module), stage.name)
                    task.fn(unit.work(store.url, open_match(store, TINY), "0002"))
                    yield unit, None

        return RunLog.begin(store, open_match(store, TINY), stages, {}).run_stages(compute_units)

    def shown(*options):
        return succeed("review", "show", TINY, "--project", store.url, *options)

    record = run(until := selected_stages(None, "tracking"))
    told = objections_of(Run(store, record))
    # As after a garbage collection.
    plain = ResultId(TINY, "ingest", "cam01", store.run(TINY, "0001").results["ingest/cam01"])
    (store.blobs.root / plain.path).rename(tmp_path / "plain")
    assert objections_of(Run(store, record)) == told
    (tmp_path / "plain").rename(store.blobs.root / plain.path)
    assert "there is no detection 77" in told["out"] and "no person 88" in told["one"]
    assert "corrected" not in origins_of(store, open_match(store, TINY), record).values()
    deleted = DeletedDetection(camera="cam01", frame=5, detection=0)
    say(store, later=deleted)
    text = shown().out
    assert "does not apply: there is no detection 77" in text
    assert "not in a run yet" in text and "corrected" not in text and "  applied" not in text
    # Made again, it is in the results of before; a name is in none, and counts at once.
    say(store, name=NamedTrack(clip="clip", person=0, name="Bo"))
    withdraw(store, open_match(store, TINY), ["later", "out", "one"], who="Ada", why="")
    say(store, again=deleted)
    run(until[:1])
    withdraw(store, open_match(store, TINY), ["again"], who="Ada", why="")
    say(store, third=deleted)
    found = shown("--json").json
    states = {each["id"]: each["state"] for each in found["corrections"]}
    assert states == {"third": "applied", "name": "applied"}
    assert found["origins"]["ingest/cam01"] == "corrected"
    click = open_match(store, TINY).folder.clicked["cam02"].points[0].name
    say(store, click=MovedPoint(camera="cam02", marking=click, xy=None))
    text = shown().out
    assert text.count("  applied") == 2 and text.count("not in a run yet") == 1
