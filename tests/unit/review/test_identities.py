"""Corrections of identities, and what other views say about a keypoint."""

from dataclasses import replace

import numpy as np
import pytest
from camera_builders import look_at_camera
from hypothesis import example, given, settings
from hypothesis import strategies as st

from data_contracts.review import MergedTracks, NamedTrack, Sighting, SplitTrack
from data_contracts.tracking import Join
from worldpose.geometry.cameras import Camera
from worldpose.review.evidence import check_views, epipolar_curves
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
    assert (replay.objections, after.person.tolist()) == ((None,), [0, 2])
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
        (merge(0, 2), "side by side in 3 frames, the first is frame 100"),
        (merge(1, 0, kept_seen=HERE), "person 1 is not the person that was seen in a, frame 100"),
        (merge(1, 0, merged_seen=HERE.model_copy(update={"camera": "z"})), "is not the person"),
        (split(0, FIRST), "person 0 (kane) is not seen both before and from frame 100"),
        (split(0, FIRST + 3), "not seen both before and from frame 103"),
        (split(7, FIRST + 3), "no person 7"),
        (NamedTrack(clip="clip", person=1, seen=HERE, name="x"), "is not the person that was seen"),
    ],
)
def test_what_does_not_apply_says_why_and_changes_nothing(edit, reason):
    found = replace(identities(), names={0: "kane"})
    replay = replay_identities(found, [edit])
    assert reason in replay.objections[0]
    assert replay.identities is found


def test_a_sighting_is_the_detection_that_fits_best():
    seen = find_sighting(identities(), 0)
    assert seen == Sighting(camera="b", frame=FIRST + 1, detection=0)
    assert replay_identities(identities(), [merge(0, 1, kept_seen=seen)]).objections == (None,)
    assert find_sighting(identities(), 0, first=FIRST + 3) is None


@given(
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


def test_people_on_the_plane_are_added_and_triangulated_ones_continued():
    """Person 0 stays by the feet for two frames, and 3 is on the plane alone."""
    before, index = identities(), np.full((6, 2, 2), -1, dtype=np.int16)
    index[3:5, 1, 0], index[1:, 0, 1] = 4, 5
    found = add_plane_tracks(before, index, (index >= 0).any(axis=1), np.array([0, -1]))
    assert found.person.tolist() == [0, 1, 2, 3]
    told = [(track.kind, track.plane_frames) for track in found.tracks]
    assert told == [("mixed", 2), ("triangulated", 0), ("triangulated", 0), ("plane", 5)]
    assert (found.tracks[0].first_frame, found.tracks[0].last_frame) == (0, 4)
    np.testing.assert_array_equal(found.joints[:, :3], before.joints)


SIZE = np.array([1920, 1080])


PLACES = ((-40.0, -50.0, 12.0), (45.0, -48.0, 15.0), (-30.0, 52.0, 10.0), (60.0, 10.0, 20.0))
LENS = (-0.25, 0.08, 1e-3, -5e-4, 0.0)
CAMERAS = [
    look_at_camera(at, (0.0, 0.0, 1.0), (1800.0, 1801.8), middle=(955.0, 545.0), lens=LENS)
    for at in PLACES
]


def distance_to_polylines(place, lines):
    """From a place to the nearest point of polylines [px]."""
    best = np.inf
    for line in lines:
        begin, step = line[:-1], np.diff(line, axis=0)
        along = np.einsum("ni,ni->n", place - begin, step) / np.einsum("ni,ni->n", step, step)
        nearest = begin + np.clip(along, 0, 1)[:, None] * step
        best = min(best, np.linalg.norm(nearest - place, axis=1).min())
    return best


@given(
    x=st.floats(-20, 20), y=st.floats(-15, 15), z=st.floats(0, 2.5), pair=st.permutations(range(4))
)
@example(x=11.0, y=11.0, z=2.203125, pair=[0, 3, 2, 1])  # 5 px from the border
@settings(max_examples=30)
def test_what_a_pixel_may_show_lies_on_its_curve_in_the_other_picture(x, y, z, pair):
    source, target = CAMERAS[pair[0]], CAMERAS[pair[1]]
    point = np.array([x, y, z])
    (pixel,), (truth,) = source.project(point[None]), target.project(point[None])
    lines = epipolar_curves(source, target, pixel)
    # Points all along the ray where joints can be, projected one by one, are on the polyline.
    ray = source.unproject(pixel[None])
    heights = np.linspace(-0.25, 3.1, 40)
    along = (heights - ray.origins[0, 2]) / ray.directions[0, 2]
    places = target.project(ray.origins[0] + along[:, None] * ray.directions[0])
    inside = ((places > 0) & (places < SIZE - 1)).all(axis=1)
    assert (truth > 0).all() and (truth < SIZE - 1).all()
    for place in [truth, *places[inside]]:
        # An arc of 12 px bent by this lens is 0.01 px from its chord.
        assert distance_to_polylines(place, lines) < 0.02
    for line in lines:
        assert (line >= -0.5).all() and (line <= SIZE - 0.5).all()
        assert np.linalg.norm(np.diff(line, axis=0), axis=1).max() <= 12.0


@pytest.fixture
def person():
    return np.random.default_rng(3).uniform([-1, -1, 0], [1, 1, 2], (17, 3))


def test_a_wrong_keypoint_is_expected_where_it_belongs_and_put_there_all_views_agree(person):
    rig = Camera.stack(CAMERAS)
    truth = rig.project(np.broadcast_to(person, (4, 17, 3)))
    wrong = truth.copy()
    wrong[1, 9] += (14.0, -6.0)
    check = check_views(rig, wrong)
    np.testing.assert_allclose(check.expected[1, 9], truth[1, 9], atol=1e-3)
    assert check.error[1, 9] > 5.0
    assert np.delete(check.error, 9, axis=1).max() < 1e-3
    wrong[1, 9] = check.expected[1, 9]
    assert check_views(rig, wrong).error.max() < 1e-2


def test_a_joint_that_one_camera_sees_alone_is_expected_nowhere(person):
    rig = Camera.stack(CAMERAS)
    keypoints = rig.project(np.broadcast_to(person, (4, 17, 3)))
    keypoints[1:, 0] = np.nan
    keypoints[2:, 1] = np.nan
    check = check_views(rig, keypoints)
    assert np.isnan(check.joints[0]).all() and np.isnan(check.expected[:, 0]).all()
    assert np.isnan(check.error[:, 0]).all()
    assert np.isfinite(check.joints[1]).all() and np.isnan(check.expected[:2, 1]).all()
    assert np.isfinite(check.expected[2:, 1]).all()  # those two are expected to show it
    assert np.isnan(check.error[2:, 1]).all()
