"""The table of all metrics on real data: on a made-up folder, and on a few real frames.

WORLDPOSE_TEST_DATA names a folder as benchmarks/real.py describes it.
"""

import json
import os
import sys
from pathlib import Path

import cv2
import numpy as np
import pytest
from camera_builders import look_at_camera

from worldpose.detection.interfaces import People
from worldpose.pitch.template import PitchTemplate
from worldpose.video.files import write_video

REAL = Path(os.environ.get("WORLDPOSE_TEST_DATA", "absent"))
FOLDER = Path(__file__).parents[2] / "benchmarks"
SIZE = (640, 360)
CENTER = np.array([-2.0, -75.0, 18.0])


@pytest.fixture
def table(monkeypatch, capsys):
    """Runs the command in this process and returns its exit message and output."""
    monkeypatch.syspath_prepend(str(FOLDER))
    import real

    def run(*words):
        monkeypatch.setattr(sys, "argv", ["real.py", *map(str, words)])
        try:
            real.main()
        except SystemExit as error:
            return str(error), ""
        return None, capsys.readouterr().out

    run.module = real
    return run


def write_moving_clip(folder):
    """A clip of 6 frames that pans over painted lines, clicked in two frames, drawn in one."""
    folder.mkdir()
    pitch = PitchTemplate.standard()
    cameras = [look_at_camera(CENTER, (0.4 * t, -2.0, 0.0), 800.0, SIZE) for t in range(6)]
    images, markings = [], []
    for camera in cameras:
        image = np.full((SIZE[1], SIZE[0], 3), (60, 140, 60), np.uint8)
        points, drawn = [], []
        for name in (*pitch.lines, *pitch.arcs):
            line = camera.project(pitch.marking_points(name, 0.5))
            line = line[np.isfinite(line).all(axis=1)]
            cv2.polylines(image, [np.round(line * 16).astype(int)], False, (255,) * 3, 2, 16, 4)
            inside = line[((line > 4) & (line < np.array(SIZE) - 4)).all(axis=1)]
            if len(inside) > 4:
                drawn.append({"name": name, "xy": inside[::4].tolist()})
        for name, place in pitch.points.items():
            pixel = camera.project(place[None])[0]
            if place[2] <= 0.3 and (pixel > 4).all() and (pixel < np.array(SIZE) - 4).all():
                points.append({"name": name, "xy": pixel.tolist()})
        images.append(image)
        markings.append({"points": points, "drawn": drawn})
    write_video(folder / "clip.mp4", images, 25.0)
    for name, frames in (("key_frames", (0, 5)), ("lines", (3,))):
        keys = [{"frame": t, "markings": markings[t]} for t in frames]
        (folder / f"{name}.json").write_text(json.dumps({"key_frames": keys}))


def write_stills(folder):
    """One image with two labelled people."""
    folder.mkdir()
    cv2.imwrite(str(folder / "a.png"), np.full((240, 320, 3), 90, np.uint8))
    joints = np.array([[40.0 + j, 30.0 + 5 * j, 2] for j in range(17)])
    people = [
        {"id": 1, "image_id": 1, "bbox": [30, 20, 40, 100], "keypoints": joints.ravel().tolist()},
        {"id": 2, "image_id": 1, "bbox": [200, 20, 40, 100]},
    ]
    image = {"id": 1, "file_name": "a.png", "width": 320, "height": 240}
    labels = {"images": [image], "annotations": people}
    (folder / "labels.json").write_text(json.dumps(labels))


def write_mvor(folder):
    """One moment: one person, seen by three cameras without any error."""
    folder.mkdir()
    rng = np.random.default_rng(1)
    joints = np.array([0.3, 0.2, 1.2]) + rng.uniform(-0.3, 0.3, (17, 3))
    from_room, intrinsics, detections = [], [], []
    for n, angle in enumerate((0.0, 2.1, 4.2)):
        place = (3 * np.cos(angle), 3 * np.sin(angle), 2.0)
        camera = look_at_camera(place, (0.0, 0.0, 1.0), 540.0, SIZE)
        matrix = np.eye(4)
        matrix[:3, :3] = camera.cam_from_world.rotation
        matrix[:3, 3] = 1000.0 * camera.cam_from_world.translation
        from_room.append(matrix)
        intrinsics.append(
            {
                "focallength": camera.focal.tolist(),
                "principalpoint": camera.principal_point.tolist(),
                "imagesize": list(SIZE),
            }
        )
        pixels = np.c_[camera.project(joints), np.full(17, 0.9)]
        detections.append({"image_id": n, "coco_keypoints": pixels.ravel().tolist()})
    room = np.linalg.inv(from_room[0])
    points = np.zeros((10, 4))
    for coco, own in zip((5, 6, 11, 12, 7, 8, 9, 10), range(2, 10), strict=True):
        points[own, :3] = from_room[0][:3, :3] @ (1000.0 * joints[coco]) + from_room[0][:3, 3]
        points[own, 3] = 1
    info = {
        "firstCamToRoomRef": room.ravel().tolist(),
        "intrinsics": intrinsics,
        "extrinsics": [(from_room[0] @ np.linalg.inv(m)).ravel().tolist() for m in from_room],
    }
    said = {
        "cameras_info": {"camParams": info},
        "annotations3D": [{"image_ids": "0_1_2", "keypoints3D": points.ravel().tolist()}],
    }
    (folder / "camma_mvor_2018.json").write_text(json.dumps(said))
    (folder / "openpose_kps.json").write_text(json.dumps(detections))


def test_a_made_up_folder_gives_known_metrics_and_says_what_is_absent(table, tmp_path, monkeypatch):
    write_moving_clip(tmp_path / "moving_clip")
    write_stills(tmp_path / "stills")
    write_mvor(tmp_path / "mvor")
    # Of the two labelled people one is found, with a false box and one that is too unsure.
    boxes = np.array([[31, 21, 71, 121], [100, 100, 140, 200], [200, 20, 240, 120.0]])
    found = People(boxes, np.array([0.9, 0.8, 0.3]))
    monkeypatch.setattr(table.module.stills, "detect_people", lambda *_: [found])
    failure, out = table(tmp_path, "--json")
    assert failure is None
    result = json.loads(out)
    assert set(result["skipped"]) == {"static_pair", "panorama_people", "shelf_dev"}
    assert result["stills"]["recall"] == result["stills"]["precision"] == 0.5
    assert 0.0 <= result["stills"]["pck"] <= 1.0
    assert result["mvor"]["three"]["matched_percent"] == 100.0
    assert result["mvor"]["three"]["error_cm"] < 1.0
    assert result["mvor"]["three"]["false_percent"] == 0.0
    assert result["mvor"]["two"]["error_cm"] is None
    clip = result["moving_clip"]
    assert clip["lines_px_mean"] < 1.0
    assert clip["lines_px_mean"] < clip["lines_px_p95"] < 2.5
    assert np.linalg.norm(np.array(clip["center_m"]) - CENTER) < 1.5
    failure, out = table(tmp_path, "--only", "mvor")
    assert failure is None
    assert "| mvor | three.matched_percent | 100 |" in out


def test_bad_data_is_one_clear_error(table, tmp_path):
    assert table(tmp_path / "absent")[0].endswith("says how each is laid out.")
    (tmp_path / "mvor").mkdir()
    (tmp_path / "mvor" / "camma_mvor_2018.json").write_text("{}")
    failure, _ = table(tmp_path)
    assert failure.startswith("error: ")
    assert "openpose_kps.json: expected this part of the data, found nothing" in failure
    (tmp_path / "mvor" / "openpose_kps.json").write_text("[]")
    failure, _ = table(tmp_path)
    assert failure.startswith("error: mvor: KeyError")


def test_pairs_of_feet_are_mutual_nearest_neighbours_at_the_offset(table):
    first = np.array([[[0.0, 0.0], [30.0, 5.0]]] * 5)
    first[:, 0, 0] = np.arange(5)  # one person runs 1 m per frame
    second = first[:, [0, 0, 1]].copy()
    second[:, 1] += [0.0, 1.5]  # a second box of the runner is farther away
    second[:, 2] += [0.0, 2.5]  # beyond the largest distance
    second[:, :2, 0] -= 0.5  # the second clock is half a frame late
    pairs = table.module.pair_feet(first, second, 0.5)
    assert len(pairs) == 4
    np.testing.assert_allclose(pairs, 0.0, atol=1e-12)
    np.testing.assert_allclose(table.module.pair_feet(first, second, 0.0), 0.5)


@pytest.mark.slow
@pytest.mark.skipif(not (REAL / "static_pair").is_dir(), reason="WORLDPOSE_TEST_DATA is not set")
def test_a_few_frames_of_the_real_folder_give_metrics(table):
    failure, out = table(
        REAL, "--only", "static_pair", "--only", "panorama_people", *("--frames", 3)
    )
    assert failure is None
    assert "| static_pair | left.wrong_named | 3 |" in out
    assert "| static_pair | right.right_accused | 0 |" in out
    pairs = float(out.split("people_per_frame | ")[1].split(" ")[0])
    assert 5.0 < pairs < 12.0
