"""Merges and splits move what the tracker found between people; nothing is made up or lost."""

import numpy as np
import pytest
from hypothesis import given as given_that
from hypothesis import strategies as st

from data_contracts.review import MergedTracks, NamedTrack, Sighting, SplitTrack
from data_contracts.tracking import Join
from worldpose.review.identities import (
    Identities,
    add_plane_tracks,
    find_sighting,
    replay_identities,
)

FIRST = 100
"""Match frame of the clip's first."""


def identities():
    """Persons 0 and 1 follow each other; 2 is there all the time; two cameras, six frames."""
    index = np.full((6, 2, 3), -1, dtype=np.int16)
    index[:3, :, 0] = 0
    index[3:, :, 1] = 0
    index[:, :, 2] = 1
    distance = np.where(index >= 0, 0.1, np.nan).astype(np.float32)
    distance[1, 1, 0] = 0.01
    joints = np.full((6, 3, 17, 3), np.nan, dtype=np.float32)
    for person in range(3):
        joints[(index[:, :, person] >= 0).any(axis=1), person] = person
    join = Join(before=0, after=1, last_frame=2, first_frame=3, cost=1.0, margin=0.1, decided=False)
    return Identities(
        frame=np.arange(FIRST, FIRST + 6),
        cameras=("a", "b"),
        person=np.arange(3, dtype=np.int32),
        detection_index=index,
        ray_distance=distance,
        joints=joints,
        on_plane=np.zeros((6, 3), dtype=np.bool_),
        names={},
        joins=(join,),
    )


def merge(kept, merged, **seen):
    return MergedTracks(clip="clip", kept=kept, merged=merged, **seen)


def split(person, frame, **seen):
    return SplitTrack(clip="clip", person=person, first_frame_of_new=frame, **seen)


def same(a, b):
    return all(
        np.array_equal(
            getattr(a, name), getattr(b, name), equal_nan=name in ("ray_distance", "joints")
        )
        for name in ("person", "detection_index", "ray_distance", "joints", "on_plane")
    )


def test_a_merged_person_goes_on_as_the_kept_one():
    replay = replay_identities(identities(), [merge(0, 1)])
    after = replay.identities
    assert replay.objections == (None,)
    assert after.person.tolist() == [0, 2]
    assert (after.detection_index[:, :, 0] == 0).all()
    assert after.joints[:, 0, 0, 0].tolist() == [0, 0, 0, 1, 1, 1]
    assert [(track.first_frame, track.last_frame, track.views) for track in after.tracks] == [
        (0, 5, 2.0),
        (0, 5, 2.0),
    ]
    assert [(join.before, join.after, join.decided) for join in after.joins] == [(0, 0, True)]


def test_what_was_merged_wrongly_is_split_again():
    before = identities()
    after = replay_identities(before, [merge(0, 1), split(0, FIRST + 3)]).identities
    # The second half has a new id; it is the last now.
    order = [0, 2, 1]
    assert np.array_equal(after.detection_index[:, :, order], before.detection_index)
    assert np.array_equal(after.joints[:, order], before.joints, equal_nan=True)
    assert [(join.before, join.after) for join in after.joins] == [(0, 3)]


HERE = Sighting(camera="a", frame=FIRST, detection=0)


@pytest.mark.parametrize(
    ("edit", "reason"),
    [
        (merge(0, 9), "no person 9"),
        (merge(0, 0), "one person already"),
        (merge(0, 2), "side by side in 3 frames, the first is 100"),
        (merge(1, 0, kept_seen=HERE), "person 1 is not the person that was seen in a, frame 100"),
        (
            merge(1, 0, merged_seen=HERE.model_copy(update={"camera": "z"})),
            "is not the person that was seen",
        ),
        (split(0, FIRST), "not seen both before and from 100"),
        (split(0, FIRST + 3), "not seen both before and from 103"),
        (split(7, FIRST + 3), "no person 7"),
        (NamedTrack(clip="clip", person=1, seen=HERE, name="x"), "is not the person that was seen"),
    ],
)
def test_what_does_not_apply_says_why_and_changes_nothing(edit, reason):
    found = identities()
    replay = replay_identities(found, [edit])
    assert reason in replay.objections[0]
    assert replay.identities is found


def test_a_sighting_is_the_detection_that_fits_best():
    seen = find_sighting(identities(), 0)
    assert seen == Sighting(camera="b", frame=FIRST + 1, detection=0)
    assert replay_identities(identities(), [merge(0, 1, kept_seen=seen)]).objections == (None,)
    assert find_sighting(identities(), 0, first=FIRST + 3) is None


@given_that(
    st.lists(
        st.one_of(
            st.builds(merge, st.integers(0, 5), st.integers(0, 5)),
            st.builds(split, st.integers(0, 5), st.integers(FIRST, FIRST + 6)),
        ),
        max_size=8,
    )
)
def test_every_detection_stays_somebodys_and_replay_gives_the_same(edits):
    before = identities()
    replay = replay_identities(before, edits)
    after = replay.identities
    assert same(after, replay_identities(identities(), edits).identities)
    for frame in range(6):
        for camera in range(2):
            theirs = [sorted(x.detection_index[frame, camera].tolist()) for x in (before, after)]
            assert [n for n in theirs[0] if n >= 0] == [n for n in theirs[1] if n >= 0]
    assert len(set(after.person.tolist())) == len(after.person)
    assert all(track.frames_seen for track in after.tracks)


def mixed_identities():
    """As `identities`; person 0 stays by the feet for two frames, and 3 is on the plane alone."""
    index = np.full((6, 2, 2), -1, dtype=np.int16)
    index[3:5, 1, 0] = 4
    index[1:, 0, 1] = 5
    placed = (index >= 0).any(axis=1)
    return add_plane_tracks(identities(), index, placed, np.array([0, -1]))


def test_people_on_the_plane_are_added_and_triangulated_ones_continued():
    found, before = mixed_identities(), identities()
    assert found.person.tolist() == [0, 1, 2, 3]
    assert [track.kind for track in found.tracks] == [
        "mixed",
        "triangulated",
        "triangulated",
        "plane",
    ]
    assert [track.plane_frames for track in found.tracks] == [2, 0, 0, 5]
    assert (found.tracks[0].first_frame, found.tracks[0].last_frame) == (0, 4)
    np.testing.assert_array_equal(found.joints[:, :3], before.joints)
