from pathlib import Path

import cv2
import numpy as np
import pytest

from worldpose.training.augmentation import AugmentationSettings
from worldpose.training.keypoint_training import (
    KeypointCrops,
    keypoint_batch,
)
from worldpose.training.labels import LabelledPicture, PictureCache

AS_IS = AugmentationSettings(strength=0, recoloured=0, grey=0, fog=0, soft=0, coded=0, grain=0)
NOSE, LEFT_EAR, RIGHT_EAR = 0, 3, 4


@pytest.fixture(scope="module")
def labelled(tmp_path_factory):
    """A grey image of one box of 60 x 120 px: a red left ear and a blue right one."""
    path: Path = tmp_path_factory.mktemp("pictures") / "a.png"
    picture = np.full((300, 400, 3), 60, dtype=np.uint8)
    left, right = (230, 120), (190, 150)
    cv2.circle(picture, left, 6, (0, 0, 255), -1)
    cv2.circle(picture, right, 6, (255, 0, 0), -1)
    cv2.imwrite(str(path), picture)
    keypoints = np.full((1, 17, 2), np.nan)
    keypoints[0, LEFT_EAR], keypoints[0, RIGHT_EAR] = left, right
    visible = np.where(np.isfinite(keypoints[..., 0]), 2, 0).astype(np.int8)
    box = np.array([[180.0, 90.0, 240.0, 210.0]])
    return LabelledPicture(path, box, keypoints, visible, np.array([False]))


def test_labels_lie_on_what_they_name_in_turned_mirrored_and_distant_crops(labelled):
    settings = KeypointCrops(
        crops=24, hidden=0, smaller=0.5, astray=0, elsewhere=0, turned=1, looks=AS_IS
    )
    batch = keypoint_batch([(labelled, 0)], PictureCache(), settings, np.random.default_rng(0))
    sides = set()
    for crop, keypoints in zip(batch.crops.astype(int), batch.keypoints, strict=True):
        red = crop[..., 0] - crop[..., 2]
        mirrored = _mirrored(keypoints)
        sides.add(mirrored)
        # In a mirror the left ear is a right one: the red dot then is labelled the right ear.
        is_red, is_blue = (RIGHT_EAR, LEFT_EAR) if mirrored else (LEFT_EAR, RIGHT_EAR)
        for joint, level in ((is_red, red), (is_blue, -red)):
            rows, columns = np.nonzero(level > 0.6 * level.max())
            middle = np.array([columns.mean(), rows.mean()])
            # A dot of 10 px seen in coarse pixels has its middle within half of one.
            assert np.linalg.norm(middle - keypoints[joint]) < 1.3
    assert sides == {True, False}


def _mirrored(keypoints):
    """Whether a crop is mirrored, by what is labelled left and right.

    As it is, the left ear is 40 px right of the right one and 30 px higher. In a mirror the blue
    dot is labelled left: 40 px right of the red one, 30 px lower. No turn comes to 37 degrees.
    """
    return bool(keypoints[LEFT_EAR, 1] > keypoints[RIGHT_EAR, 1])
