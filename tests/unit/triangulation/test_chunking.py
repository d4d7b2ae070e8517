from dataclasses import replace

import numpy as np
import pytest
from running_samples import FPS, MIRRORED, detections, runner

from data_contracts.keypoints import KeypointDetections
from worldpose.triangulation.estimate import (
    MARGIN,
    learn_clip,
    reconstruct_chunks,
    reconstruct_joints,
)
from worldpose.triangulation.settings import TriangulationSettings

as_detections = KeypointDetections.from_keypoints

SETTINGS = TriangulationSettings()
FRAMES = 330


class Watched:
    """An array that records the largest number of frames read at once."""

    def __init__(self, values):
        self.values, self.shape, self.most = values, values.shape, 0

    def __getitem__(self, frames):
        read = self.values[frames]
        self.most = max(self.most, len(read))
        return read


@pytest.fixture
def clip(ring):
    """Cameras and arrays of two runners; one is unseen for a while, twice at a part's end."""
    camera = ring(4)
    keypoints, confidence, index = detections(camera, runner(FRAMES), 2.0)
    keypoints[100:150, 1, 0] = keypoints[100:150, 1, 0][:, MIRRORED]
    index[120:135, :, 1] = -1  # 0.3 s: filled
    index[230:270, :, 0] = -1  # 0.8 s: not filled
    index[300:, 2:, 0] = -1
    return camera, (keypoints, confidence, index)


def test_parts_give_what_the_whole_clip_gives(clip):
    camera, arrays = clip
    whole = reconstruct_joints(camera, as_detections(*arrays), FPS, SETTINGS)
    seen = as_detections(*arrays)
    model = learn_clip(camera, seen, FPS, SETTINGS)
    parts = list(reconstruct_chunks(camera, seen, model, FPS, SETTINGS, length=128))
    assert [(part.frames.start, part.frames.stop) for part in parts] == [
        (0, 128),
        (128, 256),
        (256, FRAMES),
    ]
    for name in ("joints", "covariance", "views", "spread", "inliers", "exchanged", "offsets"):
        joined = np.concatenate([getattr(part.triangulation, name) for part in parts])
        np.testing.assert_array_equal(joined, getattr(whole.triangulation, name))
    assert whole.triangulation.exchanged[100:150, 1, 0].any(axis=-1).all()
    smooth = np.concatenate([part.smoothing.joints for part in parts])
    # Iterations end at steps of 0.1 mm a coordinate, and not at the same one.
    np.testing.assert_allclose(smooth, whole.smoothing.joints, atol=2e-4)
    covariance = np.concatenate([part.smoothing.covariance for part in parts])
    scale = np.nanmax(whole.smoothing.covariance)
    np.testing.assert_allclose(covariance, whole.smoothing.covariance, atol=1e-2 * scale)
    filled = np.concatenate([part.smoothing.filled for part in parts])
    np.testing.assert_array_equal(filled, whole.smoothing.filled)
    assert filled.sum() == 15 * 17


def test_frames_that_are_farther_apart_share_less_of_their_errors(clip):
    camera, arrays = clip
    seen = as_detections(*arrays)
    model = learn_clip(camera, seen, FPS, SETTINGS)
    model = replace(model, motion=replace(model.motion, repeated=9.0))
    (part,) = reconstruct_chunks(camera, seen, model, FPS, SETTINGS, length=FRAMES, stride=4)
    assert part.smoothing.motion.repeated == 3.0


def test_no_more_than_a_part_and_its_margins_is_read_at_once(clip):
    camera, arrays = clip
    plain = as_detections(*arrays)
    watched = [Watched(values) for values in plain.arrays().values()]
    seen = KeypointDetections(*watched, detection_index=plain.detection_index)
    settings = SETTINGS.model_copy(update={"correct_clocks": True})
    model = learn_clip(camera, seen, FPS, settings)
    assert max(values.most for values in watched) <= MARGIN * FPS + 2
    for _ in reconstruct_chunks(camera, seen, model, FPS, settings, length=64):
        pass
    # 128 frames are the least that hold a margin of 100 in whole tiles of 64.
    assert max(values.most for values in watched) <= 128 + 2 * MARGIN * FPS + 2
