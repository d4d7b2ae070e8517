"""A match with a broadcast video, from the command line to the page about it."""

import csv

import numpy as np
import pytest
import yaml
from command_line import succeed

import worldpose as library
from worldpose.video import VideoReader


@pytest.mark.slow
def test_a_broadcast_clip_is_calibrated_scored_and_shown(server, tmp_path):
    match, project = tmp_path / "match", tmp_path / "project"
    scenario = ("--scenario", "broadcast-pan", "--seed", 2, "--duration", 1.2, "--cameras", 6)
    succeed("simulate", *scenario, "--calibrated", "--no-stills", "--out", match)
    succeed("run", match, "--project", project)
    truth = ("--prediction", match, "--reference", match / "reference")
    scores = succeed("evaluate", *truth, "--project", project, "--json").json
    camera = scores["cameras"]["broadcast"]
    # 1.2 s tell less of the place and the lens than 30.
    assert camera["center_error_m"] < 0.3
    assert camera["focal_error_percent"] < 0.5
    page = tmp_path / "page.html"
    told = succeed("report", match, "--project", project, "--out", page, "--json").json
    assert "known least" in page.read_text()
    # 60 frames at 50 a second are shown at 25.
    with VideoReader(tmp_path / "page-clip.mp4") as video:
        assert len(video) == 30
        assert video.frame(0).shape == (540, 960, 3)
    assert told["videos"] == [str(tmp_path / "page-clip.mp4")]


def test_a_broadcast_camera_alone_places_people_on_the_pitch(server, tmp_path):
    match, project = tmp_path / "match", ("--project", tmp_path / "project")
    scenario = ("--scenario", "broadcast-pan", "--seed", 2, "--duration", 0.5, "--cameras", 1)
    succeed("simulate", *scenario, "--no-stills", "--out", match)
    remove_static_cameras(match)
    answer = succeed("run", match, *project)
    assert "tracking: no units, as the match has no static cameras" in answer.err
    assert answer.err.count("warning") == 1
    assert "the monocular poses of the clip are not used" in answer.err
    name = library.read_match(match).spec.match_id
    succeed("export", name, *project, "--format", "positions", "--out", tmp_path / "out")
    with (tmp_path / "out/positions/clip.csv").open() as file:
        rows = list(csv.DictReader(file))
    truth = library.read_joints(match / "reference/joints.npz")
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
    assert len({row["person"] for row in rows}) >= 10
    assert np.median(errors) < 0.35  # seen: 0.23
    assert np.mean(inside) > 0.9
    succeed("report", name, *project, "--out", tmp_path / "page.html")
    assert "Broadcast camera" in (tmp_path / "page.html").read_text()


def remove_static_cameras(match):
    """Leave the broadcast camera alone in a match folder."""
    content = yaml.safe_load((match / "match.yaml").read_text())
    static = [camera["id"] for camera in content["cameras"] if camera["kind"] == "static"]
    content["cameras"] = [camera for camera in content["cameras"] if camera["id"] not in static]
    (match / "match.yaml").write_text(yaml.safe_dump(content))
    for camera in static:
        for file in match.rglob(f"{camera}.*"):
            file.unlink()
