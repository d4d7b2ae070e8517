"""The second pass finds people in rendered videos that the first pass missed."""

import numpy as np
import pytest
from command_line import succeed

from worldpose.formats.release_cameras import read_camera
from worldpose.store.store import Store, open_run

PEOPLE = 5
CAMERAS = 4
FRAMES = 10


@pytest.mark.slow
def test_who_was_missed_is_found_again_where_the_bodies_are(server, tmp_path):
    folder, project = tmp_path / "match", tmp_path / "project"
    scenario = ("--scenario", "tiny", "--seed", 2, "--duration", 0.4, "--cameras", CAMERAS)
    succeed("simulate", *scenario, "--render", "--no-stills", "--calibrated", "--out", folder)
    # Of five people, each camera leaves out the one with the lowest score.
    asked = ("run", folder, "--project", project, "--iterations", 2)
    asked += ("--set", "detection.stride=2", "--set", f"detection.max_people={PEOPLE - 1}")
    answer = succeed(*asked, "--json").json
    first, second = (each["run"] for each in answer["iterations"])
    store = Store.open(str(project))
    (match,) = store.matches()
    run = open_run(str(project), match, second)
    units = [name for name in run if name.startswith("redetection/")]
    assert len(units) == CAMERAS
    assert not any(name.startswith("redetection/") for name in store.run(match, first).results)

    truth = np.load(folder / "reference" / "joints.npz")["joints"]
    sought = found = 0
    right = []
    for name in units:
        camera_id = name.partition("/")[2].partition(".")[0]
        detected, again = run[name.replace("redetection", "detection")], run[name]
        for array in ("keypoints", "confidence", "boxes", "score"):
            kept = again[array].values[:, : detected.sizes["detection"]]
            np.testing.assert_array_equal(kept, detected[array].values)
        figures = run.record.figures[name]
        sought, found = sought + figures["sought"], found + figures["found"]
        frame, place = np.nonzero(again["found_again"].values >= 0)
        assert len(frame) == figures["found"]
        assert (place >= detected.sizes["detection"]).all()
        camera = read_camera(folder / "reference" / "cameras" / f"{camera_id}.npz")
        pixels = camera.project(truth.reshape(-1, 3)).reshape(*truth.shape[:3], 2)
        for n, k in zip(frame, place, strict=True):
            away = np.linalg.norm(again["keypoints"].values[n, k] - pixels[n], axis=-1)
            trunk = pixels[n][:, (5, 6)].mean(1) - pixels[n][:, (11, 12)].mean(1)
            reach = 0.2 * np.linalg.norm(trunk, axis=-1)
            seen = np.isfinite(away[0])
            right.append((away < reach[:, None])[:, seen].mean(axis=1).max())
    # One an image is missing; some are half hidden or cut, and not looked for.
    assert sought >= FRAMES * CAMERAS / 4
    assert found >= sought / 2
    # As sure as what detectors find themselves.
    assert np.mean(right) > 0.8

    tracked = open_run(str(project), match, first), run
    views = [each["tracking/clip"]["detection_index"].values >= 0 for each in tracked]
    assert views[1].sum() > views[0].sum()
    assert succeed(*asked, "--json").json["executed"] == 0
    status = succeed("status", "--project", project, "--json").json["matches"][0]["units"]
    assert not status["stale"] and not status["missing"]
