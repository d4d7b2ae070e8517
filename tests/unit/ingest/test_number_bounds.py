"""Every number that a person gives has bounds; beyond them the file and the key are named."""

import json

import numpy as np
import pytest
import yaml

from worldpose.errors import InputError
from worldpose.formats.coco_results import read_coco_results
from worldpose.formats.keypoint_files import read_keypoint_arrays
from worldpose.formats.keypoint_sets import PEOPLE_LIMIT
from worldpose.ingest.match_folder import read_match


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


def test_a_clip_that_does_not_fit_into_memory_is_to_be_cut(tmp_path):
    content = spec() | {"clips": [{"id": "clip", "frame_count": 1_000_000}]}
    refused = refusal_of(tmp_path, content)
    assert refused.where == f"{tmp_path / 'match.yaml'}: clips[0].frame_count"
    assert "200000" in refused.expected
    assert "several clips" in refused.todo


@pytest.mark.parametrize(
    ("part", "key", "value"),
    [
        ("cameras", "width", 0),
        ("cameras", "width", 65537),
        ("cameras", "height", 10**12),
        ("cameras", "offset_frames", 1e300),
        ("cameras", "offset_frames", 2**31),
        ("cameras", "fps", 1e9),
        ("clips", "first_frame", 10**18),
        ("clips", "first_frame", -(10**18)),
        ("clips", "frame_count", 10**12),
        ("clips", "frame_count", 0),
        ("clips", "broadcast_offset_frames", 1e300),
        ("clips", "people", {-3: "kane"}),
    ],
)
def test_numbers_of_a_match_are_bounded(tmp_path, part, key, value):
    content = spec()
    content[part][0][key] = value
    refused = refusal_of(tmp_path, content)
    assert refused.where.startswith(f"{tmp_path / 'match.yaml'}: {part}[0].{key}")


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
    with pytest.raises(InputError, match=r"b.npz: score: expected at most 1000 people per frame"):
        read_keypoint_arrays(tmp_path / "b.npz")


def test_coco_results_have_at_most_1000_people_per_frame(tmp_path):
    person = {"image_id": 7, "keypoints": [5.0, 5.0, 1.0] * 17}
    (tmp_path / "a.json").write_text(json.dumps([person] * (PEOPLE_LIMIT + 1)))
    with pytest.raises(InputError, match="at most 1000 people per frame, found 1001 in frame 7"):
        read_coco_results(tmp_path / "a.json")
