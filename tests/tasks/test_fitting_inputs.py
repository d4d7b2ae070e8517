"""Images of the broadcast camera as input of body fitting: clock offsets."""

from types import SimpleNamespace

import numpy as np
import pytest
import xarray as xr
from camera_builders import look_at_camera

from tasks import refitting
from worldpose.body.body_file import find_body
from worldpose.body_fitting.monocular import MonocularEstimates
from worldpose.body_fitting.pose_space import GATHER
from worldpose.geometry.cameras import Camera, camera_arrays
from worldpose.geometry.rigid import Rigid
from worldpose.ingest.clock import ImageClock

MODEL = find_body()


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


def test_names_give_a_shape_only_to_people_who_can_be_the_same(monkeypatch):
    monkeypatch.setattr(refitting, "find_same_body", lambda before: MODEL)
    count = MODEL.shapes

    def bodies(*first):
        betas = np.zeros((len(first), count))
        betas[:, 0] = first
        covariance = np.tile(0.2 * np.eye(count), (len(first), 1, 1))
        return xr.Dataset(
            {
                "betas": (("person", "beta"), betas),
                "betas_covariance": (("person", "a", "b"), covariance),
            },
            {"person": np.arange(len(first))},
        )

    fitted = {"body_fitting/a": bodies(0.0, 1.0, 2.0), "body_fitting/b": bodies(1.1, -4.0)}
    names = {"a": {"1": "kane", "2": "rice", "99": "saka"}, "b": {"0": "kane", "1": "rice"}}
    inputs = SimpleNamespace(unit="a", sources={"people": names}, open=fitted.__getitem__)
    before = SimpleNamespace(settings=lambda kind: SimpleNamespace(shape_weight=1.0))
    result = SimpleNamespace(warnings=[])
    known = refitting._known_shapes(inputs, before, fitted["body_fitting/a"], result)
    assert list(known) == [1]
    assert known[1].betas[0] == pytest.approx(1.1)
    differ, missing = result.warnings
    assert "person 2 of clip a and person 1 of clip b are both named rice and differ" in differ
    assert missing.startswith("clip a has no fitted person 99, named saka; its people are 0, 1, 2.")


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
