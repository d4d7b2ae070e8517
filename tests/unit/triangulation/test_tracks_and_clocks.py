import numpy as np
from running_samples import FPS, detections, runner

from data_contracts.keypoints import KeypointDetections
from worldpose.triangulation.clocks import estimate_clocks, move_to_match_time
from worldpose.triangulation.estimate import reconstruct_joints, triangulate_joints
from worldpose.triangulation.settings import TriangulationSettings
from worldpose.triangulation.smoothing import smooth_joints

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
