import hashlib
import os
from dataclasses import replace

import numpy as np
import pytest
from pydantic import ValidationError

from data_contracts.match import CameraSpec
from worldpose.errors import InputError
from worldpose.ingest.clock import camera_frames, remaining_offset, simplest_offset
from worldpose.ingest.footage import UnitFrames
from worldpose.ingest.match_folder import read_match
from worldpose.ingest.registration import register_match

OLD = 1_700_000_000


@pytest.fixture
def folder(match_folder):
    """The tiny match with every kind of file, all of them old."""
    for name in ("videos/cam1.mp4", "stills/cam1.png", "annotations/pitch/cam1.json"):
        (match_folder / name).parent.mkdir(parents=True)
        (match_folder / name).write_bytes(name.encode())
    (match_folder / "pitch.json").write_text('{"length": 104.0}')
    (match_folder / "reference").mkdir()
    (match_folder / "reference" / "joints.npz").write_bytes(b"truth")
    (match_folder / "notes.txt").write_bytes(b"mine")
    settle(match_folder)
    return match_folder


def settle(folder):
    for path in folder.rglob("*"):
        os.utime(path, (OLD, OLD))


def register(folder, previous=None):
    return register_match(read_match(folder), previous)


def test_every_file_of_the_match_is_registered_with_its_digest(folder):
    registered = register(folder)
    assert [file.path for file in registered.files] == [
        *("annotations/pitch/cam1.json", "calibration.toml", "detections/cam1.npz"),
        *("detections/cam2.npz", "detections/goal.npz", "match.yaml", "pitch.json"),
        *("stills/cam1.png", "videos/cam1.mp4"),
    ]
    for file in registered.files:
        content = (folder / file.path).read_bytes()
        assert file.sha256 == hashlib.sha256(content).hexdigest()
        assert file.size == len(content)
    assert registered.folder == str(folder)


@pytest.mark.parametrize(
    ("name", "same"),
    [
        ("videos/cam1.mp4", False),
        ("detections/goal.npz", False),
        ("pitch.json", False),
        ("annotations/pitch/cam1.json", True),
        ("stills/cam1.png", True),
        ("calibration.toml", True),
        ("reference/joints.npz", True),
        ("notes.txt", True),
    ],
)
def test_identity_is_of_videos_detections_and_pitch(folder, name, same):
    before = register(folder)
    addition = b" " if name.endswith("json") else b"\n"
    (folder / name).write_bytes((folder / name).read_bytes() + addition)
    settle(folder)
    after = register(folder)
    assert (after.identity == before.identity) is same
    registered = {file.path for file in before.files}
    assert (after.files != before.files) is (name in registered)


def test_unchanged_files_are_not_read_again(folder, monkeypatch):
    first = register(folder)

    def refuse(file, digest):
        raise AssertionError(f"read {file.name}")

    monkeypatch.setattr(hashlib, "file_digest", refuse)
    assert register(folder, first) == first


def test_an_empty_file_is_refused(folder):
    (folder / "videos" / "cam1.mp4").write_bytes(b"")
    with pytest.raises(InputError, match="found 0 bytes") as caught:
        register(folder)
    assert caught.value.where.endswith("videos/cam1.mp4")


def test_a_file_that_changes_while_it_is_read_is_refused(folder, monkeypatch):
    digest = hashlib.file_digest

    def grow(file, name):
        with (folder / "videos" / "cam1.mp4").open("ab") as video:
            video.write(b"more")
        return digest(file, name)

    monkeypatch.setattr(hashlib, "file_digest", grow)
    with pytest.raises(InputError, match="still being written"):
        register(folder)


FRAME = np.arange(8)


@pytest.mark.parametrize(
    ("offset", "rate", "shown"),
    [
        (3, 1.0, [3, 4, 5, 6, 7, 8, 9, 10]),
        (((3, 0), (4, -2)), 1.0, [0, 1, 2, 3, 2, 3, 4, 5]),  # two frames lost after frame 3
        (((0, 0), (4, 2)), 1.0, [0, 2, 3, 5, 6, 7, 8, 9]),  # fast until frame 4
        (0, 0.5, [0, 1, 1, 2, 2, 3, 3, 4]),
    ],
)
def test_a_match_frame_has_its_nearest_camera_frame(offset, rate, shown):
    assert camera_frames(FRAME, offset, rate).tolist() == shown


def test_the_rest_is_how_much_later_the_camera_frame_is():
    # Exact frames are 0, 1.5, 3, 4.5, 6 at a rate of 1.5 frames per match frame.
    assert remaining_offset(FRAME[:5], 0, 1.5) == pytest.approx([0, 1 / 3, 0, 1 / 3, 0])


def test_people_of_a_fast_camera_lie_on_match_frames(make_people, tmp_path):
    people = make_people(0, 12)
    frames = UnitFrames(0, 8, ((0, 0), (4, 2)), ((0, 2), (4, 4)))
    placed = frames.place(tmp_path, replace(people, frame=np.arange(12)))
    np.testing.assert_array_equal(placed.frame, [0, 1, 4, 5, 6, 7])
    np.testing.assert_array_equal(placed.keypoints, people.keypoints[[0, 2, 6, 7, 8, 9]])


@pytest.mark.parametrize(
    ("offset", "kind", "told"),
    [
        (0.5, "static", r"in pairs as \[\[0, 0.5\]\]"),
        (((3, 1), (3, 2)), "static", "rising match frames"),
        ((), "static", "rising match frames"),
        (((0, 1), (9, 2)), "broadcast", "broadcast_offset_frames"),
        (7.0, "broadcast", "broadcast_offset_frames"),
    ],
)
def test_an_offset_that_cannot_be_read_is_refused(offset, kind, told):
    with pytest.raises(ValidationError, match=told):
        CameraSpec(id="a", width=9, height=9, kind=kind, offset_frames=offset)


@pytest.mark.parametrize(
    ("frame", "exact", "written"),
    [
        ([0], [-0.4], 0),
        ([0, 74, 75], [0.1, 0.1, -4.9], ((74, 0.0), (75, -5.0))),
        ([0, 999], [0.0, -5.674], ((0, 0.0), (999, -5.67))),
        ([5, 30, 31, 90], [2.0, 2.0, 0.0, 3.0], ((5, 2.0), (30, 2.0), (31, 0.0), (90, 3.0))),
    ],
)
def test_offsets_are_written_as_simply_as_they_are(frame, exact, written):
    assert simplest_offset(np.array(frame), np.array(exact)) == written
