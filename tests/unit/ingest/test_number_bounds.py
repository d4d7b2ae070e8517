"""Every number that a person gives has bounds; beyond them the file and the key are named."""

import json

import numpy as np
import pytest
import yaml
from pydantic import ValidationError

from data_contracts.match import MatchSpec
from data_contracts.review import AddedDetection, DeletedDetection, MergedTracks, MovedPoint
from worldpose.errors import InputError
from worldpose.formats.calibration_files import read_calibration_toml
from worldpose.formats.keypoint_files import PEOPLE_LIMIT, read_coco_results, read_keypoint_arrays
from worldpose.ingest.match_folder import read_match

CAMERA = {
    "size": [1920, 1080],
    "matrix": [[1500.0, 0.0, 959.5], [0.0, 1500.0, 539.5], [0.0, 0.0, 1.0]],
    "distortions": [0.0, 0.0, 0.0, 0.0, 0.0],
    "rotation": [0.1, 0.2, 0.3],
    "translation": [1.0, 2.0, 30.0],
}


def spec(**camera):
    return {
        "match_id": "m",
        "fps": 25,
        "cameras": [{"id": "a", "width": 1920, "height": 1080, **camera}],
        "clips": [{"id": "clip", "frame_count": 5}],
    }


def refusal_of(folder, content):
    (folder / "match.yaml").write_text(yaml.safe_dump(content))
    with pytest.raises(InputError) as caught:
        read_match(folder)
    return caught.value


@pytest.mark.parametrize("fps", [0.0, 0.5, 1000.5, 25000.0, 1e9, -25.0])
def test_frame_rates_lie_between_1_and_1000(tmp_path, fps):
    refused = refusal_of(tmp_path, {**spec(), "fps": fps})
    assert refused.where == f"{tmp_path / 'match.yaml'}: fps"
    assert str(fps) in refused.found


def test_a_clip_that_does_not_fit_into_memory_is_to_be_cut(tmp_path):
    content = spec() | {"clips": [{"id": "clip", "frame_count": 1_000_000}]}
    refused = refusal_of(tmp_path, content)
    assert refused.where == f"{tmp_path / 'match.yaml'}: clips[0].frame_count"
    assert "200000" in refused.expected
    assert "several clips" in refused.todo


@pytest.mark.parametrize("fps", [1.0, 23.976, 25, 240, 1000.0])
def test_usual_frame_rates_are_taken(fps):
    assert MatchSpec.model_validate({**spec(), "fps": fps}).fps == fps


@pytest.mark.parametrize(
    ("key", "value"),
    [
        ("width", 0),
        ("width", 65537),
        ("height", 10**12),
        ("offset_frames", 1e300),
        ("offset_frames", 2**31),
        ("fps", 1e9),
    ],
)
def test_numbers_of_a_camera_are_bounded(tmp_path, key, value):
    refused = refusal_of(tmp_path, spec(**{key: value}))
    assert refused.where == f"{tmp_path / 'match.yaml'}: cameras[0].{key}"


@pytest.mark.parametrize(
    ("key", "value"),
    [
        ("first_frame", 10**18),
        ("first_frame", -(10**18)),
        ("frame_count", 10**12),
        ("frame_count", 0),
        ("broadcast_offset_frames", 1e300),
        ("people", {-3: "kane"}),
    ],
)
def test_numbers_of_a_clip_are_bounded(tmp_path, key, value):
    content = spec()
    content["clips"][0][key] = value
    refused = refusal_of(tmp_path, content)
    assert refused.where.startswith(f"{tmp_path / 'match.yaml'}: clips[0].{key}")


def toml_refusal(tmp_path, **changes):
    table = {**CAMERA, **changes}
    lines = ["[a]", *(f"{key} = {json.dumps(value)}" for key, value in table.items())]
    (tmp_path / "calibration.toml").write_text("\n".join(lines))
    with pytest.raises(InputError) as caught:
        read_calibration_toml(tmp_path / "calibration.toml")
    return caught.value


def matrix(focal=1500.0, center=(959.5, 539.5)):
    return [[focal, 0.0, center[0]], [0.0, focal, center[1]], [0.0, 0.0, 1.0]]


@pytest.mark.parametrize(
    ("changes", "key", "told"),
    [
        ({"matrix": matrix(8.25)}, "focal length", "in pixels"),
        ({"matrix": matrix(1e-9)}, "focal length", "in pixels"),
        ({"matrix": matrix(1e8)}, "focal length", "in pixels"),
        ({"matrix": matrix(-1500.0)}, "focal length", "in pixels"),
        ({"matrix": matrix(center=(1e6, 3.0))}, "principal point", "in pixels"),
        ({"rotation": [90.0, 10.0, -45.0]}, "rotation", "degrees"),
        ({"translation": [1e8, 0.0, 0.0]}, "translation", "metres"),
        ({"size": [10**6, 10**6]}, "size", "pixels"),
    ],
)
def test_numbers_of_a_given_camera_are_bounded(tmp_path, changes, key, told):
    refused = toml_refusal(tmp_path, **changes)
    assert key in refused.where
    assert str(tmp_path / "calibration.toml") in refused.where
    assert told in str(refused)


def save(path, people, pack=np.savez):
    shape = (2, people)
    pack(
        path,
        frame=np.arange(2),
        keypoints=np.full((*shape, 17, 2), np.nan, np.float32),
        confidence=np.full((*shape, 17), np.nan, np.float32),
        boxes=np.full((*shape, 4), np.nan, np.float32),
        score=np.full(shape, np.nan, np.float32),
    )


def test_an_npz_has_at_most_1000_people_per_frame(tmp_path):
    save(tmp_path / "a.npz", PEOPLE_LIMIT)
    assert read_keypoint_arrays(tmp_path / "a.npz").score.shape == (2, PEOPLE_LIMIT)
    save(tmp_path / "b.npz", PEOPLE_LIMIT + 1)
    with pytest.raises(
        InputError, match=r"b.npz: score.npy: expected at most 1000 people per frame"
    ):
        read_keypoint_arrays(tmp_path / "b.npz")


def test_a_small_file_does_not_unpack_to_gigabytes(tmp_path, monkeypatch):
    monkeypatch.setattr("worldpose.formats.archives.PACKED_BYTES", 1 << 16)
    save(tmp_path / "a.npz", PEOPLE_LIMIT, np.savez_compressed)
    with pytest.raises(InputError, match="arrays packed at most 200 to 1"):
        read_keypoint_arrays(tmp_path / "a.npz")


def test_coco_results_have_at_most_1000_people_per_frame(tmp_path):
    person = {"image_id": 7, "keypoints": [5.0, 5.0, 1.0] * 17}
    (tmp_path / "a.json").write_text(json.dumps([person] * (PEOPLE_LIMIT + 1)))
    with pytest.raises(
        InputError, match="at most 1000 people per frame, found 1001 with image_id 7"
    ):
        read_coco_results(tmp_path / "a.json")


@pytest.mark.parametrize(
    ("record", "values"),
    [
        (DeletedDetection, {"camera": "a", "frame": 10**30, "detection": 0}),
        (DeletedDetection, {"camera": "a", "frame": 0, "detection": -1}),
        (AddedDetection, {"camera": "a", "frame": 0, "detection": 10**9, "box": (0, 0, 1, 1)}),
        (AddedDetection, {"camera": "a", "frame": 0, "detection": 1, "box": (0, 0, 1e300, 1)}),
        (MergedTracks, {"clip": "c", "kept": 10**40, "merged": 1}),
        (MovedPoint, {"camera": "a", "marking": "center_mark", "xy": (1e300, 2.0)}),
    ],
)
def test_numbers_of_a_correction_are_bounded(record, values):
    with pytest.raises(ValidationError):
        record.model_validate(values)
