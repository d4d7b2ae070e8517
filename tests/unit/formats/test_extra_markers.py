"""Heels and toes come back from every file of joints; files without them stay as they were."""

from dataclasses import replace

import numpy as np
import pytest

from data_contracts.conventions import COCO17, FEET
from worldpose.errors import InputError
from worldpose.formats.c3d_file import write_c3d
from worldpose.formats.joints_file import ExtraTracks, JointTracks, read_joints, write_joints

FPS = 50.0


@pytest.fixture
def tracks():
    """Two people over four frames; a toe of the second is missing in one of them."""
    rng = np.random.default_rng(0)
    shape = (4, 2, 6)
    feet = rng.uniform(-50.0, 50.0, (*shape, 3))
    feet[1, 1, 3] = np.nan
    views = np.full(shape, 3)
    views[2, 1, 5] = 0
    extra = ExtraTracks(FEET, feet, np.zeros((*shape, 3, 3)) + 4e-4 * np.eye(3), views)
    return JointTracks(
        np.arange(100, 104),
        np.array([4, 9]),
        rng.uniform(-50.0, 50.0, (4, 2, 17, 3)),
        np.zeros((4, 2, 17, 3, 3)) + 1e-4 * np.eye(3),
        np.full((4, 2, 17), 5),
        extra,
    )


def test_a_joints_file_keeps_them(tracks, tmp_path):
    write_joints(tmp_path / "a.npz", tracks)
    back = read_joints(tmp_path / "a.npz").extra
    assert back.points == FEET
    for name in ("joints", "covariance", "views"):
        np.testing.assert_array_equal(getattr(back, name), getattr(tracks.extra, name))
    bare = replace(tracks, extra=replace(tracks.extra, covariance=None, views=None))
    write_joints(tmp_path / "b.npz", bare)
    back = read_joints(tmp_path / "b.npz").extra
    assert back.covariance is None and back.views is None


@pytest.mark.parametrize(
    ("change", "word"),
    [
        ({"points": ("nose", *FEET[1:])}, "none of COCO-17"),
        ({"points": (FEET[1], *FEET[1:])}, "each name once"),
        ({"joints": np.zeros((4, 2, 5, 3))}, "extra_joints"),
        ({"views": np.zeros((4, 2, 6, 1), int)}, "extra_views"),
        (
            {"joints": np.full((4, 2, 6, 3), [np.nan, 0.0, 0.0])},
            "extra_joints.*all of x, y, z or none",
        ),
    ],
)
def test_wrong_points_are_refused(tracks, change, word):
    with pytest.raises(InputError, match=word):
        replace(tracks, extra=replace(tracks.extra, **change))


def test_names_without_points_are_refused(tracks, tmp_path):
    write_joints(tmp_path / "a.npz", tracks)
    with np.load(tmp_path / "a.npz") as file:
        arrays = {name: file[name] for name in file if name != "extra_joints"}
    np.savez(tmp_path / "b.npz", **arrays)
    with pytest.raises(InputError, match="one without the other"):
        read_joints(tmp_path / "b.npz")


def test_c3d_has_them_as_points(tracks, tmp_path):
    ezc3d = pytest.importorskip("ezc3d")
    write_c3d(tmp_path / "p.c3d", tracks, 1, FPS, {})
    file = ezc3d.c3d(str(tmp_path / "p.c3d"))
    assert file["parameters"]["POINT"]["LABELS"]["value"] == [*COCO17, *FEET]
    points = file["data"]["points"][:3, 17:].transpose(2, 1, 0) / 1000.0
    np.testing.assert_allclose(points, tracks.extra.joints[:, 1], atol=1e-4)
    residuals = file["data"]["meta_points"]["residuals"][0].T
    assert (residuals[1, 20], residuals[2, 22]) == (-1.0, 0.0)
