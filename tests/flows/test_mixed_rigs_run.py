"""Rigs of unlike cameras without truth: none is accused, and joints lie in their regions."""

import json

import numpy as np
import pytest
from camera_builders import look_at_camera
from command_line import succeed

from worldpose.formats.calibration_writer import write_calibration_toml
from worldpose.formats.joints_file import read_joints
from worldpose.store.store import open_run

FRAMES, FPS, HD = 100, 50.0, (1920, 1080)


def ring(count, sizes=(HD,), center=0.0):
    """Cameras 12 m from a place on the x axis, with the same field of view in all image sizes."""
    cameras = []
    for n in range(count):
        angle, size = 2.0 * np.pi * n / count + 0.3, sizes[n % len(sizes)]
        place = [center + 12.0 * np.cos(angle), 12.0 * np.sin(angle), 3.0 + 0.3 * n]
        cameras.append(look_at_camera(place, [center, 0.0, 1.0], 0.45 * max(size), size))
    return cameras


RIGS = {
    "one camera at 59.94": (ring(4), {2: 59.94}),
    "4K beside 1080p": (ring(4, (HD, (3840, 2160))), {}),
    "portrait beside landscape": (ring(4, (HD, (1080, 1920))), {}),
    "two halves of a pitch": (ring(3, center=-20.0) + ring(3, center=20.0), {}),
    "face to face": (ring(2), {}),
}


@pytest.mark.parametrize("name", RIGS)
def test_cameras_of_a_mixed_rig_are_right_and_their_people_in_their_regions(
    server, tiny, tmp_path, name
):
    cameras, rates = RIGS[name]
    body = read_joints(tiny / "reference" / "joints.npz").joints[0, :2]
    body = body - body.mean(axis=1, keepdims=True) * [1.0, 1.0, 0.0]
    centers = [-20.0, 20.0] if "halves" in name else [0.0]

    def joints(time):
        turn = time[:, None] + np.array([0.0, 2.0])
        way = 2.0 * np.stack([np.cos(turn), np.sin(turn), 0.0 * turn], axis=-1)
        people = body + way[:, :, None]
        return np.concatenate([people + [x, 0.0, 0.0] for x in centers], axis=1)

    rng, records = np.random.default_rng(0), {}
    (tmp_path / "poses").mkdir()
    for c, camera in enumerate(cameras):
        records[f"cam{c}"] = camera.to_calibration(f"cam{c}")
        rate = rates.get(c, FPS)
        own = joints(np.arange(int(FRAMES * rate / FPS)) / rate)
        if len(centers) > 1:
            own = own[:, :2] if c < 3 else own[:, 2:]
        pixels = camera.project(own.reshape(-1, 3)).reshape(*own.shape[:3], 2)
        pixels += rng.normal(0.0, max(camera.image_size) / 1920.0, pixels.shape)
        people = [
            {
                "image_id": frame,
                "category_id": 1,
                "keypoints": np.insert(one, 2, 0.9, axis=-1).ravel().round(2).tolist(),
                "score": 0.9,
            }
            for frame, seen in enumerate(pixels)
            for one in seen
        ]
        (tmp_path / "poses" / f"cam{c}.json").write_text(json.dumps(people))
    write_calibration_toml(tmp_path / "calibration.toml", records)
    match, project, out = (tmp_path / each for each in ("match", "project", "out"))
    given = ("--calibration", tmp_path / "calibration.toml", "--detections", tmp_path / "poses")
    succeed("import", *given, "--fps", FPS, "--out", match)
    file = match / "match.yaml"
    for c, rate in rates.items():
        text = file.read_text()
        file.write_text(text.replace(f"id: cam{c}\n", f"id: cam{c}\n  fps: {rate}\n"))
        assert file.read_text() != text
    said = succeed("run", match, "--project", project, "--until", "retriangulation")
    assert "camera cam" not in said.err + said.out
    run = open_run(str(project), "match")
    check = run.record.figures["camera_consistency/clip"]
    assert (check["cameras_wrong"], check["contradictions"]) == (0, 0)
    assert run.record.figures["triangulation/clip"]["unhealthy_share"] == 0.0
    succeed("export", "match", "--format", "joints", "--project", project, "--out", out)
    found, true = read_joints(out / "joints.npz"), joints(np.arange(FRAMES) / FPS)
    apart = found.joints[:FRAMES, :, None] - true[:, None]
    distance = np.nan_to_num(np.linalg.norm(apart, axis=-1), nan=1e3).mean(axis=-1)
    nearest = distance.argmin(axis=2)
    off = np.take_along_axis(apart, nearest[:, :, None, None, None], axis=2)[:, :, 0]
    assert len(found.person_ids) == true.shape[1]
    known = np.isfinite(off).all(axis=-1)
    assert known.mean() > 0.9
    # Two cameras that face each other tell little of the distance between them.
    assert np.linalg.norm(off[known], axis=-1).mean() < (0.06 if "face" in name else 0.03)
    squared = np.einsum(
        "ni,nij,nj->n", off[known], np.linalg.inv(found.covariance[:FRAMES][known]), off[known]
    )
    assert (squared < 7.81).mean() > 0.9  # of 95 %: noise of detectors lasts longer than this one
