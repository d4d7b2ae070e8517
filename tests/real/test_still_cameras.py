"""Labels of real stills, and cameras that are calibrated from them without a click."""

import cv2
import numpy as np
import pytest
from real_data import GIVEN, needs

from worldpose.pitch.template import PitchTemplate

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
