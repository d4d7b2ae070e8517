"""A file of which some bytes were exchanged is read, or refused with its place."""

import io
import json
from pathlib import Path

import numpy as np
import pytest
from calibration_writers import WRITERS, rig
from hypothesis import given, settings
from hypothesis import strategies as st
from test_calibration_files import ANIPOSE, QUALISYS
from test_coco_results import person

from worldpose.errors import InputError
from worldpose.formats.calibration_forms import read_calibration
from worldpose.formats.coco_results import read_coco_results
from worldpose.formats.keypoint_files import read_keypoint_arrays
from worldpose.ingest.match_folder import read_match

MATCH_YAML = """contract: 1
match_id: final
fps: 25
cameras:
- {id: cam1, width: 1920, height: 1080, video: v.mp4, still: s.png}
- {id: main, kind: broadcast, width: 1920, height: 1080}
clips:
- {id: clip, first_frame: 0, frame_count: 3}
pitch: none
"""


def npz():
    packed = io.BytesIO()
    zeros = np.zeros((1, 1, 17, 2), np.float32)
    boxes, score = zeros[:, :, :2].reshape(1, 1, 4), zeros[:, :, 0, 0]
    arrays = {"keypoints": zeros, "confidence": zeros[..., 0] + 0.5, "boxes": boxes, "score": score}
    np.savez(packed, frame=np.zeros(1, np.int64), **arrays)
    return packed.getvalue()


def read_folder(file):
    for name in ("v.mp4", "s.png"):
        (file.parent / name).write_bytes(b"x")
    return read_match(file.parent)


PLAIN = {
    "match.yaml": (MATCH_YAML.encode(), read_folder),
    "calibration.toml": (ANIPOSE.encode(), read_calibration),
    "rig.qca.txt": (QUALISYS.encode(), read_calibration),
    "cam1.json": (json.dumps([person(), person(1)]).encode(), read_coco_results),
    "cam1.npz": (npz(), read_keypoint_arrays),
}


@settings(max_examples=300, deadline=None)
@given(
    st.sampled_from(sorted({*PLAIN, *WRITERS})),
    st.floats(0, 1),
    st.integers(0, 30),
    st.binary(max_size=6) | st.text(st.sampled_from("{}[]:,-&*!|'\"% \n#01.~/<>=e")),
)
def test_a_spoilt_file_is_read_or_refused(tmp_path_factory, form, share, length, insert):
    folder = Path(tmp_path_factory.mktemp("spoilt"))
    if form in PLAIN:
        content, read = PLAIN[form]
        path = spoilt = folder / form
    else:
        path, read = WRITERS[form](folder, rig()), read_calibration
        spoilt = path if path.is_file() else next(f for f in sorted(path.rglob("*")) if f.is_file())
        content = spoilt.read_bytes()
    start = int(share * len(content))
    insert = insert if isinstance(insert, bytes) else insert.encode()
    spoilt.write_bytes(content[:start] + insert + content[start + length :])
    try:
        assert read(path)
    except InputError as error:
        assert str(folder) in error.where


@pytest.mark.parametrize("key", ["image_id", "keypoints", "bbox", "score"])
@pytest.mark.parametrize("value", [None, True, -1, 2**70, float("nan"), "1", [], {}, [[1.0] * 51]])
def test_any_value_of_a_result_is_read_or_refused(tmp_path, key, value):
    path = tmp_path / "cam1.json"
    path.write_text(json.dumps([person(), person(1, **{key: value})]))
    try:
        assert np.all(np.diff(read_coco_results(path).people.frame) > 0)
    except InputError as error:
        assert str(path) in error.where
