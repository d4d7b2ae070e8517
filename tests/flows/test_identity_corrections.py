"""Identity corrections override the tracker's output, however the run produced it."""

import pytest
from command_line import TINY

from data_contracts.review import Correction, MergedTracks, SplitTrack
from flows.registering import open_match
from flows.review.corrections import keep_edits
from flows.review.edit_conflicts import StaleEditError
from flows.review.identities import identities_now
from flows.review.verdicts import origins_of
from flows.run_plan import plan_run
from flows.run_record import latest_run
from tasks.tracking import tracking
from worldpose.review.identities import find_sighting
from worldpose.store.paths import ResultId
from worldpose.store.store import Store


@pytest.fixture
def store(project_copy):
    return Store.open(str(project_copy))


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
    before = planned(store)
    clip = before.recipe.unit
    found = identities_now(store, open_match(store, TINY), clip).identities
    middle = int(found.frame[len(found.frame) // 2])
    seen = find_sighting(found, 0)
    say(store, a=SplitTrack(clip=clip, person=0, seen=seen, first_frame_of_new=middle))
    after = planned(store)
    assert before.published
    assert not after.published
    first = compute(store, after)
    data = store.open_result(TINY, "tracking", clip, after.key)
    new = int(found.person.max()) + 1
    assert data["person"].values.tolist() == [*found.person.tolist(), new]
    halves = (data["detection_index"].sel(person=[0, new]) >= 0).any("camera").values
    assert halves[: len(halves) // 2, 1].sum() == 0
    assert halves[len(halves) // 2 :, 0].sum() == 0
    assert data.attrs["objections"] == [None]
    # Without the tracker's own result it tracks again, and gives the same bytes.
    for key in (before.key, after.key):
        store.withdraw(ResultId(TINY, "tracking", clip, key))
    again = compute(store, planned(store))
    assert again.content == first.content
    assert again.figures == first.figures
    compute(store, before)
    # Merged again, all identities are the former ones.
    merge = MergedTracks(clip=clip, kept=0, merged=new)
    say(store, b=merge)
    compute(store, planned(store))
    whole = store.open_result(TINY, "tracking", clip, planned(store).key)
    assert (whole["detection_index"].values == found.detection_index).all()
    corrections = open_match(store, TINY).journal.standing.values()
    assert [type(each) for each in corrections] == [Correction, Correction]


def test_an_edit_of_somebody_who_is_another_by_now_is_refused(store):
    clip = planned(store).recipe.unit
    found = identities_now(store, open_match(store, TINY), clip).identities
    middle = int(found.frame[len(found.frame) // 2])
    seen = find_sighting(found, 0, first=middle)
    split = SplitTrack(clip=clip, person=0, seen=seen, first_frame_of_new=middle)
    say(store, a=split)
    say(store, a=split)  # the same edit sent again is kept once
    assert len(open_match(store, TINY).corrections) == 1
    with pytest.raises(StaleEditError, match="person 0 is not the person that was seen"):
        say(store, b=split)
    latest = latest_run(store, TINY)
    origins = origins_of(store, open_match(store, TINY), latest)
    assert origins[f"tracking/{clip}"] == "corrected"
