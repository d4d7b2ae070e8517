from functools import reduce
from operator import add

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
from worldpose.triangulation.report import Histogram
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


def test_every_third_frame_alone(clip):
    camera, arrays = clip
    seen = as_detections(*arrays)
    model = learn_clip(camera, seen, FPS, SETTINGS)
    every = list(reconstruct_chunks(camera, seen, model, FPS, SETTINGS))
    third = list(reconstruct_chunks(camera, seen, model, FPS, SETTINGS, length=64, stride=3))
    assert len(third) == 2 and third[-1].frames.stop == len(range(0, FRAMES, 3))
    for name in ("joints", "covariance", "views", "inliers", "exchanged", "offsets"):
        whole = np.concatenate([getattr(part.triangulation, name) for part in every])
        found = np.concatenate([getattr(part.triangulation, name) for part in third])
        # Joints of a tile of the solver share their number of steps.
        np.testing.assert_allclose(found, whole[::3], rtol=1e-6, atol=1e-8)
    late = [part.smoothing.filled.sum() for part in third]
    assert sum(late) == 5 * 17  # the gap of 0.3 s, and not that of 0.8 s


def test_frames_of_a_match_share_the_maximum():
    settings = TriangulationSettings(max_frames=1000)
    assert [settings.stride(frames) for frames in (1, 1000, 1001, 3000, 30_000)] == [1, 1, 2, 3, 30]


def test_reports_of_parts_add_up_to_the_clip_s(clip):
    camera, arrays = clip
    whole = reconstruct_joints(camera, as_detections(*arrays), FPS, SETTINGS)
    seen = as_detections(*arrays)
    model = learn_clip(camera, seen, FPS, SETTINGS)
    parts = list(reconstruct_chunks(camera, seen, model, FPS, SETTINGS, length=128))
    agreement = reduce(add, [part.triangulation.agreement for part in parts])
    assert agreement.report(whole.triangulation.noise.factor) == whole.triangulation.report
    changes = reduce(add, [part.smoothing.changes for part in parts])
    report = changes.report(model.motion.acceleration, model.motion.repeated)
    assert report.filled == whole.smoothing.report.filled
    # A class of the histogram is half a percent wide.
    assert report.moved_m == pytest.approx(whole.smoothing.report.moved_m, rel=0.011)


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


def test_clip_without_frames_or_people_has_one_empty_part(ring):
    camera = ring(3)
    for frames, persons in ((0, 2), (5, 0)):
        keypoints, confidence, index = detections(camera, runner(5), 1.0)
        arrays = keypoints[:frames], confidence[:frames], index[:frames, :, :persons]
        seen = as_detections(*arrays)
        model = learn_clip(camera, seen, FPS, SETTINGS)
        (part,) = reconstruct_chunks(camera, seen, model, FPS, SETTINGS)
        assert part.smoothing.joints.shape == (frames, persons, 17, 3)


def test_histograms_know_medians_to_half_a_percent():
    values = np.random.default_rng(0).lognormal(-3.0, 1.0, (501, 2))
    added = Histogram.of(values[:, 0]) + Histogram.of(values[:, 1])
    assert added.median == pytest.approx(np.median(values), rel=0.006)
    assert Histogram.of(np.zeros(3)).median == 0.0
    assert Histogram.of(np.empty(0)).median is None
