"""The stage's task in a store: numbers of frames, the clip's clock, people and the layout."""

import shutil

import numpy as np
import pytest
import turning_clip as clip
from run_records import match_spec

from data_contracts.body_fitting import BODY_FITTING
from data_contracts.broadcast_calibration import FRAME_STATUS, KeyFrame, KeyFrames
from data_contracts.bundle_adjustment import BUNDLE_ADJUSTMENT
from data_contracts.keypoints import KeypointDetections
from data_contracts.pitch import PitchSpec
from data_contracts.static_calibration import ClickedMarkings
from flows.registering import register
from flows.run_plan import plan_run
from flows.stages.broadcast_calibration import uncalibrated_warnings
from tasks.broadcast_calibration import broadcast_calibration, broadcast_pooling
from tasks.ingest import ingest
from worldpose.errors import InputError
from worldpose.geometry.cameras import Camera
from worldpose.ingest.writing import MatchAnnotations, write_match
from worldpose.store.store import Store
from worldpose.video.files import write_video

FIRST, COUNT, OFFSET = 7, 10, 4.4
"""The clip's first match frame and length; its video's frame there. Frames 4 to 13 are the clip's,
and people are 0.4 frames earlier than those of the same number."""
VIDEO = 16
FPS = 25.0


def joints(frames):
    """Twelve people at match frames (n,), each going their way at up to 6 m/s."""
    x, y = np.meshgrid([-8.0, -2.0, 4.0, 10.0], [-9.0, 0.0, 9.0])
    way = np.random.default_rng(1).uniform(-6.0, 6.0, (12, 2))
    places = np.stack([x.ravel(), y.ravel()], axis=-1) + frames[:, None, None] / FPS * way
    return np.concatenate([places, np.zeros((*places.shape[:2], 1))], -1)[:, :, None] + clip.SHAPE


def observed(frame, keypoints):
    known = np.isfinite(keypoints).all(axis=-1)
    low, high = keypoints.min(axis=-2), keypoints.max(axis=-2)
    return KeypointDetections(
        frame=frame,
        keypoints=keypoints.astype(np.float32),
        confidence=np.where(known, 0.9, np.nan).astype(np.float32),
        boxes=np.concatenate([low, high], axis=-1).astype(np.float32),
        score=np.full(keypoints.shape[:2], 0.9, dtype=np.float32),
    )


@pytest.fixture(scope="module")
def folder(tmp_path_factory):
    """A match of one static camera and broadcast clips, one in the middle of its video.

    In clip `both`, one of two broadcast cameras takes 30 images per second.
    """
    true, rng = clip.moving(VIDEO, pan=(-2.0, 6.0)), np.random.default_rng(2)
    numbers = np.arange(VIDEO)
    seen = true.camera.project(joints(FIRST + numbers - OFFSET).reshape(VIDEO, -1, 3))
    seen = seen.reshape(VIDEO, 12, 17, 2) + rng.standard_normal((VIDEO, 12, 17, 2))
    both = true.camera.project(joints(60 + (numbers - OFFSET) / 1.2).reshape(VIDEO, -1, 3))
    both = both.reshape(VIDEO, 12, 17, 2) + rng.standard_normal((VIDEO, 12, 17, 2))
    static: Camera = true.camera[0]
    tv = {"kind": "broadcast"}
    goal = {"broadcast": "main", "broadcast_offset_frames": OFFSET, "first_frame": FIRST}
    two = {"broadcast": ("wide", "fast"), "broadcast_smooth_weight": 2.0, "first_frame": 60}
    two["broadcast_offset_frames"] = {"wide": 0.0, "fast": OFFSET}
    clips = {"goal": goal, "shot": {"broadcast": "main", "first_frame": 90}, "both": two}
    spec = match_spec(
        {"one": {}, "main": tv, "wide": tv, "fast": {**tv, "fps": 1.2 * FPS}},
        {name: {**own, "frame_count": COUNT} for name, own in clips.items()},
        **{"size": clip.SIZE, "match_id": "stage", "fps": FPS},
    )
    key = KeyFrame(frame=9, markings=clicks(true, 9))
    other = KeyFrame(frame=2, markings=clicks(true, 2))
    late = KeyFrame(frame=15, markings=clicks(true, 15))

    def video(draft):
        (draft / "broadcast").mkdir()
        goal = draft / "broadcast" / "goal.mp4"
        write_video(goal, clip.film_empty_pitch(true.camera, 5), FPS)
        shutil.copy(goal, goal.with_name("shot.mp4"))
        write_video(
            goal.with_name("both.fast.mp4"), clip.film_empty_pitch(true.camera, 5), 1.2 * FPS
        )

    path = tmp_path_factory.mktemp("matches") / "stage"
    inside = np.where(((seen > 0) & (seen < true.image_size - 1)).all(-1, keepdims=True), seen, 5.0)
    write_match(
        path,
        spec,
        calibrations={"one": static.to_calibration("one")},
        observations={
            "one": observed(np.arange(FIRST, FIRST + COUNT), inside[:COUNT]),
            "goal": observed(numbers, inside),
            "shot": observed(numbers, inside),
            "both.fast": observed(numbers, np.where(np.isfinite(inside), both, 5.0)),
            "both.wide": observed(numbers, inside),
        },
        pitch=PitchSpec(),
        annotations=MatchAnnotations(
            key_frames={
                "goal": KeyFrames(key_frames=(key, late)),
                "shot": KeyFrames(key_frames=(other,)),
                "both.fast": KeyFrames(key_frames=(key,)),
            }
        ),
        further=video,
    )
    return path


def clicks(true, frame):
    return ClickedMarkings.model_validate({"points": [], "drawn": clip.draw(true, frame)})


def prepared(store, work, first, places):
    """Publishes bodies whose joints are at these places."""
    sizes = {"frame": COUNT, "person": 12, "joint": 17, "shape_component": 10, "rotation": 3}
    sizes |= {"shape_component_": 10, "rotation_23": 69, "coordinate": 3, "coordinate_": 3}
    sizes |= {"body_axis": 3}
    arrays = {
        array.name: np.zeros([sizes[dim] for dim in array.dims], dtype=array.dtype)
        for array in BODY_FITTING.arrays
        if array.name not in BODY_FITTING.optional
    }
    frames = np.arange(first, first + COUNT)
    arrays["joints"] = places
    with store.publish(work) as result:
        result.write(
            BODY_FITTING,
            arrays=arrays,
            coordinates={"frame": frames, "person": np.arange(12, dtype=np.int32)},
            attributes={"body_model": "none"},
        )


@pytest.fixture(scope="module")
def calibrated(folder, tmp_path_factory):
    """A store with both clips' cameras, and the plan of the match."""
    store = Store.create(tmp_path_factory.mktemp("project") / "project")
    match, _ = register(store, folder)
    planned = {unit.name: unit for unit in plan_run(store, match, {})}
    # Of the static cameras the stage reads the pitch's surface alone.
    about = {"surface": BUNDLE_ADJUSTMENT.attributes["surface"]}
    surface = BUNDLE_ADJUSTMENT.model_copy(update={"arrays": (), "labels": {}, "attributes": about})
    with store.publish(
        planned["bundle_adjustment/cameras"].work(store.url, match, "0001")
    ) as result:
        result.write(surface, arrays={}, coordinates={}, attributes={"surface": None})
    there = joints(FIRST + np.arange(float(COUNT)))
    nobody = np.full_like(there, np.nan)
    moved = joints(60 + np.arange(float(COUNT)))
    # Nobody was found in the second clip.
    made = (("goal", FIRST, there), ("shot", 90, nobody), ("both.fast", 60, moved))
    for name, first, places in made:
        ingest.fn(planned[f"ingest/{name}"].work(store.url, match, "0001"))
        fitted = planned[f"body_fitting/{name.partition('.')[0]}"]
        prepared(store, fitted.work(store.url, match, "0001"), first, places)
        unit = planned[f"broadcast_calibration/{name}"]
        assert broadcast_calibration.fn(unit.work(store.url, match, "0001")) == unit.key
    return store, match, planned


def test_the_task_publishes_a_camera_for_every_frame_of_the_clip(calibrated):
    store, _, planned = calibrated
    unit = planned["broadcast_calibration/goal"]
    result = store.open_result("stage", "broadcast_calibration", "goal", unit.key, verify=True)
    assert result["frame"].values.tolist() == list(range(FIRST, FIRST + COUNT))
    # Frame 15 of the video is none of the clip's.
    assert result.attrs["key_frames"] == [9]

    assert FRAME_STATUS[int(result["status"].sel(frame=FIRST + 5))] == "key_frame"
    assert all(4 <= number < 4 + COUNT for number in result.attrs["pick_next"])
    true = clip.moving(VIDEO, pan=(-2.0, 6.0)).frames(np.arange(4, 4 + COUNT))
    off = np.linalg.norm(result["center"].values - true.center)
    # A key frame of clicks that are true, and lines in every frame of 540 rows.
    assert off < 0.5
    assert np.median(np.abs(result["focal"].values[:, 0] / true.focal - 1.0)) < 0.005
    # What match.yaml says of the clock is right, and people were taken accordingly.
    offset = result.attrs["feed_offset"]
    assert offset["frames"] == pytest.approx(0.0, abs=0.3)
    manifest = store.manifest("stage", "broadcast_calibration", "goal", unit.key)
    assert "key frames 15 are outside of the clip's 4 to 13" in str(manifest.warnings)
    figures = manifest.figures
    assert figures["feed_offset_frames"] == offset["frames"]
    assert figures["weak"] == float(bool(result.attrs["reasons"]))


def test_two_clips_of_one_camera_get_one_place_that_is_known_better(calibrated):
    store, match, planned = calibrated
    places, before = [], []
    for name in ("goal", "shot"):
        unit = planned[f"broadcast_pooling/{name}"]
        assert broadcast_pooling.fn(unit.work(store.url, match, "0001")) == unit.key
        pooled = store.open_result("stage", "broadcast_pooling", name, unit.key)
        key = planned[f"broadcast_calibration/{name}"].key
        own = store.open_result("stage", "broadcast_calibration", name, key)
        assert pooled.attrs["agree"] and pooled.attrs["clips"] == ["goal", "shot"]
        spreads = [np.trace(each["clip_covariance"].values[:3, :3]) for each in (pooled, own)]
        assert spreads[0] < spreads[1]
        np.testing.assert_array_equal(pooled["frame"].values, own["frame"].values)
        places.append(pooled["center"].values)
        before.append(own["center"].values)
    # Sums of the same two places in either order.
    np.testing.assert_allclose(places[0], places[1], atol=1e-9)
    assert np.linalg.norm(before[0] - before[1]) > 1e-3


def test_a_camera_of_another_rate_is_that_of_the_image_nearest_to_each_frame(calibrated):
    store, _, planned = calibrated
    unit = planned["broadcast_calibration/both.fast"]
    result = store.open_result("stage", "broadcast_calibration", "both.fast", unit.key, verify=True)
    assert result.attrs["clip_id"] == "both"
    assert result["frame"].values.tolist() == list(range(60, 60 + COUNT))
    # Match frame 60 + k is at 4.4 + 1.2 k of the video.
    shown = np.array([4, 6, 7, 8, 9, 10, 12, 13, 14, 15])
    true = clip.moving(VIDEO, pan=(-2.0, 6.0)).frames(shown)
    turn = result["rotation"].values @ np.swapaxes(true.rotation, 1, 2)
    off = np.degrees(np.arccos(np.clip((np.trace(turn, axis1=1, axis2=2) - 1.0) / 2.0, -1.0, 1.0)))
    # The camera turns by half a degree from image to image.
    assert off.max() < 0.15
    assert result.attrs["feed_offset"]["frames"] == pytest.approx(0.0, abs=0.3)


def test_a_clip_that_is_longer_than_its_video_is_refused(folder, tmp_path):
    match = shutil.copytree(folder, tmp_path / "stage")
    text = (match / "match.yaml").read_text()
    assert f"frame_count: {COUNT}" in text
    (match / "match.yaml").write_text(text.replace(f"frame_count: {COUNT}", "frame_count: 20"))
    with pytest.raises(InputError, match=r"0 to 15, found .* frames that fit"):
        register(Store.create(tmp_path / "project"), match)


def test_static_work_of_a_clip_is_planned_once_for_all_its_broadcast_cameras(calibrated):
    _, match, planned = calibrated
    (warning,) = uncalibrated_warnings(match)
    assert "broadcast camera wide of clip both is not used" in warning
    of_clip = [name for name in planned if name.partition("/")[2].startswith("both")]
    assert of_clip == [
        "ingest/both.wide",
        "ingest/both.fast",
        *(f"{stage}/both" for stage in ("camera_consistency", "tracking", "triangulation")),
        "retriangulation/both",
        "body_fitting/both",
        "broadcast_calibration/both.fast",
        "refitting/both",
        "filtering/both",
    ]
    weighted = [n for n, unit in planned.items() if "smooth" in unit.recipe.sources]
    assert weighted == ["broadcast_calibration/both.fast"]
    recipe = planned["refitting/both"].recipe
    assert recipe.sources["broadcast_offset_frames.both.fast"] == OFFSET
    assert {"ingest/both.fast", "broadcast_calibration/both.fast"} <= set(recipe.inputs)
    # A single camera's recipe is what it was before a clip could have several.
    assert planned["refitting/goal"].recipe.sources["seen_in_broadcast"] == "ingest/goal"
