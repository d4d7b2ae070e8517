"""From a video to the match's clock: the frame that is read is the one that was shown."""

from dataclasses import replace

import av
import numpy as np
import pytest
from filmed import write_filmed
from run_records import correction

import tasks.detection
from data_contracts.keypoints import KeypointDetections
from data_contracts.review import DeletedDetection
from flows.match import task_of
from flows.method import METHOD
from flows.registering import register
from flows.run_plan import RunPlan
from tasks.clip_inputs import open_clip, open_frames
from tasks.unit import UnitInputs
from worldpose.detection.interfaces import People
from worldpose.detection.pipeline import DetectionReport
from worldpose.errors import InputError
from worldpose.ingest.writing import import_boxes
from worldpose.store.store import Store

OFFSETS = {"left": 0, "right": 3}
CLIPS = [("early", 2, 12), ("late", 20, 10)]
NAMES = [stage.name for stage in METHOD]
DETECTED = NAMES[NAMES.index("detection") + 1]
"""The first stage that uses detections."""


class Reading:
    """Finds one person whose box begins at the number that is burnt into the image."""

    view_size = None

    def detect(self, pictures):
        numbers = [round((float(picture.mean()) - 10.0) / 4.0) for picture in pictures]
        return [
            People(np.array([[float(n), 10.0, n + 8.0, 30.0]]), np.array([0.9])) for n in numbers
        ]

    def estimate(self, picture, boxes):
        keypoints = np.repeat(boxes[:, None, :2], 17, axis=1)
        return KeypointDetections.from_keypoints(keypoints, np.full((len(boxes), 17), 0.9))


@pytest.fixture
def reading(monkeypatch):
    monkeypatch.setattr(tasks.detection, "load_detectors", lambda settings: [Reading()])
    monkeypatch.setattr(tasks.detection, "load_pose", lambda settings: Reading())


@pytest.fixture
def filmed(tmp_path):
    """A match of two cameras with videos alone; `right` was switched off before the end."""
    counts = {"left": 40, "right": 31}
    greys = {name: [10 + 4 * n for n in range(count)] for name, count in counts.items()}
    write_filmed(tmp_path / "match", greys, CLIPS, offsets=OFFSETS)
    return tmp_path / "match"


def computed(store, match, until="tracking"):
    """Results of the stages before one, by `stage/unit`; those that are there are not computed."""
    results = {}
    for stage in METHOD[: NAMES.index(until)]:
        for unit in RunPlan(store, match, {}, results=results).plan_stage(stage):
            if not unit.published:
                task_of(stage).fn(unit.work(store.url, match, "0001"))
            results[unit.name] = unit.key
    return results


@pytest.fixture
def project(tmp_path):
    """A store, and what registers a match in it and computes its stages."""
    store = Store.create(tmp_path / "project")

    def compute(folder, until="tracking"):
        match, _ = register(store, folder)
        return match, computed(store, match, until)

    return store, compute


def test_people_of_videos_reach_tracking_on_the_match_s_clock(filmed, project, reading):
    store, compute = project
    match, results = compute(filmed)
    late = store.open_result("filmed", "ingest", "right", results["ingest/right"])
    # Frames 20 to 29 are images 23 to 32 of `right`, which has 31.
    assert late.attrs["video"]["missing_frames"] == [[28, 29]]
    planned = RunPlan(store, match, {}, results=results).plan_stage(METHOD[NAMES.index("tracking")])
    early, late = (unit.work(store.url, match, "0001") for unit in planned)
    assert set(early.recipe.inputs) == {
        *("detection/left.early", "detection/right.early"),
        *("static_calibration/left", "static_calibration/right"),
    }
    for work, frames in ((early, np.arange(2, 14)), (late, np.arange(20, 30))):
        clip = open_clip(UnitInputs(store, work))
        assert clip.detections.keypoints.shape == (len(frames), 2, 1, 17, 2)
        shown = clip.detections.keypoints[:][:, :, 0, 0, 0]
        expected = frames[:, None] + list(OFFSETS.values()) + 0.0
        expected[expected[:, 1] > 30, 1] = np.nan
        np.testing.assert_array_equal(shown, expected)
        assert clip.detections.frame.tolist() == frames.tolist()
    # All clips at once, as bundle adjustment takes them.
    chosen = {"early": np.array([3, 7]), "late": np.array([21, 28])}
    seen = {clip: work.recipe.sources["seen"] for clip, work in (("early", early), ("late", late))}
    inputs, sources = late.recipe.inputs | early.recipe.inputs, late.recipe.sources
    recipe = late.recipe.model_copy(update={"inputs": inputs, "sources": sources | {"seen": seen}})
    both = open_frames(UnitInputs(store, late.model_copy(update={"recipe": recipe})), chosen)
    np.testing.assert_array_equal(
        both.detections.keypoints[:, :, 0, 0, 0], [[3, 6], [7, 10], [21, 24], [28, np.nan]]
    )
    key = results["detection/right.late"]
    figures = store.manifest("filmed", "detection", "right.late", key).figures
    assert figures["unreadable_share"] == pytest.approx(0.2)
    assert [figures[f"unreadable_{end}_frame"] for end in ("from", "to")] == [28.0, 29.0]


def test_a_camera_may_film_one_clip_alone(tmp_path, project, reading):
    greys = {name: [10 + 4 * n for n in range(count)] for name, count in (("a", 40), ("b", 15))}
    write_filmed(tmp_path / "match", greys, CLIPS)
    store, compute = project
    _, results = compute(tmp_path / "match")
    alone = store.open_result("filmed", "detection", "b.late", results["detection/b.late"])
    assert dict(alone.sizes)["detection"] == 0
    told = store.manifest("filmed", "ingest", "b", results["ingest/b"]).warnings
    assert any("it shows frames 2 to 13 of 2 to 29" in text for text in told)


def test_frames_that_share_an_image_or_go_back_are_detected_in_it(tmp_path, project, reading):
    greys = {name: [10 + 4 * n for n in range(40)] for name in ("slow", "fast")}
    # A camera that loses a frame, and one whose stated offsets make its numbers go back.
    offsets = {"slow": ((5, 0.0), (6, -1.0)), "fast": ((5, 0.0), (6, -3.0))}
    write_filmed(tmp_path / "match", greys, [("clip", 0, 12)], offsets=offsets)
    store, compute = project
    _, results = compute(tmp_path / "match")
    for name, lost in (("slow", 1), ("fast", 3)):
        unit = f"detection/{name}.clip"
        seen = store.open_result("filmed", *unit.split("/"), results[unit])["keypoints"]
        expected = [*range(6), *range(6 - lost, 12 - lost)]
        np.testing.assert_array_equal(seen.values[:, 0, 0, 0], expected)


def test_a_video_of_which_no_image_can_be_decoded_fails_with_its_name(filmed, project, reading):
    path = filmed / "videos" / "left.mp4"
    with av.open(str(path)) as video:
        places = [(packet.pos, packet.size) for packet in video.demux(video=0) if packet.size]
    content = bytearray(path.read_bytes())
    for place, size in places:
        content[place : place + size] = bytes(size)
    path.write_bytes(content)
    with pytest.raises(InputError, match=r"left\.mp4.*none in 12 frames"):
        project[1](filmed)


def test_a_corrected_detection_is_the_same_whether_or_not_the_nets_look_again(
    filmed, tmp_path, reading, monkeypatch
):
    said = correction(DeletedDetection(camera="left", frame=4, detection=0), match_id="filmed")
    monkeypatch.setattr(DetectionReport, "why_no_person", lambda self: "told")
    found = []
    for project in ("fresh", "kept"):
        store = Store.create(tmp_path / project)
        match, _ = register(store, filmed)
        if project == "kept":
            before = computed(store, match, DETECTED)
            monkeypatch.setattr(tasks.detection, "load_detectors", None)  # would fail
        after = computed(store, replace(match, corrections=(said,)), DETECTED)
        if project == "kept":
            assert {n for n in after if after[n] != before[n]} == {"detection/left.early"}
        unit = ("filmed", "detection", "left.early", after["detection/left.early"])
        found.append((store.manifest(*unit), store.open_result(*unit)["score"].values))
    (fresh, score), (kept, _) = found
    assert np.isnan(score[:, 0]).tolist() == [n == 4 - 2 for n in range(12)]
    assert fresh.content == kept.content
    assert fresh.warnings == kept.warnings == ("detection/left.early: told.",)
    speed = DetectionReport().speed()  # each run has its own
    metrics = [{k: v for k, v in each.figures.items() if k not in speed} for each in (fresh, kept)]
    assert (metrics[0], fresh.figures["corrections_refused"]) == (metrics[1], 0)


@pytest.mark.parametrize(
    ("old", "new", "told"),
    [
        ("fps: 25.0", "fps: 50.0", "50 frames per second"),
        ("first_frame: 20", "first_frame: 60", "frames 60 to 69"),
        ("width: 64", "width: 66", "66 x 48 px"),
    ],
)
def test_a_video_that_is_not_what_match_yaml_says_is_refused_at_once(
    filmed, project, old, new, told
):
    for file in (filmed / "match.yaml", filmed / "calibration.toml"):
        text = file.read_text()
        file.write_text(text.replace("64", "66", 2) if "width" in old else text.replace(old, new))
    with pytest.raises(InputError, match=told):
        project[1](filmed)


def test_given_boxes_take_the_place_of_the_detector(filmed, tmp_path, project, reading):
    store, compute = project
    _, before = compute(filmed, DETECTED)
    (tmp_path / "boxes").mkdir()
    # Two people in every other image of `right`, whose offset is 3 frames; images count from 1.
    lines = [
        f"{image + 1},{person},{image + 1.5},{10 * person + 1.5},8,400,0.9,-1,-1,-1"
        for image in range(0, 31, 2)
        for person in (1, 2)
    ]
    (tmp_path / "boxes" / "right.txt").write_text("\n".join(lines))
    assert import_boxes(tmp_path / "boxes", filmed) == {"right": 32}
    _, after = compute(filmed, DETECTED)
    changed = {name for name in after if after[name] != before[name]}
    assert changed == {"detection/right.early", "detection/right.late"}
    unit = ("filmed", "detection", "right.early", after["detection/right.early"])
    images = np.arange(2, 14) + 3
    expected = np.where((images % 2 == 0)[:, None], np.stack([images, images], axis=1), np.nan)
    found = store.open_result(*unit)["keypoints"].values[:, :, 0]
    np.testing.assert_array_equal(found[..., 0], expected)
    np.testing.assert_array_equal(found[..., 1], np.where(np.isnan(expected), np.nan, [10.0, 20.0]))
    manifest = store.manifest(*unit)
    assert manifest.figures["empty_share"] == 0.5
    assert not any("bundled detector" in text for text in manifest.warnings)


def test_other_weights_than_planned_with_are_refused(filmed, project, reading, monkeypatch):
    store, compute = project
    match, results = compute(filmed, "detection")
    stage = METHOD[NAMES.index("detection")]
    planned = RunPlan(store, match, {}, results=results).plan_stage(stage)
    monkeypatch.setattr(tasks.detection, "weights_of", lambda settings: {"embedded": "another"})
    with pytest.raises(InputError, match="planned with"):
        task_of(stage).fn(planned[0].work(store.url, match, "0001"))


@pytest.mark.parametrize(("tall", "told"), [(20.0, False), (900.0, True)])
def test_people_too_large_for_the_bundled_detector_are_told(
    filmed, project, reading, monkeypatch, tall, told
):
    boxes = np.array([[0.0, 0.0, 8.0, tall]])
    detect = staticmethod(lambda pictures: [People(boxes, np.array([0.9])) for _ in pictures])
    monkeypatch.setattr(Reading, "detect", detect)
    store, compute = project
    key = compute(filmed)[1]["detection/left.late"]
    warnings = store.manifest("filmed", "detection", "left.late", key).warnings
    assert any("people of 28 to 160 px" in text for text in warnings) == told


def test_boxes_of_one_camera_and_a_broken_video_do_not_refuse_the_match(tmp_path):
    folder = tmp_path / "match"
    write_filmed(folder, dict.fromkeys("abc", [10] * 5), [("clip", 0, 5)])
    video = folder / "videos" / "c.mp4"
    video.write_bytes(video.read_bytes()[:300])
    (folder / "boxes").mkdir()
    (folder / "boxes" / "a.txt").write_text("1,1,10,10,8,20,1\n")
    (folder / "boxes" / "c.txt").write_text("1,1,10,10,8,20,1\n")
    store = Store.create(tmp_path / "project")
    assert set(register(store, folder)[0].folder.boxes) == {"a", "c"}
    (folder / "boxes" / "a.txt").write_text("9,1,10,10,8,20,1\n")
    with pytest.raises(InputError, match=r"a\.txt"):
        register(store, folder)
