"""Cameras of real stills without a click; skipped where the stills are absent.

WORLDPOSE_TEST_DATA names a folder with `still_cameras` (run.py still_cameras --fetch).
"""

import os
from pathlib import Path

import cv2
import numpy as np
import pytest
from camera_builders import plain_camera

from worldpose.geometry.rigid import Rigid
from worldpose.pitch.template import PitchTemplate

DATA = Path(os.environ.get("WORLDPOSE_TEST_DATA", "absent")) / "still_cameras"
MIDFIELD, AREA = "che0", "var9"


@pytest.fixture(scope="module")
def bench():
    import real_cameras  # late: it loads the simulators

    return real_cameras


def overhead():
    """A camera 60 m above the centre spot, 10 px per metre; x to the right, y up."""
    return plain_camera(
        600.0,
        (599.5, 399.5),
        Rigid(np.diag([1.0, -1.0, -1.0]), np.array([0.0, 0.0, 60.0])),
        (1200, 800),
    )


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


def test_jaccard_counts_right_wrong_and_unlabelled_markings(bench):
    camera, pitch = overhead(), PitchTemplate.standard().with_surface(np.zeros(2))
    seen = bench.project_markings(camera, pitch)
    right = {
        name: line[np.isfinite(line).all(axis=1)][::20].tolist() for name, line in seen.items()
    }
    assert bench.compare(camera, pitch, {"markings": right})[0].tolist() == [1.0, 1.0, 1.0]
    # 9.6 px of 1200 are 7.7 of 960: wrong at 5 px, right at 10.
    moved = [[x + 9.6, y] for x, y in right["halfway_line"]]
    shares, bad = bench.compare(camera, pitch, {"markings": {**right, "halfway_line": moved}})
    assert shares[0] == pytest.approx(1.0 - 1.0 / len(right))
    assert shares[1:].tolist() == [1.0, 1.0]
    assert bad == ["halfway_line 8 px"]
    fewer = {name: line for name, line in right.items() if name != "center_circle"}
    shares, bad = bench.compare(camera, pitch, {"markings": fewer})
    assert shares[0] == pytest.approx(1.0 - 1.0 / len(right))
    assert bad == ["center_circle is not there"]
    unsure = {"markings": fewer, "unsure": ["center_circle"]}
    assert bench.compare(camera, pitch, unsure)[0][0] == 1.0


@pytest.mark.skipif(not DATA.is_dir(), reason="WORLDPOSE_TEST_DATA has no still_cameras")
@pytest.mark.parametrize("name", [MIDFIELD, AREA])
def test_a_real_still_is_calibrated_without_a_click(bench, name):
    (still,) = bench.read_labels(only=[name])
    picture = cv2.imread(str(DATA / f"{name}.png"))
    score = bench.score_still(np.ascontiguousarray(picture[..., ::-1]), still)
    assert score.accepted
    assert score.jaccard[0] == 1.0
