"""A match of one camera: no person is triangulated, and every person has a pitch position."""

import csv

import numpy as np
from command_line import succeed, worldpose

import worldpose as library
from worldpose.formats.viewer_file import decode_part, read_viewer


def test_one_camera_gives_positions_on_the_pitch_with_their_uncertainty(server, tmp_path):
    one = ("--scenario", "match", "--seed", 5, "--duration", 1, "--no-stills", "--cameras", 1)
    succeed("simulate", *one, "--out", tmp_path / "one")
    project = ("--project", tmp_path / "worldpose-data")
    answer = worldpose("run", tmp_path / "one", *project)
    assert answer.code == 4, answer.err
    assert "one camera alone has detections" in answer.err
    assert "people are placed on the pitch from their feet" in answer.err
    assert "placed no joint" not in answer.err
    match = library.read_match(tmp_path / "one").spec.match_id
    succeed("export", match, *project, "--format", "positions", "--out", tmp_path / "out")
    with (tmp_path / "out/positions/clip.csv").open() as file:
        rows = list(csv.DictReader(file))
    assert {row["kind"] for row in rows} == {"plane"}
    view = tmp_path / "view.html"
    succeed("export", match, *project, "--format", "viewer", "--out", view)
    (parts,) = read_viewer(view)
    scene, _ = decode_part(parts["scene"])
    header, arrays = decode_part(parts["0"])
    assert {person["kind"] for person in scene["people"]} == {"plane"}
    shown = [scene["people"][column]["id"] for column in header["plane"]]
    for row in rows:
        at = int(row["frame"]) - scene["first"], shown.index(int(row["person"]))
        assert (
            np.abs(arrays["ground"][at][:2] - [float(row["x_m"]), float(row["y_m"])]).max() < 1e-3
        )
    page = tmp_path / "report.html"
    succeed("report", match, "--out", page, "--no-videos", *project)
    assert page.read_text().count("<td>plane</td>") == len({row["person"] for row in rows})
    truth = library.read_joints(tmp_path / "one/reference/joints.npz")
    hips = truth.joints[:, :, 11:13, :2].mean(axis=2)
    errors, inside = [], []
    for row in rows:
        off = hips[np.searchsorted(truth.frames, int(row["frame"]))]
        off = off - [float(row["x_m"]), float(row["y_m"])]
        off = off[np.nanargmin(np.linalg.norm(off, axis=1))]
        std, mixed = [float(row["x_std_m"]), float(row["y_std_m"])], float(row["xy_correlation"])
        covariance = np.outer(std, std) * [[1.0, mixed], [mixed, 1.0]]
        errors.append(np.linalg.norm(off))
        inside.append(off @ np.linalg.inv(covariance) @ off < 5.99)
    people = len({row["person"] for row in rows})
    assert people >= 10
    assert np.median(errors) < 0.3
    assert np.mean(inside) > 0.9
    heights = [float(row["height_m"]) for row in rows]
    assert 1.6 < np.median(heights) < 2.0
