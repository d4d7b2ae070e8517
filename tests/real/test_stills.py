"""Labels of real stills, and the scores that benchmarks/stills.py takes of them."""

import sys
from pathlib import Path

import numpy as np
import pytest

from worldpose.detection.interfaces import People
from worldpose.training.labels import read_labels

sys.path.insert(0, str(Path(__file__).parents[2] / "benchmarks"))

import stills


@pytest.fixture(scope="module")
def labels():
    return read_labels(stills.LABELS)


def test_the_labels_cover_what_the_table_states(labels):
    assert {still.path.name for still in labels} == set(stills.STILLS)
    outlines = stills.pitch_outlines(stills.LABELS)
    assert set(outlines) == set(stills.STILLS)
    people = [still.boxes[~still.ignored] for still in labels]
    assert sum(map(len, people)) == 149
    joints = np.concatenate([still.visible for still in labels])
    assert (joints[:, :5] == 0).all()  # no face was labelled
    assert ((joints > 0).sum(axis=1) > 0).sum() == 74
    assert (joints == 2).sum() >= 690


def test_perfect_boxes_score_one_and_the_crowd_does_not_count_on_the_pitch(labels):
    outlines = stills.pitch_outlines(stills.LABELS)
    found = []
    for still in labels:
        real = still.boxes[~still.ignored]
        crowd = [[5.0, 1.0, 15.0, 20.0]] if outlines[still.path.name][:, 1].min() > 40 else []
        boxes = np.concatenate([real, np.array(crowd).reshape(-1, 4)])
        scores = np.concatenate([np.full(len(real), 0.9), np.full(len(crowd), 0.95)])
        found.append(People(boxes, scores))
    everywhere = stills.score_boxes(found, labels, 0.4)
    assert everywhere["recall"] == 1.0
    assert everywhere["precision"] < 1.0
    on_pitch = stills.score_boxes(*stills.keep_pitch(found, labels, outlines), 0.4)
    assert on_pitch == {"recall": 1.0, "precision": 1.0, "ap50": 1.0}
