"""Tables of people come back from pandas and pyarrow with their units and notes."""

import json
import sys

import numpy as np
import pandas as pd
import pytest

from data_contracts.conventions import COCO17
from worldpose.errors import UsageError
from worldpose.formats.joints_file import JointTracks, fill_gaps
from worldpose.formats.tables import joints_table, write_csv, write_parquet

FPS = 50.0
NOTES = {"licence": "For tests alone.", "joints": "COCO-17"}


@pytest.fixture
def tracks():
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


def test_joints_come_back_from_csv(tracks, tmp_path):
    table = joints_table(tracks, FPS, {4: "triangulated", 9: "mixed"})
    file, about = write_csv(tmp_path / "a.csv", table, NOTES)
    back = pd.read_csv(file)
    check_joints(back, tracks, 5.1e-6)  # written to 0.01 mm
    description = json.loads(about.read_text())
    assert [column["name"] for column in description["tableSchema"]["columns"]] == list(back)
    assert (about.name, description["dc:license"]) == ("a.csv-metadata.json", "For tests alone.")


def test_joints_come_back_from_parquet_exactly(tracks, tmp_path):
    parquet = pytest.importorskip("pyarrow.parquet")
    table = joints_table(tracks, FPS, {4: "triangulated", 9: "mixed"})
    (file,) = write_parquet(tmp_path / "a.parquet", table, NOTES)
    check_joints(pd.read_parquet(file), tracks, 0.0)
    assert parquet.read_schema(file).metadata[b"licence"] == b"For tests alone."
    assert list(pd.read_parquet(file).joint.cat.categories) == list(COCO17)


def test_parquet_without_pyarrow_is_refused(tracks, tmp_path, monkeypatch):
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
