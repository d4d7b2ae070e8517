"""Files of arrays, of text and of tables: what is written is read, and what lies is refused."""

import io
import json
import sys
import zipfile
from dataclasses import replace

import numpy as np
import pandas as pd
import pytest

from data_contracts.conventions import COCO17
from worldpose.body.model import BodyParameters
from worldpose.errors import InputError, UsageError
from worldpose.formats import files
from worldpose.formats.archives import read_npz
from worldpose.formats.files import read_json, read_toml, read_yaml
from worldpose.formats.joints_file import (
    JointTracks,
    fill_gaps,
    read_joints,
    read_poses,
    write_joints,
    write_poses,
)
from worldpose.formats.tables import joints_table, write_csv, write_parquet


@pytest.fixture
def tracks():
    rng = np.random.default_rng(0)
    joints = rng.normal(0.0, 10.0, (3, 2, 17, 3))
    joints[1, 0, 4] = np.nan
    return JointTracks(
        frames=np.array([10, 11, 13]),
        person_ids=np.array([4, 2]),
        joints=joints,
        covariance=rng.random((3, 2, 17, 3, 3)),
        views=rng.integers(0, 18, (3, 2, 17)),
        source=rng.integers(0, 4, (3, 2, 17)),
    )


def same(a, b):
    for name in ("frames", "person_ids", "joints", "covariance", "views", "source"):
        np.testing.assert_array_equal(getattr(a, name), getattr(b, name))


def test_what_is_written_is_read(tmp_path, tracks):
    write_joints(tmp_path / "joints.npz", tracks)
    same(read_joints(tmp_path / "joints.npz"), tracks)
    write_joints(tmp_path / "bare.npz", replace(tracks, covariance=None, views=None, source=None))
    bare = read_joints(tmp_path / "bare.npz")
    assert (bare.covariance, bare.views, bare.source) == (None, None, None)


def test_numpy_alone_reads_it_with_the_documented_types(tmp_path, tracks):
    write_joints(tmp_path / "joints.npz", tracks)
    with np.load(tmp_path / "joints.npz", allow_pickle=False) as file:
        assert {name: file[name].dtype.str for name in file} == {
            "frames": "<i8",
            "person_ids": "<i8",
            "joints": "<f8",
            "covariance": "<f8",
            "views": "|u1",
            "source": "|u1",
        }


def arrays(**changes):
    plain = {"frames": np.arange(3), "person_ids": np.arange(2), "joints": np.zeros((3, 2, 17, 3))}
    return {name: value for name, value in {**plain, **changes}.items() if value is not None}


INFINITE = np.zeros((3, 2, 17, 3))
INFINITE[2, 1, 9, 0] = np.inf
HALF_MISSING = np.zeros((3, 2, 17, 3))
HALF_MISSING[0, 1, 0, 2] = np.nan


@pytest.mark.parametrize(
    "changes",
    [
        {"frames": np.arange(3) * 1.04},
        {"person_ids": np.array([0.5, 1.5])},
        {"views": np.full((3, 2, 17), 300)},
        {"person_ids": ["a", "b"]},
        {"frames": [0, None, 2]},
    ],
)
def test_numbers_that_a_file_would_cut_are_refused(changes):
    with pytest.raises(InputError, match=f"{next(iter(changes))}: expected whole numbers"):
        JointTracks(**arrays(**changes))


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"joints": None}, "expected the members frames, person_ids, joints .*found frames"),
        ({"joint": np.zeros(3)}, "expected the members"),
        ({"joints": np.zeros((3, 2, 15, 3))}, r"joints: expected shape \(3, 2, 17, 3\), found"),
        ({"joints": np.zeros((3, 2, 17, 3), dtype=int)}, "expected float numbers, found <i8"),
        ({"frames": np.arange(3.0)}, "frames: expected int numbers"),
        ({"frames": np.array([0, 2, 1])}, "frames: expected frame numbers that rise"),
        ({"person_ids": np.array([1, 1])}, "person_ids: expected each id once"),
        ({"joints": INFINITE}, r"joints\[frame 2, person 1, left_wrist\]: expected finite metres"),
        ({"joints": HALF_MISSING}, r"joints\[frame 0, person 1, nose\]: expected all of x, y, z"),
        ({"views": np.full((3, 2, 17), -1)}, "views.*expected counts from 0"),
        ({"covariance": np.full((3, 2, 17, 3, 3), np.inf)}, "covariance.*expected finite"),
        ({"joints": np.array([{}], dtype=object)}, "joints.npy: expected numbers"),
    ],
)
def test_what_does_not_fit_is_named(tmp_path, changes, message):
    np.savez(tmp_path / "bad.npz", **arrays(**changes))
    with pytest.raises(InputError, match=message) as caught:
        read_joints(tmp_path / "bad.npz")
    assert str(tmp_path / "bad.npz") in str(caught.value)


@pytest.fixture
def poses():
    rng = np.random.default_rng(0)
    transl = rng.uniform(-50.0, 50.0, (3, 5, 3))
    transl[1, 2] = np.nan
    return BodyParameters(
        rng.standard_normal((3, 1, 10)),
        rng.standard_normal((3, 5, 3)),
        rng.standard_normal((3, 5, 69)),
        transl,
    )


def test_poses_come_back_in_single_precision(poses, tmp_path):
    write_poses(tmp_path / "clip.npz", poses, "open-neutral/2")
    back, body_model = read_poses(tmp_path / "clip.npz")
    assert body_model == "open-neutral/2"
    for name in ("betas", "global_orient", "body_pose", "transl"):
        np.testing.assert_array_equal(
            getattr(back, name), getattr(poses, name).astype(np.float32).astype(np.float64)
        )
    with np.load(tmp_path / "clip.npz") as file:
        assert {name: file[name].shape for name in file.files} == {
            "betas": (3, 10),
            "global_orient": (3, 5, 3),
            "body_pose": (3, 5, 69),
            "transl": (3, 5, 3),
            "body_model": (1,),
        }


def test_a_file_without_an_array_is_refused(tmp_path):
    np.savez(tmp_path / "half.npz", betas=np.zeros((1, 10)))
    with pytest.raises(InputError, match=r"half\.npz"):
        read_poses(tmp_path / "half.npz")


def written(path, **members):
    with zipfile.ZipFile(path, "w", zipfile.ZIP_DEFLATED) as file:
        for name, content in members.items():
            if not isinstance(content, bytes):
                form = io.BytesIO()
                np.lib.format.write_array(form, content, version=(1, 0))
                content = form.getvalue()
            file.writestr(f"{name}.npy", content)
    return path


def header(text):
    return b"\x93NUMPY\x01\x00" + len(text).to_bytes(2, "little") + text.encode()


@pytest.mark.parametrize(
    ("content", "told"),
    [
        (
            header("{'descr': '<f4', 'fortran_order': False, 'shape': (10, 10**12), }\n"),
            "npy array",
        ),
        (header("{'descr': '<f4', 'fortran_order': False, 'shape': (10, 100), }\n"), "4073 bytes"),
        (header("[" * 3000 + "]" * 3000), "npy array"),
        (header("__import__('os').system('id')\n"), "npy array"),
        (header("{'descr': '<z9', 'fortran_order': False, 'shape': (1,), }\n"), "z9"),
        (header("{'descr': [('x', '<f4')], 'fortran_order': False, 'shape': (1,)}\n"), "plain"),
        (b"", "npy array"),
    ],
)
def test_a_member_that_lies_is_named(tmp_path, content, told):
    path = written(tmp_path / "a.npz", score=content)
    with pytest.raises(InputError, match=told) as caught:
        read_npz(path, 10**6)
    assert caught.value.where == f"{path}: score.npy"
    assert len(str(caught.value)) < 600


def test_arrays_beyond_the_limit_are_not_unpacked(tmp_path):
    path = written(tmp_path / "a.npz", score=np.zeros(1000))
    with pytest.raises(InputError, match="at most 7000 bytes of arrays, found 8128 bytes"):
        read_npz(path, 7000)


def test_a_packed_size_that_is_more_than_the_file_does_not_excuse_a_bomb(tmp_path):
    path = written(tmp_path / "a.npz", a=np.zeros((1 << 20, 9)))
    with pytest.raises(InputError, match="packed at most 200 to 1"):
        read_npz(path, 1 << 30)
    content = bytearray(path.read_bytes())
    directory = content.rindex(b"PK\x01\x02")
    content[directory + 20 : directory + 24] = (1 << 30).to_bytes(4, "little")
    path.write_bytes(content)
    with pytest.raises(InputError, match="packed at most 200 to 1"):
        read_npz(path, 1 << 30)


LARGE = "#" * (files.SETTINGS_BYTES + 1)


@pytest.mark.parametrize(
    ("read", "content", "words"),
    [
        (read_yaml, "a: &x [1, 2]\nb: *x\n", "alias"),
        (read_yaml, "1: a\n'1': b\n", "'1' is given twice"),
        (read_yaml, "a: " + "[" * 100, "more than 32 levels"),
        (read_yaml, "? [a]\n: 1\n", "unhashable"),
        (read_yaml, "a: 1\n--- \nb: 2\n", "but found another document"),
        (read_yaml, "!!python/object/apply:os.system [x]", "python/object"),
        (read_yaml, "a: b: c\n", "line 1, column 5"),
        *((read_yaml, f"f: {v}\n", "") for v in ('!!int ""', "!!bool maybe", "!!timestamp soon")),
        (read_yaml, "a: " + "9" * 5000, "digits"),
        (read_yaml, b"a: \xff\n", "UTF-8"),
        (read_yaml, b"a: \x00\n", "YAML"),
        (read_yaml, "- a\n" * 1001, "more than 1000 entries"),
        *((read, LARGE, "2097153 bytes") for read in (read_yaml, read_json, read_toml)),
        *(
            (read_json, t, "expected JSON")
            for t in ("[" * 100_000, '{"a": ', "[" + "9" * 5000 + "]")
        ),
        (read_toml, "a" + ".a" * 300_000 + " = 1", "lines of at most 4096"),
        *((read_toml, t, "expected TOML") for t in ("a = ", "a = 1\na = 2", "a = " + "[" * 4000)),
        (read_toml, "x = 2024-99-99", "expected TOML"),
    ],
)
def test_hostile_or_broken_text_is_refused(tmp_path, monkeypatch, read, content, words):
    monkeypatch.setattr(files, "EVENTS", 1000)
    path = tmp_path / "file"
    path.write_bytes(content if isinstance(content, bytes) else content.encode())
    with pytest.raises(InputError) as caught:
        read(path)
    assert words in str(caught.value)
    assert str(path) in caught.value.where


FPS = 50.0
NOTES = {"licence": "For tests alone.", "joints": "COCO-17"}


@pytest.fixture
def tracks_of_kinds():
    joints = np.random.default_rng(0).uniform(-50.0, 50.0, (4, 2, 17, 3))
    joints[1, 1] = np.nan
    covariance = np.zeros((4, 2, 17, 3, 3)) + np.diag([1e-4, 4e-4, 9e-4])
    views = np.full((4, 2, 17), 3)
    views[2, 0, 4] = 0
    source = np.full(views.shape, 2)
    source[:, :, 9] = 3
    return JointTracks(
        np.arange(100, 104), np.array([4, 9]), joints, covariance, views, source=source
    )


def walker(speed=2.0, stride_s=0.9, seconds=5.0):
    """A person who walks along (0.6, 0.8), whose ankles swing 0.4 m about the hips."""
    time = np.arange(round(seconds * FPS)) / FPS
    direction = np.array([0.6, 0.8, 0.0])
    joints = np.zeros((len(time), 1, 17, 3)) + (speed * time[:, None] * direction)[:, None, None]
    for joint, phase in ((15, 0.0), (16, np.pi)):
        swing = 0.4 * np.sin(2 * np.pi * time / stride_s + phase)
        joints[:, 0, joint] += swing[:, None] * direction
    return JointTracks(np.arange(len(time)) + 7, np.array([3]), joints)


def check_joints(table, tracks, atol):
    assert len(table) == 2 * 4 * 17 - 17
    assert list(table.columns[5:11]) == ["x_m", "y_m", "z_m", "x_std_m", "y_std_m", "z_std_m"]
    row = table[(table.frame == 102) & (table.person == 4) & (table.joint == "right_ear")]
    np.testing.assert_allclose(
        row[["x_m", "y_m", "z_m"]].to_numpy()[0], tracks.joints[2, 0, 4], atol=atol
    )
    np.testing.assert_allclose(row[["x_std_m", "z_std_m"]].to_numpy()[0], [0.01, 0.03])
    assert row.time_s.item() == pytest.approx(2.04)
    assert (row.views.item(), row.filled.item(), row.kind.item()) == (0, True, "triangulated")
    assert table.filled.sum() == 1
    assert ((table.source == 3) == (table.joint == "left_wrist")).all()
    assert set(table.source) == {2, 3}
    assert set(table[table.person == 9].kind) == {"mixed"}
    assert not ((table.frame == 101) & (table.person == 9)).any()


def test_joints_come_back_from_csv(tracks_of_kinds, tmp_path):
    table = joints_table(tracks_of_kinds, FPS, {4: "triangulated", 9: "mixed"})
    file, about = write_csv(tmp_path / "a.csv", table, NOTES)
    back = pd.read_csv(file)
    check_joints(back, tracks_of_kinds, 5.1e-6)  # written to 0.01 mm
    description = json.loads(about.read_text())
    assert [column["name"] for column in description["tableSchema"]["columns"]] == list(back)
    assert (about.name, description["dc:license"]) == ("a.csv-metadata.json", "For tests alone.")


def test_joints_come_back_from_parquet_exactly(tracks_of_kinds, tmp_path):
    parquet = pytest.importorskip("pyarrow.parquet")
    table = joints_table(tracks_of_kinds, FPS, {4: "triangulated", 9: "mixed"})
    (file,) = write_parquet(tmp_path / "a.parquet", table, NOTES)
    check_joints(pd.read_parquet(file), tracks_of_kinds, 0.0)
    assert parquet.read_schema(file).metadata[b"licence"] == b"For tests alone."
    assert list(pd.read_parquet(file).joint.cat.categories) == list(COCO17)


def test_parquet_without_pyarrow_is_refused(tracks_of_kinds, tmp_path, monkeypatch):
    # Before: a first table without pyarrow would decide how pandas stores strings from then on.
    table = pd.DataFrame({"a": [1]})
    monkeypatch.setitem(sys.modules, "pyarrow", None)
    with pytest.raises(UsageError, match=r"pip install 'worldpose\[tables\]'"):
        write_parquet(tmp_path / "a.parquet", table, NOTES)
    assert not (tmp_path / "a.parquet").exists()


def test_gaps_are_filled_on_the_way_and_flagged():
    whole = walker()
    joints, covariance = whole.joints.copy(), np.zeros((250, 1, 17, 3, 3)) + np.eye(3)
    joints[:10], joints[-10:] = np.nan, np.nan
    joints[100:104] = np.nan
    keep = np.delete(np.arange(250), 200)  # a frame that all people lack
    views = np.full((249, 1, 17), 4)
    gappy = JointTracks(whole.frames[keep], whole.person_ids, joints[keep], covariance[keep], views)
    filled = fill_gaps(gappy)
    np.testing.assert_array_equal(filled.frames, whole.frames)
    assert np.isnan(filled.joints[:10]).all() and np.isnan(filled.joints[-10:]).all()
    there = np.r_[10:240]
    # Hips move straight; ankles swing with 2.8 m/s relative to them, so that 0.1 s bend little.
    np.testing.assert_allclose(filled.joints[there, 0, 11], whole.joints[there, 0, 11], atol=1e-9)
    np.testing.assert_allclose(filled.joints[there], whole.joints[there], atol=0.01)
    made = np.zeros(250, bool)
    made[[*range(100, 104), 200]] = True
    np.testing.assert_array_equal(filled.views[there, 0, 3] == 0, made[there])
    np.testing.assert_array_equal(np.isnan(filled.covariance[there, 0, 3, 0, 0]), made[there])
    np.testing.assert_array_equal(filled.joints[~made], joints[~made])
