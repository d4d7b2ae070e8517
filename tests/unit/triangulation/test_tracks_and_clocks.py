"""Tracks of joints over time: chunks, smoothing, and the clocks of cameras."""

from dataclasses import replace

import numpy as np
import pytest
from running_samples import FPS, MIRRORED, detections, runner

from data_contracts.keypoints import KeypointDetections
from worldpose.geometry.cameras import Camera
from worldpose.geometry.rigid import Rigid, Similarity
from worldpose.pitch.template import PitchTemplate
from worldpose.simulation.scenarios import SCENARIOS
from worldpose.simulation.scene import simulate_scene
from worldpose.triangulation.clocks import estimate_clocks, move_to_match_time
from worldpose.triangulation.estimate import (
    MARGIN,
    learn_clip,
    reconstruct_chunks,
    reconstruct_joints,
    triangulate_joints,
)
from worldpose.triangulation.samples import choose_intervals, sample_frames
from worldpose.triangulation.settings import TriangulationSettings
from worldpose.triangulation.smoothing import smooth_joints
from worldpose.triangulation.synchronization import synchronize
from worldpose.triangulation.world import move_cameras

as_detections = KeypointDetections.from_keypoints

SETTINGS = TriangulationSettings(common_bias_m=0.0, offsets="none")


def test_smoothing_is_nearer_and_steadier_than_single_frames(ring):
    camera, joints = ring(4), runner(100)
    arrays = detections(camera, joints, 2.0)
    raw = triangulate_joints(camera, as_detections(*arrays), SETTINGS)
    smooth = smooth_joints(camera, as_detections(*arrays), raw, FPS, SETTINGS)
    error = [np.linalg.norm(r.joints - joints, axis=-1).mean() for r in (raw, smooth)]
    jerk = [np.abs(np.diff(r.joints - joints, 2, axis=0)).mean() for r in (raw, smooth)]
    # White noise at 50 frames/s and swings of 2 Hz: several frames count as one.
    assert error[1] < 0.7 * error[0]
    assert jerk[1] < 0.1 * jerk[0]
    assert not smooth.filled.any()
    squared = np.einsum(
        "...i,...ij,...j->...",
        smooth.joints - joints,
        np.linalg.inv(smooth.covariance),
        smooth.joints - joints,
    )
    # Regions of 95 %; usual accelerations come in steps of two, which leaves them up to a third
    # too wide.
    assert (squared < 7.815).mean() > 0.93


def test_short_gaps_are_filled_and_marked_and_long_ones_left(ring):
    camera, joints = ring(4), runner(100, 1)
    keypoints, confidence, index = detections(camera, joints, 1.0)
    index[20:30, 1:] = -1  # one view
    index[50:90] = -1  # 0.8 s without any
    raw = triangulate_joints(camera, as_detections(keypoints, confidence, index), SETTINGS)
    smooth = smooth_joints(camera, as_detections(keypoints, confidence, index), raw, FPS, SETTINGS)
    assert np.isnan(raw.joints[20:30]).all()
    assert smooth.filled[20:30].all()
    assert smooth.filled.sum() == 10 * 17
    assert np.isnan(smooth.joints[50:90]).all()
    # Limbs that swing by 15 cm, over 0.2 s seen by one camera.
    assert np.linalg.norm(smooth.joints[20:30] - joints[20:30], axis=-1).max() < 0.15
    size = np.trace(smooth.covariance, axis1=-2, axis2=-1)
    assert (size[25] > size[15]).all()
    assert smooth.report.filled == 170


def late_detections(camera, frames, late, noise=1.0, seed=0):
    """Return the views of cameras whose frame t shows the time t + late."""
    views = [
        detections(camera[c : c + 1], runner_at(np.arange(frames) + d), noise, seed=seed + c)
        for c, d in enumerate(late)
    ]
    return [np.concatenate([view[k] for view in views], axis=1) for k in range(3)]


def runner_at(frames):
    whole = runner(2000, 3)
    at = np.asarray(frames) + 500.0
    low = np.floor(at).astype(int)
    share = (at - low)[:, None, None, None]
    return (1.0 - share) * whole[low] + share * whole[low + 1]


def test_late_clocks_are_found(ring):
    late = np.array([0.0, 3.0, -3.0, 0.5, -0.5, 1.0])
    camera = ring(6)
    arrays = late_detections(camera, 100, late)
    clocks = estimate_clocks(camera, as_detections(*arrays), FPS, SETTINGS)
    assert clocks.determined.all()
    np.testing.assert_allclose(clocks.late, late - late.mean(), atol=0.1)
    corrected = SETTINGS.model_copy(update={"correct_clocks": True})
    result = reconstruct_joints(camera, as_detections(*arrays), FPS, corrected)
    plain = reconstruct_joints(camera, as_detections(*arrays), FPS, SETTINGS)
    assert (
        result.triangulation.report.reprojection_error_px
        < 0.7 * plain.triangulation.report.reprojection_error_px
    )


def test_clocks_are_unknown_where_nobody_is_seen_by_two_cameras(ring):
    keypoints, confidence, index = late_detections(ring(3), 100, np.zeros(3))
    index[:, 1:] = -1
    clocks = estimate_clocks(ring(3), as_detections(keypoints, confidence, index), FPS, SETTINGS)
    assert not clocks.determined.any()
    assert clocks.standard_error.min() > 5.0


def test_samples_are_of_frames_with_people_and_of_each_person():
    there = np.zeros((9000, 70), bool)
    there[3000:, :30] = True
    for visitor in range(40):
        there[3000 + 90 * visitor : 3010 + 90 * visitor, 30 + visitor] = True
    chosen = sample_frames(there, 17)
    assert there[chosen].sum(axis=0).min() >= 5
    assert there[chosen].any(axis=1).all()
    assert len(chosen) <= 512
    assert min(part.start for part in choose_intervals(there, 25)) >= 2975


def test_keypoints_move_along_the_persons_path_to_the_match_frame():
    # A person at x = 10 t px; the frames show the times 0, 1.25, 2 and 2.75, the last one alone.
    late = np.array([[0.0], [0.25], [0.0], [-0.25]])
    pixels = np.zeros((4, 1, 2, 1, 2))
    pixels[:, 0, 1, 0, 0] = 10.0 * (np.arange(4) + late[:, 0])
    index = np.array([1, 1, 1, 1]).reshape(4, 1, 1)
    moved = move_to_match_time(pixels, index, late)
    np.testing.assert_allclose(moved[:, 0, 1, 0, 0], [0.0, 10.0, 20.0, 30.0])
    assert not moved[:, 0, 0].any()
    alone = move_to_match_time(pixels, np.array([-1, 1, -1, -1]).reshape(4, 1, 1), late)
    np.testing.assert_array_equal(alone, pixels)


LATE = np.array([-12.0, -3.5, 0.0, 2.25, 20.0])
"""Offset of each camera [frame]: its frame t shows the time t + offset."""
FINE = 4
"""Simulated frames per frame: fractions of a frame are exact."""
SYNC_FPS = 25.0
SYNC_FRAMES, BEFORE = 70, 15


@pytest.fixture(scope="module")
def scene():
    """Five people before five cameras, simulated at 100 frames per second."""
    tiny = SCENARIOS["tiny"]
    rig = tiny.rig.model_copy(update={"cameras": len(LATE)})
    seconds = (SYNC_FRAMES + BEFORE + 25) / SYNC_FPS
    changes = {"fps": FINE * SYNC_FPS, "duration": seconds, "rig": rig, "broadcast": ()}
    return simulate_scene(tiny.model_copy(update=changes), 4)


@pytest.fixture(scope="module")
def pitch():
    return PitchTemplate.from_spec(SCENARIOS["tiny"].pitch)


def with_rows(detections, rows):
    """Detections whose frame t of camera c is row rows[t, c]."""
    cameras = np.arange(rows.shape[1])
    arrays = {name: array[rows, cameras] for name, array in detections.arrays().items()}
    return KeypointDetections(frame=np.arange(len(rows)), **arrays)


def shifted(scene, late=LATE):
    rows = FINE * (np.arange(SYNC_FRAMES)[:, None] + BEFORE + late)
    return with_rows(scene.static_views().detections, np.rint(rows).astype(int))


def turned(scene, angle):
    """The cameras with an error of the calibration [rad]."""
    rng = np.random.default_rng(2)
    still = np.zeros(3)
    cameras = []
    for camera in scene.cameras.values():
        error = Rigid.from_rotvec(rng.normal(0.0, angle, 3), still)
        pose = camera.cam_from_world
        cameras.append(replace(camera, cam_from_world=error @ pose))
    return Camera.stack(cameras)


def errors(found, late=LATE):
    off = found.late - late
    return off - np.nanmedian(off)


def test_offsets_are_found_without_a_hint_and_with_wrong_cameras(scene, pitch):
    angle = 1e-3
    found = synchronize(turned(scene, angle), shifted(scene), SYNC_FPS, pitch=pitch)
    assert found.reasons == ("",) * 5
    assert np.abs(errors(found)).max() < 0.2
    assert (found.std < 0.1).all()
    peaks = found.shifts[found.matches.argmax(axis=1)]
    assert np.abs(peaks - found.late).max() < 4.0


@pytest.mark.parametrize("seed", [1, 8])  # chance makes one shift in 200 stand out most
def test_where_nothing_moves_no_offset_is_told(scene, pitch, seed):
    noise = 2.0
    still = with_rows(scene.static_views().detections, np.full((SYNC_FRAMES, 5), 60))
    rng = np.random.default_rng(seed)
    moved = still.keypoints + rng.normal(0.0, noise, still.keypoints.shape)
    found = synchronize(turned(scene, 0.0), replace(still, keypoints=moved), SYNC_FPS, pitch=pitch)
    assert np.isnan(found.late).all()
    assert np.isinf(found.std).all()
    assert all(found.reasons)


def test_a_camera_that_shows_other_people_has_no_offset(scene, pitch):
    seen = shifted(scene)
    alone = seen.keypoints.copy()
    alone[:, 3] = alone[::-1, 3] * [-1.0, 1.0] + [1900.0, 0.0]
    found = synchronize(turned(scene, 0.0), replace(seen, keypoints=alone), SYNC_FPS, pitch=pitch)
    assert np.isnan(found.late[3])
    assert found.reasons[3]
    rest = np.array([0, 1, 2, 4])
    assert np.abs(errors(found)[rest]).max() < 0.2


def test_groups_that_share_no_person_have_offsets_of_their_own(scene):
    cameras, seen = turned(scene, 0.0), shifted(scene)
    other = {name: array[::-1] for name, array in seen.arrays().items()}
    arrays = {
        name: np.concatenate([array[:, :3], other[name][:, [0, 3, 4]]], axis=1)
        for name, array in seen.arrays().items()
    }
    away = cameras[np.array([0, 3, 4])]
    away = move_cameras(Similarity(np.array(1.0), np.eye(3), np.array([300.0, 0.0, 0.0])), away)
    both = Camera.stack([*(cameras[c] for c in range(3)), *(away[c] for c in range(3))])
    found = synchronize(both, seen.with_arrays(arrays, seen.frame), SYNC_FPS)
    assert found.groups == ((0, 1, 2), (3, 4, 5))
    off = found.late[:3] - LATE[:3]
    assert np.abs(off - np.median(off)).max() < 0.3
    reversed_late = -LATE[[0, 3, 4]]
    off = found.late[3:] - reversed_late
    assert np.abs(off - np.median(off)).max() < 0.3


CHUNK_SETTINGS = TriangulationSettings()
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
    whole = reconstruct_joints(camera, as_detections(*arrays), FPS, CHUNK_SETTINGS)
    seen = as_detections(*arrays)
    model = learn_clip(camera, seen, FPS, CHUNK_SETTINGS)
    parts = list(reconstruct_chunks(camera, seen, model, FPS, CHUNK_SETTINGS, length=128))
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
    model = learn_clip(camera, seen, FPS, CHUNK_SETTINGS)
    model = replace(model, motion=replace(model.motion, repeated=9.0))
    (part,) = reconstruct_chunks(camera, seen, model, FPS, CHUNK_SETTINGS, length=FRAMES, stride=4)
    assert part.smoothing.motion.repeated == 3.0


def test_no_more_than_a_part_and_its_margins_is_read_at_once(clip):
    camera, arrays = clip
    plain = as_detections(*arrays)
    watched = [Watched(values) for values in plain.arrays().values()]
    seen = KeypointDetections(*watched, detection_index=plain.detection_index)
    settings = CHUNK_SETTINGS.model_copy(update={"correct_clocks": True})
    model = learn_clip(camera, seen, FPS, settings)
    assert max(values.most for values in watched) <= MARGIN * FPS + 2
    for _ in reconstruct_chunks(camera, seen, model, FPS, settings, length=64):
        pass
    # 128 frames are the least that hold a margin of 100 in whole tiles of 64.
    assert max(values.most for values in watched) <= 128 + 2 * MARGIN * FPS + 2
