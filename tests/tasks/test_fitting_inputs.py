"""Inputs of body fitting: triangulated keypoints, other clips' shapes, clock offsets."""

from types import SimpleNamespace

import numpy as np
import pytest
import xarray as xr

from data_contracts.conventions import COCO17
from data_contracts.keypoints import KeypointDetections
from tasks import body_fitting, refitting
from tasks.clip_inputs import ClipInputs
from worldpose.body_fitting.monocular import MonocularEstimates
from worldpose.body_fitting.pose_space import GATHER
from worldpose.body_fitting.ray_constraints import constrain_to_rays
from worldpose.geometry.cameras import Camera, camera_arrays
from worldpose.geometry.rigid import Rigid
from worldpose.simulation.scene import look_at

LEGS = [COCO17.index(f"{side}_{name}") for name in ("knee", "ankle") for side in ("left", "right")]


def stored(**arrays):
    """A result with these arrays and arbitrary dimensions."""
    return {name: xr.DataArray(np.asarray(values)) for name, values in arrays.items()}


def test_legs_that_triangulation_exchanged_are_exchanged_for_bodies_too(monkeypatch):
    truth = np.random.default_rng(1).uniform(0.0, 1000.0, (4, 2, 3, 17, 2))
    index = np.array([[0, 2], [1, -1]])[None].repeat(4, axis=0)
    exchanged = np.zeros((4, 2, 2, 3), dtype=bool)
    exchanged[2, 0, 1, 2] = True  # the second person's legs, in the first camera
    seen = truth.copy()
    legs = [*LEGS, COCO17.index("left_hip"), COCO17.index("right_hip")]
    other = [joint + (1 if COCO17[joint].startswith("left") else -1) for joint in legs]
    seen[2, 0, 2, legs] = truth[2, 0, 2, other]
    results = {
        "retriangulation/clip": stored(
            person=[0, 1],
            joints=np.zeros((4, 2, 17, 3)),
            covariance=np.zeros((4, 2, 17, 3, 3)),
            shared_covariance=np.zeros((4, 2, 3, 3)),
            common_bias=np.zeros(17),
            exchanged=exchanged,
        ),
        "tracking/clip": stored(detection_index=index),
    }
    detections = KeypointDetections.from_keypoints(seen, seen[..., 0], frame=np.arange(4))
    clip = ClipInputs(("a", "b"), None, None, detections, 50.0)
    monkeypatch.setattr(body_fitting, "open_clip", lambda *_: clip)
    monkeypatch.setattr(body_fitting, "open_input", lambda store, work, name: results[name])
    people = body_fitting.open_people(None, SimpleNamespace(recipe=SimpleNamespace(unit="clip")))
    np.testing.assert_array_equal(people[:].keypoints, truth)


@pytest.mark.parametrize("weight", [0.25, 1.0, 4.0])
def test_clips_that_say_nothing_of_somebody_leave_him_anybody(monkeypatch, weight):
    silent = stored(person=[7], betas=np.zeros((1, 10)), betas_covariance=[np.eye(10) / weight])
    named = {"here": {"3": "ann"}, "second": {"7": "ann"}, "third": {"7": "ann"}}
    recipe = SimpleNamespace(unit="here", sources={"people": named})
    monkeypatch.setattr(refitting, "open_input", lambda *_: silent)
    known = refitting._known_shapes(None, SimpleNamespace(recipe=recipe), np.array([2, 3]), weight)
    assert list(known) == [1]
    np.testing.assert_allclose(known[1].covariance, np.eye(10) / weight)


def beside(frames):
    """A camera 70 m beside the pitch (frames,), which looks at the origin."""
    pose = look_at(np.array([0.0, -70.0, 15.0]), np.array([0.0, 0.0, 1.0]), 0.0)
    return Camera(
        focal=np.full((frames, 2), 4000.0),
        principal_point=np.tile([959.5, 539.5], (frames, 1)),
        distortion=np.zeros((frames, 5)),
        cam_from_world=Rigid(
            np.tile(pose.rotation, (frames, 1, 1)), np.tile(pose.translation, (frames, 1))
        ),
        image_size=np.tile([1920, 1080], (frames, 1)),
    )


def runner(frame):
    """Joints (frames, 1, 17, 3) of a person who moves 0.7 m per frame, diagonally away."""
    body = np.stack([np.tile([-0.2, 0.2], 9)[:17], np.zeros(17), np.linspace(0.1, 1.8, 17)], -1)
    return (body + (frame - 5.5)[:, None, None] * [0.5, 0.5, 0.0])[:, None]


def of_clip(**sources):
    """Work on the clip of twelve frames from match frame 100 on."""
    here = {"first_frame": 100, "frame_count": 12, **sources}
    inputs = {"broadcast_calibration/clip": "key"}
    recipe = SimpleNamespace(match_id="match", unit="clip", inputs=inputs, sources=here)
    return SimpleNamespace(recipe=recipe, folder="folder")


@pytest.mark.parametrize(("feed_offset", "late"), [("report", -0.25), ("correct", 1.25)])
def test_pictures_are_late_by_what_rounding_leaves_and_what_was_measured(
    monkeypatch, feed_offset, late
):
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
    inputs = {"broadcast_calibration/clip": found, "ingest/clip": seen}
    monkeypatch.setattr(refitting, "open_input", lambda store, work, name: inputs[name])
    calibrated = SimpleNamespace(recipe=SimpleNamespace(settings={"feed_offset": feed_offset}))
    store = SimpleNamespace(manifest=lambda *_: calibrated)
    work = of_clip(
        frame_count=3,
        offset_frames=4,
        broadcast_offset_frames=4.25,
        seen_in_broadcast="ingest/clip",
        estimates=None,
    )
    pictures = refitting._BroadcastViews.open(store, work, {"joints": None})
    # Match frame 100 is at 104.25 of the video: its image 104 was taken a quarter earlier. The
    # feed was measured to show what static cameras show one and a half frames on.
    assert pictures.late == late
    assert pictures.number.tolist() == [104, 105, 106]
    assert np.isfinite(pictures.camera.focal).all(axis=-1).tolist() == [True, False, True]


@pytest.mark.parametrize("late", [1.0, -2.0, 0.5])
def test_lines_of_pictures_that_are_late_are_those_of_the_frames(late):
    frame, camera = np.arange(12), beside(12)
    keypoints = camera.project(runner(frame + late)[:, 0])[:, None]
    seen, joints = xr.DataArray(keypoints), xr.DataArray(runner(frame))
    views = refitting._BroadcastViews(frame, camera, late, seen, joints, None)
    view, without = views(slice(0, 12))
    assert without is None
    there = view.seen[:, 0]
    assert there.sum() >= 10
    # He runs straight on, so that the middle of two of his places is one.
    np.testing.assert_allclose(view.points[there], runner(frame)[there], atol=1e-6)
    # 7 mrad a frame along the image, and what bends of it in between.
    own = camera.project(runner(frame)[:, 0])[:, None]
    here = constrain_to_rays(camera, own, runner(frame)).across
    np.testing.assert_allclose(view.across[there], here[there], atol=1e-4)


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
    views = refitting._BroadcastViews(104 + frame, camera, late, nobody, joints, estimates)
    _, found = views(slice(0, 12))
    there = np.isfinite(found.orient).all(axis=(-2, -1))[:, 0]
    assert there.sum() >= 10
    np.testing.assert_allclose(found.orient[there, 0], turned(frame[there]), atol=1e-9)
    turns = frame[there, None] * np.tile([0.0, 0.0, 0.1], 23)
    np.testing.assert_allclose(found.angles[there, 0], turns @ GATHER.T, atol=1e-9)
