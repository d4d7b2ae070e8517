"""The same people as another ByteTrack's: needs the `trackers` package, which nothing else does."""

import numpy as np
import pytest
from scipy.optimize import linear_sum_assignment

from worldpose.detection.byte_track import BoxTracker


def scene(people=22, frames=200, seed=3):
    """Boxes, scores and who it is, frame by frame: players who cross, are missed and doubtful."""
    rng = np.random.default_rng(seed)
    place = rng.uniform([100.0, 300.0], [1800.0, 800.0], (people, 2))
    speed = rng.normal(0.0, 2.0, (people, 2))
    tall = rng.uniform(70.0, 110.0, people)
    for _ in range(frames):
        speed = 0.97 * speed + rng.normal(0.0, 0.4, (people, 2))
        place = place + speed
        seen = rng.random(people) > 0.1
        half = np.column_stack([0.18 * tall, 0.5 * tall])
        boxes = np.hstack([place - half, place + half]) + rng.normal(0.0, 1.5, (people, 4))
        scores = np.where(rng.random(people) < 0.15, 0.3, 0.9)
        yield boxes[seen], scores[seen], np.flatnonzero(seen)


def agreement(first, second):
    """Share of boxes that both put into tracks which correspond one to one."""
    both = np.zeros((first.max() + 1, second.max() + 1))
    known = (first >= 0) & (second >= 0)
    np.add.at(both, (first[known], second[known]), 1.0)
    pairs = linear_sum_assignment(-both)
    return both[pairs].sum() / known.sum(), known.mean()


def test_tracks_are_those_of_the_reference():
    trackers = pytest.importorskip("trackers")
    import supervision

    own = BoxTracker(high_score_threshold=0.4, track_buffer_frames=25)
    other = trackers.ByteTrackTracker(
        lost_track_buffer=25,
        frame_rate=30.0,
        track_activation_threshold=0.4,
        high_conf_det_threshold=0.4,
        minimum_consecutive_frames=1,
        minimum_iou_threshold=0.2,
    )
    mine, reference, truth = [], [], []
    for boxes, scores, who in scene():
        mine.append(own.follow(boxes, scores))
        given = supervision.Detections(
            xyxy=boxes, confidence=scores, data={"row": np.arange(len(boxes))}
        )
        found = other.update(given)
        ids = np.full(len(boxes), -1)
        ids[found.data["row"]] = found.tracker_id
        reference.append(ids)
        truth.append(who)
    mine, reference, truth = (np.concatenate(each) for each in (mine, reference, truth))
    same, shared = agreement(mine, reference)
    # All agree here; in other scenes two who cross may change names in one of the trackers. A
    # doubtful box must lie where its track is expected, by half here and by a fifth in the
    # reference, so that a fiftieth of all boxes is in no track.
    assert same > 0.95 and shared > 0.97
    # Against who it is, ours is as good as the reference; 0.02 are half a person's boxes.
    assert agreement(mine, truth)[0] >= agreement(reference, truth)[0] - 0.02
