"""What stages get of a clip: corrections applied, errors taken off, times."""

from contextlib import nullcontext
from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pytest
import xarray as xr
from camera_builders import look_at_camera

from data_contracts.keypoints import KeypointDetections
from data_contracts.triangulation import CameraChange
from tasks import clip_inputs, filtering, refitting, tracking
from tasks.clip_inputs import ADJUSTED, PAGE, StoredFeedback, open_detections
from worldpose.body.body_file import find_body
from worldpose.body_fitting.monocular import MonocularEstimates
from worldpose.body_fitting.pose_space import GATHER
from worldpose.detection.interfaces import ScoreMap
from worldpose.detection.settings import RedetectionSettings
from worldpose.filtering.redetection import MissingPeople
from worldpose.filtering.systematic_errors import TERMS
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
    def random(name):
        shape = [count if dim == "detection" else SIZES[dim] for dim in DIMS[name]]
        return array(rng.random((frames, *shape), dtype=np.float32), *DIMS[name])

    return xr.Dataset({name: random(name) for name in DIMS})


def test_rejected_keypoints_are_gone_and_lasting_errors_taken_off():
    frames = PAGE + 3  # over the border of a page
    rng = np.random.default_rng(0)
    cameras = [camera(frames, count, rng) for count in (2, 1)]
    dims = ("camera", "detection", "joint", "axis")
    rejected = array(rng.random((frames, 2, 2, 17)) < 0.1, *dims[:3])
    shift = array(rng.random((frames, 2, 2, 17, 2), dtype=np.float32), *dims)
    filtering, frame = xr.Dataset({"rejected": rejected, "shift": shift}), np.arange(frames)
    plain = open_detections(cameras, frame, StoredFeedback(cameras))[5:frames]
    taken = open_detections(cameras, frame, StoredFeedback(cameras, filtering))[5:frames]
    rejected, shift = rejected.values[5:], shift.values[5:]
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
    detected = read(StoredFeedback([one], without=("redetected",)))
    np.testing.assert_array_equal(detected[:, 0, 0], 100.0)
    assert np.isnan(detected[:, 0, 1]).all()


class Results(dict):
    """Results by name, of one camera."""

    sources = {"cameras": ["cam"], "camera": "cam"}

    def open(self, name):
        return self[name]

    def open_first(self, *names):
        return next(self[name] for name in names if name in self)


def test_clips_that_overlap_are_each_corrected_by_their_own_changes(monkeypatch):
    camera = Camera.stack([look_at_camera((0.0, -20.0, 5.0), (0.0, 0.0, 0.0), 1500.0)])
    monkeypatch.setattr(clip_inputs, "_load_cameras", lambda *_: (camera, None, None))
    stored = Results()
    for clip, frame in {"a": np.arange(0, 6), "b": np.arange(3, 9)}.items():
        given = {"first_frame": frame[0], "frame_count": 6, "shift_px": (40.0, 0.0), "std": 0.1}
        change = CameraChange(camera="cam", kind="view", frame=4, **given)
        stored[f"tracking/{clip}"] = SimpleNamespace(attrs={"changes": [change.model_dump()]})
        correct = clip_inputs._view_corrector(stored, clip, frame, ())
        middle = np.asarray(camera.principal_point[0], np.float32)
        seen = np.tile(middle, (6, 1, 1, 1, 1))
        moved = (correct("keypoints", seen, slice(0, 6)) - seen)[:, 0, 0, 0, 0]
        np.testing.assert_allclose(moved, -40.0 * (frame >= 4), atol=0.1)
        # Boxes move as their joints do; a side at the image's border stays there.
        box = np.array([[900, 500, 960, 600], [0, 500, 960, 600], [0, 500, 30, 600]], np.float32)
        page = np.tile(box, (6, 1, 1, 1))
        moved = (correct("boxes", page, slice(0, 6)) - page)[frame >= 4, 0]
        np.testing.assert_allclose(moved[:, 0, [0, 2]], -40.0, atol=0.5)
        np.testing.assert_allclose(moved[:, 1, [0, 2]], [[0.0, -40.0]] * len(moved), atol=0.5)
        np.testing.assert_array_equal(moved[:, 2, [0, 2]], [[0.0, -30.0]] * len(moved))


@pytest.fixture
def late_clips(monkeypatch):
    """Two clips of a camera a quarter of a frame early, and a person who moves 8 px per frame."""
    monkeypatch.setattr(clip_inputs, "_load_cameras", lambda *_: (None, None, None))
    stored = Results()
    stored.sources = {"cameras": ["cam"], "fps": 25.0, "clocks": [[[[0, 0.25]], 1.0]]}
    stored.sources |= {"clips": {"a": [0, 10], "b": [20, 4]}, "seen": {"a": ["s/a"], "b": ["s/b"]}}
    for clip, (first, count) in stored.sources["clips"].items():
        frame = np.arange(first, first + count)
        seen = camera(count, 1 + (clip == "b"), np.random.default_rng(2))
        seen["keypoints"][:, 0] = 8.0 * (frame - 0.25)[:, None, None]
        stored[f"s/{clip}"] = seen.assign_coords(frame=frame)
        index = array(np.zeros((count, 1, 1), np.int16), "camera", "person")
        coordinates = {"frame": frame, "person": [3]}
        stored[f"tracking/{clip}"] = xr.Dataset(
            {"detection_index": index}, coordinates, {"changes": []}
        )
    return stored


def test_chosen_frames_of_all_clips_are_read_at_match_time(late_clips):
    frames = {"a": np.array([0, 3, 6, 9]), "b": np.array([20, 22])}
    clip = clip_inputs.open_frames(late_clips, frames)
    assert clip.detections.keypoints.shape == (6, 1, 2, 17, 2)
    expected = 8.0 * np.array([0, 3, 6, 9, 20, 22])
    np.testing.assert_allclose(clip.detections.keypoints[:, 0, 0, 0, 0], expected)
    assert np.isnan(clip.detections.score[:, 0, 1]).tolist() == [True] * 4 + [False] * 2


def test_every_iteration_is_judged_on_keypoints_at_match_time(late_clips, monkeypatch):
    late_clips.unit, late_clips.frames = "a", np.arange(10)
    late_clips.sources["seen"] = ["s/a"]
    compared = []
    monkeypatch.setattr(
        filtering,
        "measure_held_out",
        lambda cameras, used, keypoints, _: compared.append(keypoints),
    )
    suspects = SimpleNamespace(detections=clip_inputs.open_tracked_clip(late_clips).detections[:])
    for first in (True, False):
        case = SimpleNamespace(first=first, clip=SimpleNamespace(cameras=None), triangulation=None)
        filtering._held_out(late_clips, case, np.arange(10), suspects)
    np.testing.assert_array_equal(*compared)
    np.testing.assert_allclose(compared[1][:, 0, 0, 0, 0], 8.0 * np.arange(10))


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


@pytest.mark.parametrize("is_explained", [True, False])
def test_people_are_looked_for_where_the_image_shows_them(late_clips, monkeypatch, is_explained):
    frame, eye = np.arange(10), look_at_camera((0.0, -20.0, 5.0), (0.0, 0.0, 0.0), 1500.0)
    height = np.linspace(1.8, 0.1, 17)

    def body(time):
        across = np.broadcast_to(np.tile([-0.2, 0.2], 9)[:17], (len(time), 17))
        return np.stack([across + 0.2 * time[:, None], 0.0 * across, height + 0.0 * across], -1)

    def data(name, attrs=None, coords=None, **arrays):
        late_clips[name] = xr.Dataset(arrays, coords, attrs)

    late_clips["detection/s"] = late_clips["s/a"]
    known = camera_arrays(Camera.stack([eye])).items()
    known = {n: ([f"{n}{k}" for k in range(a.ndim)], a) for n, a in known}
    data(ADJUSTED, {"surface": None}, **known)
    data(
        "body_fitting/a",
        coords={"person": [3]},
        joints=array(body(frame)[:, None], "person", "joint", "axis"),
        covariance=array(1e-4 * np.tile(np.eye(3), (10, 1, 17, 1, 1)), *"pjab"),
        joint_offsets=(("joint", "axis"), np.zeros((17, 3))),
    )
    data(
        "retriangulation/a",
        common_bias=("joint", np.zeros(17)),
        offsets=array(np.zeros((10, 1, 1, 2)), "camera", "person", "axis"),
        exchanged=array(np.zeros((10, 1, 1, 5), bool), *"cpk"),
    )
    data(
        "filtering/a",
        view_bias=(("joint", "axis", "term"), np.zeros((17, 2, TERMS))),
        clock_late=("camera", np.zeros(1)),
        fits=array(np.zeros((10, 1, 1), int), "camera", "detection"),
        dropped=array(np.zeros((10, 1, 1), bool), "camera", "detection"),
    )
    late_clips["tracking/a"] = late_clips["tracking/a"].assign_coords(camera=["cam"])
    # The camera turns before frame 6, or nothing explains its views.
    given = {"first_frame": 0, "frame_count": 10, "shift_px": (30.0, 0.0), "std": 0.1}
    given |= {"is_explained": is_explained, "is_left_out": not is_explained}
    change = CameraChange(camera="cam", kind="view", frame=6, **given)
    late_clips["triangulation/a"] = SimpleNamespace(attrs={"changes": [change.model_dump()]})
    late_clips["s/a"]["keypoints"] += eye.principal_point
    late_clips["s/a"]["keypoints"][6:] += np.array([30.0, 0.0])
    taken = []
    monkeypatch.setattr(filtering, "_spread", lambda _, suspects: taken.append(suspects))
    late_clips.unit = "s"
    late_clips.sources |= {"camera": "cam", "clip": "a"}
    settings = SimpleNamespace(settings=lambda kind: kind(), sources=late_clips.sources, pitch=None)
    late_clips.made_from = lambda name: settings
    case = filtering._open_view(late_clips)
    if not is_explained:
        assert np.isnan(case.expected.image).all()
        assert not len(case.select_missing_people(RedetectionSettings()).frame)
        return
    shown = eye.project(body(frame[1:-1] - 0.25).reshape(-1, 3)).reshape(8, 17, 2)
    shown[5:, :, 0] += 30.0
    np.testing.assert_allclose(case.expected.image[1:-1, 0], shown, atol=0.3)
    (suspects,) = taken
    step = np.diff(suspects.detections.keypoints[1:-1, 0, 0, 0, 0])
    np.testing.assert_allclose(step, 8.0, atol=0.5)
    assert np.abs(case.shift[1:-1]).max() == 0.0  # tracking moves what is found to match time


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
        unit="cam.clip", manifest=lambda _: SimpleNamespace(figures={"turned_deg": turned_deg})
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
    keypoints = (("frame", "detection", "joint", "axis"), np.zeros((3, 1, 17, 2)))
    arrays = {**camera_arrays(beside(3)), "reprojection_error": np.array([1.0, 2.5, 2.0])}
    found = {n: ([f"{n}_{axis}" for axis in range(a.ndim)], a) for n, a in arrays.items()}
    results = {
        "broadcast_calibration/clip": xr.Dataset(found, attrs={"feed_offset": {"frames": 1.5}}),
        "ingest/clip": xr.Dataset({"keypoints": keypoints}, {"frame": [100, 101, 102]}),
    }
    calibrated = SimpleNamespace(recipe=SimpleNamespace(settings={"feed_offset": feed_offset}))
    sources = {"offset_frames": 4, "broadcast_offset_frames": 104.25, "estimates": None}
    inputs = SimpleNamespace(
        unit="clip",
        sources=sources | {"seen_in_broadcast": "ingest/clip"},
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


def test_names_give_a_shape_only_to_people_who_can_be_the_same(monkeypatch):
    model = find_body()
    monkeypatch.setattr(refitting, "find_same_body", lambda before: model)

    def bodies(*first):
        betas = np.zeros((len(first), model.shapes))
        betas[:, 0] = first
        covariance = np.tile(0.2 * np.eye(model.shapes), (len(first), 1, 1))
        arrays = {"betas": (("person", "beta"), betas)}
        arrays["betas_covariance"] = (("person", "a", "b"), covariance)
        return xr.Dataset(arrays, {"person": np.arange(len(first))})

    fitted = {"body_fitting/a": bodies(0.0, 1.0, 2.0), "body_fitting/b": bodies(1.1, -4.0)}
    names = {"a": {"1": "kane", "2": "rice", "99": "saka"}, "b": {"0": "kane", "1": "rice"}}
    inputs = SimpleNamespace(unit="a", sources={"people": names}, open=fitted.__getitem__)
    before = SimpleNamespace(settings=lambda kind: SimpleNamespace(prior_weight=1.0))
    result = SimpleNamespace(warnings=[])
    known = refitting._known_shapes(inputs, before, fitted["body_fitting/a"], result)
    assert list(known) == [1]
    assert known[1].betas[0] == pytest.approx(1.1)
    (differ,) = result.warnings  # person 99 can be tracked, without a body
    assert "person 2 of clip a and person 1 of clip b are both named rice and differ" in differ


def test_a_camera_whose_people_meet_nobody_is_named_unless_a_change_explains_it(monkeypatch):
    monkeypatch.setattr(tracking, "find_lone_views", lambda *_: {0: 2, 1: 3})
    detections = SimpleNamespace(frame=np.arange(40, 50))
    clip = SimpleNamespace(camera_ids=("a", "b"), cameras=None, detections=detections, fps=25.0)
    change = CameraChange(
        camera="a", kind="view", frame=42, first_frame=40, frame_count=10, std=0.1
    )
    moved, lone = tracking._describe_changes(clip, SimpleNamespace(joints=None), [change])
    assert moved.startswith("camera a") and lone.startswith("camera b: from frame 43 on most")
