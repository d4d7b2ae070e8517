"""Rigs of unlike cameras without truth: none is accused, and joints lie in their regions."""

import numpy as np
import pytest
from camera_builders import look_at_camera
from command_line import succeed
from imported_people import apart_from, circling, import_people, seen_by

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
    "one camera at 59.94 and one of 4K and a portrait": ring(4, (HD, (3840, 2160), (1080, 1920))),
    "two halves of a pitch": ring(3, center=-20.0) + ring(3, center=20.0),
    "face to face": ring(2),
}


@pytest.mark.parametrize("name", RIGS)
def test_cameras_of_a_mixed_rig_are_right_and_their_people_in_their_regions(
    server, tiny, tmp_path, name
):
    cameras, rates = RIGS[name], {2: 59.94} if "59.94" in name else {}
    centers = [-20.0, 20.0] if "halves" in name else [0.0]

    def joints(time):
        people = circling(tiny, time)
        return np.concatenate([people + [x, 0.0, 0.0] for x in centers], axis=1)

    rng, pixels = np.random.default_rng(0), {}
    for c, camera in enumerate(cameras):
        rate = rates.get(c, FPS)
        own = joints(np.arange(int(FRAMES * rate / FPS)) / rate)
        if len(centers) > 1:
            own = own[:, :2] if c < 3 else own[:, 2:]
        pixels[f"cam{c}"] = seen_by(camera, own, rng, max(camera.image_size) / 1920.0)
    named = {f"cam{c}": camera for c, camera in enumerate(cameras)}
    match, project, out = (
        import_people(tmp_path, named, pixels, FPS),
        tmp_path / "p",
        tmp_path / "o",
    )
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
    assert len(found.person_ids) == true.shape[1]
    off = apart_from(found, true)
    known = np.isfinite(off).all(axis=-1)
    assert known.mean() > 0.9
    # Two cameras that face each other tell little of the distance between them.
    assert np.linalg.norm(off[known], axis=-1).mean() < (0.06 if "face" in name else 0.03)
    inverse = np.linalg.inv(found.covariance[:FRAMES][known])
    squared = np.einsum("ni,nij,nj->n", off[known], inverse, off[known])
    assert (squared < 7.81).mean() > 0.9  # of 95 %: noise of detectors lasts longer than this one
