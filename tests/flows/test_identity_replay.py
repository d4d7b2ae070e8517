"""Corrections of identities over stored tracks, with and without those before the corrections."""

import numpy as np
import pytest
import xarray as xr

from data_contracts.review import MergedTracks, NamedTrack, SplitTrack
from flows.review import identities
from flows.review.edit_conflicts import StoredResult
from worldpose.review.identities import replay_identities, stored_identities

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


def replay(said, taken=0, stated=None):
    """Replay corrections over the tracks with the first of the merges and splits."""
    moves = [edit for edit in said if not isinstance(edit, NamedTrack)][:taken]
    stored = StoredResult(
        tracks(*moves), "0" * 32, [each.model_dump(mode="json") for each in moves]
    )
    return identities._replay(stored, said, stated or {}, with_joints=False)


@pytest.mark.parametrize("taken", range(5))
def test_an_edit_made_twice_is_replayed_twice_whatever_the_tracks_contain(taken):
    said = [split(0, 6), named(3, "Bo"), merge(0, 3), split(0, 6), merge(2, 9), named(3, "Al")]
    whole = replay(said).identities
    found = replay(said, taken)
    assert found.identities.person.tolist() == [0, 1, 2, 3]
    assert np.array_equal(found.identities.detection_index, whole.detection_index)
    assert found.identities.names == whole.names == {0: "Bo", 3: "Al"}
    assert [bool(why) for why in found.objections] == [False, False, False, False, True, False]
