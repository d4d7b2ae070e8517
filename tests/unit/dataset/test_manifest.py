"""A manifest tells what a release is, and notices any other byte."""

import json

import numpy as np
import pytest

from data_contracts.release import ReleasedClip, ReleaseManifest
from data_contracts.usability import Usability
from worldpose.dataset.manifest import (
    ORIGINS,
    changed_files,
    origins_of,
    read_manifest,
    released_files,
    write_manifest,
    write_origins,
)
from worldpose.errors import InputError
from worldpose.formats.joints_file import JointTracks


def manifest_of(folder, **changes):
    (folder / "poses").mkdir(exist_ok=True)
    (folder / "poses" / "A_1.npz").write_bytes(b"poses")
    (folder / "joints.npz").write_bytes(b"joints")
    fields = {
        "release": "first",
        "match_id": "final",
        "run_id": "0003",
        "formats": ("worldpose", "joints"),
        "fps": 50.0,
        "clips": {
            "A_1": ReleasedClip(first_frame=100, frame_count=2, person_ids=(0, 4), origins={})
        },
        "pictures": {"north": (1920, 1080)},
        "pitch": True,
        "body_model": "open-neutral/2",
        "licence": "For tests.",
        "usability": Usability(verdict="usable"),
        "worldpose": "0.1.0",
        "versions": {"numpy": "2.4"},
        "settings": {"tracking": {"a": 1}},
        "results": {"tracking/A_1": "0" * 32},
        "files": released_files(folder, [folder / "poses" / "A_1.npz", folder / "joints.npz"]),
    }
    return ReleaseManifest(**{**fields, **changes})


def test_a_manifest_comes_back_and_holds_the_conventions(tmp_path):
    manifest = manifest_of(tmp_path)
    path = write_manifest(tmp_path, manifest)
    assert read_manifest(tmp_path) == manifest
    stored = json.loads(path.read_text())
    assert "x_cam = R x_world + t" in stored["conventions"]["camera"]
    assert stored["files"][0]["path"] == "joints.npz"
    assert stored["files"][0]["size"] == 6
    write_manifest(tmp_path / "again", manifest)
    assert (tmp_path / "again" / "manifest.json").read_bytes() == path.read_bytes()


def test_a_changed_and_a_lost_file_are_noticed(tmp_path):
    manifest = manifest_of(tmp_path)
    assert changed_files(tmp_path, manifest.files) == []
    (tmp_path / "poses" / "A_1.npz").write_bytes(b"p0ses")
    assert changed_files(tmp_path, manifest.files) == ["poses/A_1.npz"]
    (tmp_path / "joints.npz").unlink()
    assert changed_files(tmp_path, manifest.files) == ["joints.npz", "poses/A_1.npz"]


def test_a_folder_without_a_manifest_has_none_and_another_contract_is_refused(tmp_path):
    assert read_manifest(tmp_path) is None
    path = write_manifest(tmp_path, manifest_of(tmp_path))
    path.write_text(path.read_text().replace('"contract": 1,', '"contract": 2,', 1))
    with pytest.raises(InputError, match="contract 1"):
        read_manifest(tmp_path)
    fields = json.loads(write_manifest(tmp_path, manifest_of(tmp_path)).read_text())
    path.write_text(json.dumps({name: fields[name] for name in fields if name != "usability"}))
    with pytest.raises(InputError, match=r"usability: Field required: another version.*again with"):
        read_manifest(tmp_path)


def test_origins_tell_absent_automatic_filled_and_corrected_joints(tmp_path):
    joints = np.ones((2, 1, 17, 3))
    joints[1, 0, 3] = np.nan
    views = np.full((2, 1, 17), 4)
    views[0, 0, 5] = 0
    views[1, 0, 3] = 0
    corrected = np.zeros((2, 1, 17), bool)
    corrected[0, 0, 7] = True
    tracks = JointTracks(np.arange(2), np.array([4]), joints, views=views)
    origin = origins_of(tracks, corrected)
    names = np.array(ORIGINS)[origin]
    assert names[0, 0, 5] == "filled"
    assert names[0, 0, 7] == "corrected"
    assert names[1, 0, 3] == "absent"
    assert (names == "automatic").sum() == 2 * 17 - 3
    write_origins(tmp_path / "A_1.npz", tracks, origin)
    np.testing.assert_array_equal(np.load(tmp_path / "A_1.npz")["origin"], origin)
