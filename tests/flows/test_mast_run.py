"""Two cameras on a mast tell no depth: people are placed on the pitch, and nothing is accused."""

import csv

import numpy as np
from camera_builders import look_at_camera
from command_line import succeed, worldpose
from imported_people import import_people, seen_by

from worldpose.formats.joints_file import read_joints


def test_two_cameras_on_a_mast(server, tiny, tmp_path):
    joints = read_joints(tiny / "reference" / "joints.npz").joints
    joints = joints - [*joints[..., :2].mean(axis=(0, 1, 2)), 0.0]
    rng, places = np.random.default_rng(1), ([-0.3, -30.0, 3.0], [0.3, -30.0, 3.0])
    middle = [0.0, 0.0, 1.0]
    cameras = {
        f"cam{n}": look_at_camera(p, middle, 2500.0, (1280, 720)) for n, p in enumerate(places)
    }
    pixels = {name: seen_by(camera, joints, rng) for name, camera in cameras.items()}
    match, project = (
        import_people(tmp_path, cameras, pixels, 25),
        ("--project", tmp_path / "project"),
    )
    spec = match / "match.yaml"
    spec.write_text(spec.read_text().replace("pitch: none\n", ""))  # they stand on a pitch
    answer = worldpose("run", match, *project)
    assert answer.code == 4, answer.err
    assert "contradicts" not in answer.err + answer.out
    succeed("report", "match", *project, "--out", tmp_path / "report.html", "--no-videos")
    assert "<td>plane</td>" in (tmp_path / "report.html").read_text()
    succeed("export", "match", *project, "--format", "positions", "--out", tmp_path / "out")
    with (tmp_path / "out/positions/clip.csv").open() as file:
        rows = [(int(r["frame"]), float(r["x_m"]), float(r["y_m"])) for r in csv.DictReader(file)]
    assert len(rows) > 30
    hips = joints[:, :, 11:13, :2].mean(axis=2)
    off = [np.linalg.norm(hips[frame] - place, axis=-1).min() for frame, *place in rows]
    # A foot is known within 6 cm in height, seen from 3 m above the ground at 33 m.
    assert np.median(off) < 0.06 * 33.0 / 3.0
