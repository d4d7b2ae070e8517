"""Labels of real stills, and cameras that are calibrated from them without a click."""

import sys
from pathlib import Path

import cv2
import numpy as np
import pytest
import stills
from real_data import GIVEN, needs

from worldpose.pitch.template import PitchTemplate
from worldpose.training.labels import read_labels

DATA = GIVEN / "still_cameras"
MIDFIELD, AREA = "che0", "var9"


@pytest.fixture(scope="module")
def bench():
    import real_cameras  # late: it loads the simulators

    return real_cameras


def test_labels_name_markings_and_lie_in_their_images(bench):
    stills, names = bench.read_labels(), set(PitchTemplate.standard().marking_names)
    assert len(stills) >= 60
    assert len({still["camera"] for still in stills}) >= 30
    assert len({still["name"] for still in stills}) == len(stills)
    halves = [{still["camera"] for still in bench.read_labels(half)} for half in ("tuned", "held")]
    assert not halves[0] & halves[1]
    for still in stills:
        assert len(still["markings"]) >= 2
        assert set(still["markings"]) | set(still["unsure"]) <= names
        pixels = np.concatenate([np.array(each) for each in still["markings"].values()])
        assert (pixels > -2.0).all()  # ends at the border
        assert (pixels < np.array(still["size"]) + 1.0).all()


@needs("still_cameras")
@pytest.mark.parametrize("name", [MIDFIELD, pytest.param(AREA, marks=pytest.mark.slow)])
def test_a_real_still_is_calibrated_without_a_click(bench, name):
    (still,) = bench.read_labels(only=[name])
    picture = cv2.imread(str(DATA / f"{name}.png"))
    score = bench.score_still(np.ascontiguousarray(picture[..., ::-1]), still)
    assert score.accepted
    assert score.jaccard[0] == 1.0


sys.path.insert(0, str(Path(__file__).parents[2] / "benchmarks"))


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
