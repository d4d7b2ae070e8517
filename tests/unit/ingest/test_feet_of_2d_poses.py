"""Heels and toes of 2D poses are kept beside the 17 keypoints: in memory, files and a store."""

import numpy as np
import pytest
from test_pose2sim_import import person, write_frame

from data_contracts.conventions import FEET
from data_contracts.keypoints import KeypointDetections
from worldpose.errors import InputError
from worldpose.formats.detection_files import read_openpose_folder
from worldpose.formats.keypoint_files import read_keypoint_arrays, write_keypoint_arrays

PLACES = {
    25: (19, 20, 21, 22, 23, 24),
    26: (20, 22, 24, 21, 23, 25),
    133: (17, 18, 19, 20, 21, 22),
    136: (20, 22, 24, 21, 23, 25),
}
"""Left and right big toe, small toe and heel in the published orders."""


def people(frames=3, detections=2, points=FEET, seed=0):
    rng = np.random.default_rng(seed)
    shape = (frames, detections)
    corner = rng.uniform(0, 100, (*shape, 2))
    return KeypointDetections(
        keypoints=rng.uniform(100, 900, (*shape, 17, 2)).astype(np.float32),
        confidence=rng.uniform(0.1, 1.0, (*shape, 17)).astype(np.float32),
        boxes=np.concatenate([corner, corner + 900], axis=-1).astype(np.float32),
        score=rng.uniform(0.1, 1.0, shape).astype(np.float32),
        frame=np.arange(4, 4 + frames),
        points=points,
        extra_keypoints=rng.uniform(100, 900, (*shape, len(points), 2)).astype(np.float32),
        extra_confidence=rng.uniform(0.1, 1.0, (*shape, len(points))).astype(np.float32),
    )


@pytest.mark.parametrize(("size", "places"), PLACES.items())
def test_every_set_with_feet_gives_them_in_one_order(tmp_path, size, places):
    values, _ = person(size, 3)
    values[places[4]] = 0.0  # the right small toe, missing
    write_frame(tmp_path / "a_json", 7, [values])
    found = read_openpose_folder(tmp_path / "a_json").people
    assert found.points == FEET
    seen = np.arange(6) != 4
    wanted = values[list(places)]
    np.testing.assert_allclose(found.extra_keypoints[0, 0, seen], wanted[seen, :2], rtol=1e-6)
    np.testing.assert_allclose(found.extra_confidence[0, 0, seen], wanted[seen, 2], rtol=1e-6)
    assert np.isnan(found.extra_keypoints[0, 0, 4]).all()
    assert np.isnan(found.extra_confidence[0, 0, 4])
    # Box and score are those of COCO-17, as without feet.
    body = found.keypoints[0, 0]
    np.testing.assert_array_equal(found.boxes[0, 0], [*body.min(axis=0), *body.max(axis=0)])


def broken(given, fault):
    extra, sure = given.extra_keypoints.copy(), given.extra_confidence.copy()
    if fault == "lone":
        sure[0, 0, 0] = np.nan
    if fault == "large":
        sure[0, 0, 0] = 1.5
    if fault == "far":
        extra[0, 0, 0] = 1e7
    return given.add_points(("nose",) * 6 if fault == "named" else given.points, extra, sure)


@pytest.mark.parametrize(
    ("fault", "word"),
    [
        ("lone", "extra_keypoints"),
        ("large", "extra_confidence"),
        ("far", "pixels up to"),
        ("named", "none of COCO-17"),
    ],
)
def test_a_wrong_file_is_refused_with_its_place(tmp_path, fault, word):
    write_keypoint_arrays(tmp_path / "a.npz", broken(people(), fault))
    with pytest.raises(InputError, match=word):
        read_keypoint_arrays(tmp_path / "a.npz")
