"""Labels of real stills, and the scores that benchmarks/stills.py takes of them."""

import sys
from pathlib import Path

import numpy as np
import pytest

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
