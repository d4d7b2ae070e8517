"""What stages get of a clip: corrections applied, errors taken off, times as measured."""

from contextlib import nullcontext
from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pytest
import xarray as xr
from camera_builders import look_at_camera

from data_contracts.keypoints import KeypointDetections
from data_contracts.triangulation import CameraChange
from tasks import clip_inputs, filtering, refitting
from tasks.clip_inputs import PAGE, StoredFeedback, open_detections
from worldpose.body_fitting.monocular import MonocularEstimates
from worldpose.body_fitting.pose_space import GATHER
from worldpose.detection.interfaces import ScoreMap
from worldpose.filtering.redetection import MissingPeople
from worldpose.geometry.cameras import Camera, camera_arrays
from worldpose.geometry.rigid import Rigid
from worldpose.ingest.clock import ImageClock, camera_frames

DIMS = {
    "keypoints": ("detection", "joint", "axis"),
    "confidence": ("detection", "joint"),
    "boxes": ("detection", "corner"),
    "score": ("detection",),
}
SIZES = {"joint": 17, "axis": 2, "corner": 4}


def array(values, *dims):
    return xr.DataArray(values, dims=("frame", *dims))


def camera(frames, count, rng):
    shapes = {name: [count if d == "detection" else SIZES[d] for d in DIMS[name]] for name in DIMS}
    return xr.Dataset(
        {
            name: array(rng.random((frames, *shape), dtype=np.float32), *DIMS[name])
            for name, shape in shapes.items()
        }
    )


def test_rejected_keypoints_are_gone_and_lasting_errors_taken_off():
    frames = PAGE + 3  # over the border of a page
    rng = np.random.default_rng(0)
    cameras = [camera(frames, count, rng) for count in (2, 1)]
    filtering = xr.Dataset(
        {
            "rejected": array(rng.random((frames, 2, 2, 17)) < 0.1, "camera", "detection", "joint"),
            "shift": array(
                rng.random((frames, 2, 2, 17, 2), dtype=np.float32),
                *("camera", "detection", "joint", "axis"),
            ),
        }
    )
    frame = np.arange(frames)
    plain = open_detections(cameras, frame, StoredFeedback(cameras))[5:frames]
    taken = open_detections(cameras, frame, StoredFeedback(cameras, filtering))[5:frames]
    rejected, shift = filtering["rejected"].values[5:], filtering["shift"].values[5:]
    assert np.isnan(taken.keypoints[rejected]).all() and np.isnan(taken.confidence[rejected]).all()
    kept = ~rejected & np.isfinite(plain.confidence)
    moved = plain.keypoints[kept] - taken.keypoints[kept]
    np.testing.assert_allclose(moved, shift[kept], atol=1e-6)
    np.testing.assert_array_equal(taken.boxes, plain.boxes)
    assert kept[:, 1, 0].any() and not kept[:, 1, 1].any()


def test_who_was_looked_for_again_is_taken_as_he_was_found_this_time():
    # One detection in each of two frames; then a redetected person in the second.
    one = camera(2, 2, np.random.default_rng(1))
    one["keypoints"][:] = 100.0
    one["keypoints"][0, 1] = np.nan
    one["found_again"] = array(np.array([[-1, -1], [-1, 7]]), "detection")
    one["shift"] = 0.0 * one["keypoints"].fillna(0.0)
    one["shift"][:, 1] = 2.0
    # The iteration before had three places, and of the last two says what it said of others.
    rejected = array(np.ones((2, 1, 3, 17), dtype=bool), "camera", "detection", "joint")
    rejected[:, :, 0] = False
    shift = array(np.full((2, 1, 3, 17, 2), 5.0), "camera", "detection", "joint", "axis")
    filtering = xr.Dataset({"rejected": rejected, "shift": shift})

    def read(feedback):
        return open_detections([one], np.arange(2), feedback)[0:2].keypoints

    taken = read(StoredFeedback([one], filtering))
    assert taken.shape == (2, 1, 2, 17, 2)
    np.testing.assert_array_equal(taken[:, 0, 0], 95.0)
    assert np.isnan(taken[0, 0, 1]).all()
    np.testing.assert_array_equal(taken[1, 0, 1], 98.0)
    detected = read(StoredFeedback([one], redetected=False))
    np.testing.assert_array_equal(detected[:, 0, 0], 100.0)
    assert np.isnan(detected[:, 0, 1]).all()


class Results(dict):
    """Results by name, of one camera."""

    sources = {"cameras": ["cam"], "camera": "cam"}

    def open(self, name):
        return self[name]


def test_clips_that_overlap_are_each_corrected_by_their_own_changes(monkeypatch):
    camera = Camera.stack([look_at_camera((0.0, -20.0, 5.0), (0.0, 0.0, 0.0), 1500.0)])
    monkeypatch.setattr(clip_inputs, "_load_cameras", lambda *_: (camera, None, None))
    frames = {"a": np.arange(0, 6), "b": np.arange(3, 9)}
    stored = Results()
    for clip, frame in frames.items():
        given = {"first_frame": frame[0], "frame_count": 6, "shift_px": (40.0, 0.0), "std": 0.1}
        change = CameraChange(camera="cam", kind="view", frame=4, **given)
        stored[f"tracking/{clip}"] = SimpleNamespace(attrs={"changes": [change.model_dump()]})
    correct = clip_inputs._view_corrector(stored, frames)
    middle = np.asarray(camera.principal_point[0], np.float32)
    seen = np.tile(middle, (12, 1, 1, 1, 1))
    moved = (correct(seen, slice(0, 12)) - seen)[:, 0, 0, 0, 0]
    knocked = np.concatenate(list(frames.values())) >= 4
    np.testing.assert_allclose(moved, -40.0 * knocked, atol=0.1)


def test_two_frames_that_show_one_image_are_both_searched(monkeypatch):
    frame = np.arange(10)
    numbers = camera_frames(frame, 0, 0.5)  # half the match's frame rate
    footage = xr.Dataset({"picture_of_frame": ("frame", numbers)}, coords={"frame": frame})
    case = SimpleNamespace(
        detected=SimpleNamespace(frame=frame), detection=SimpleNamespace(file=lambda name: name)
    )
    monkeypatch.setattr(filtering, "footage_index", lambda _: None)
    monkeypatch.setattr(filtering, "open_video", lambda *_: nullcontext())
    monkeypatch.setattr(filtering, "some_pictures", lambda _, some: zip(some, some, strict=True))
    shown = dict(filtering._pictures(Results({"ingest/cam": footage}), case, frame))
    assert shown == dict(enumerate(numbers.tolist()))


@pytest.mark.parametrize(("given", "turned_deg"), [(True, 0.0), (False, 90.0)])
def test_a_search_has_the_turn_and_the_scores_of_detection(monkeypatch, given, turned_deg):
    shapes = []

    def estimate(image, boxes):
        shapes.append(image.shape)
        found = KeypointDetections.from_keypoints(
            np.repeat(boxes[:, None, :2], 17, axis=1), np.full((len(boxes), 17), 0.9)
        )
        return replace(found, boxes=boxes, score=np.full(len(boxes), 0.7))

    image = np.zeros((60, 40, 3), np.uint8)
    monkeypatch.setattr(filtering, "require_weights", lambda *_: None)
    monkeypatch.setattr(filtering, "_pictures", lambda *_: iter([(0, image)]))
    monkeypatch.setattr(filtering, "load_pose", lambda _: SimpleNamespace(estimate=estimate))
    monkeypatch.setattr(filtering, "load_score_map", lambda _: ScoreMap(1.0, 1.0))
    inputs = SimpleNamespace(
        unit="cam.clip",
        manifest=lambda _: SimpleNamespace(figures={"turned_deg": turned_deg}),
    )
    case = SimpleNamespace(
        camera=look_at_camera((0.0, -20.0, 5.0), (0.0, 0.0, 0.0), 50.0, (40, 60)),
        detected=SimpleNamespace(boxes=np.empty((1, 0, 4))),
        detection=SimpleNamespace(
            settings=lambda kind: kind(),
            sources={"weights": {}, **({"boxes": "b.txt"} if given else {})},
            require_registered=lambda _: None,
        ),
    )
    box = np.array([[5.0, 10.0, 15.0, 30.0]])
    sought = MissingPeople(np.array([0]), np.array([0]), box, 0)
    found = filtering._search(inputs, case, sought)
    assert shapes == [(60, 40, 3) if given else (40, 60, 3)]
    np.testing.assert_allclose(found.boxes, box)
    raw = np.cbrt([0.7 * 0.9])
    np.testing.assert_allclose(found.score, raw if given else ScoreMap(1.0, 1.0).probability(raw))


def beside(frames):
    """A camera 70 m beside the pitch (frames,), which looks at the origin."""
    return Camera.stack([look_at_camera((0.0, -70.0, 15.0), (0.0, 0.0, 1.0), 4000.0)] * frames)


def runner(frame):
    """Joints (frames, 1, 17, 3) of a person who moves 0.7 m per frame, diagonally away."""
    body = np.stack([np.tile([-0.2, 0.2], 9)[:17], np.zeros(17), np.linspace(0.1, 1.8, 17)], -1)
    return (body + (frame - 5.5)[:, None, None] * [0.5, 0.5, 0.0])[:, None]


@pytest.mark.parametrize(("feed_offset", "late"), [("report", -0.25), ("correct", 1.25)])
def test_pictures_are_late_by_what_rounding_leaves_and_what_was_measured(feed_offset, late):
    arrays = camera_arrays(beside(3))
    seen = xr.Dataset(
        {"keypoints": (("frame", "detection", "joint", "axis"), np.zeros((3, 1, 17, 2)))},
        coords={"frame": [100, 101, 102]},
    )
    found = xr.Dataset(
        {
            name: ([f"{name}_{axis}" for axis in range(values.ndim)], values)
            for name, values in {**arrays, "reprojection_error": np.array([1.0, 2.5, 2.0])}.items()
        },
        attrs={"feed_offset": {"frames": 1.5}},
    )
    results = {"broadcast_calibration/clip": found, "ingest/clip": seen}
    calibrated = SimpleNamespace(recipe=SimpleNamespace(settings={"feed_offset": feed_offset}))
    inputs = SimpleNamespace(
        unit="clip",
        sources={
            "offset_frames": 4,
            "broadcast_offset_frames": 104.25,
            "seen_in_broadcast": "ingest/clip",
            "estimates": None,
        },
        frames=np.arange(100, 103),
        open=results.__getitem__,
        open_first=lambda pooled, calibrated: results[calibrated],
        made_from=lambda name: calibrated,
    )
    pictures = refitting._RefittedView.open(inputs, "clip", {"joints": None})
    # Match frame 100 is at 104.25 of the video: its image 104 was taken a quarter earlier. The
    # feed was measured to show what static cameras show one and a half frames on.
    assert (pictures.clock.late + pictures.late).tolist() == [late] * 3
    assert pictures.clock.number.tolist() == [104, 105, 106]
    assert np.isfinite(pictures.camera.focal).all(axis=-1).tolist() == [True, False, True]


@pytest.mark.parametrize("late", [1.0, -2.0])
def test_bodies_of_pictures_that_are_late_are_those_of_the_frames(late):
    frame, camera = np.arange(12), beside(12)

    def turned(time):
        return Rigid.from_rotvec(time[:, None] * [0.0, 0.0, 0.1], np.zeros(3)).rotation

    rotations = np.repeat(turned(frame + late)[:, None], 24, axis=1)
    rotations[:, 0] = camera.cam_from_world.rotation @ rotations[:, 0]
    image = camera.project(runner(frame + late)[:, 0])
    middle = 0.5 * (image.min(axis=1) + image.max(axis=1))
    estimates = MonocularEstimates(104 + frame, rotations, middle, False)
    nobody, joints = xr.DataArray(np.full((12, 1, 17, 2), np.nan)), xr.DataArray(runner(frame))
    clock = ImageClock(104 + frame, np.zeros(12), 1.0)
    views = refitting._RefittedView(clock, camera, late, nobody, joints, estimates)
    _, found = views(slice(0, 12))
    there = np.isfinite(found.orient).all(axis=(-2, -1))[:, 0]
    assert there.sum() >= 10
    np.testing.assert_allclose(found.orient[there, 0], turned(frame[there]), atol=1e-9)
    turns = frame[there, None] * np.tile([0.0, 0.0, 0.1], 23)
    np.testing.assert_allclose(found.angles[there, 0], turns @ GATHER.T, atol=1e-9)
