import hashlib
import os

import pytest

from worldpose.errors import InputError
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
        "annotations/pitch/cam1.json",
        "calibration.toml",
        "detections/cam1.npz",
        "detections/cam2.npz",
        "detections/goal.npz",
        "match.yaml",
        "pitch.json",
        "stills/cam1.png",
        "videos/cam1.mp4",
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
