"""Imports of calibrated cameras with the 2D poses that they give of known people."""

import json

import numpy as np
from command_line import succeed

from worldpose.formats.calibration_writer import write_calibration_toml
from worldpose.formats.joints_file import read_joints


def circling(tiny, time):
    """Two people (frames, 2, 17, 3) [m] who walk on circles of 2 m around the origin."""
    body = read_joints(tiny / "reference" / "joints.npz").joints[0, :2]
    body = body - body.mean(axis=1, keepdims=True) * [1.0, 1.0, 0.0]
    turn = np.asarray(time)[:, None] + [0.0, 2.0]
    way = 2.0 * np.stack([np.cos(turn), np.sin(turn), 0.0 * turn], axis=-1)
    return body + way[:, :, None]


def seen_by(camera, joints, rng, noise_px=1.0):
    """Pixels (frames, people, 17, 2) of joints, with noise."""
    pixels = camera.project(joints.reshape(-1, 3)).reshape(*joints.shape[:3], 2)
    return pixels + rng.normal(0.0, noise_px, pixels.shape)


def import_people(folder, cameras, pixels, fps):
    """Import cameras by name and what they saw as COCO results; return the match folder.

    Joints outside an image are not seen, nor people of whom it shows too little.
    """
    (folder / "poses").mkdir(parents=True)
    for name, camera in cameras.items():
        inside = ((pixels[name] >= 0) & (pixels[name] <= camera.image_size - 1)).all(axis=-1)
        points = np.where(inside[..., None], np.insert(pixels[name], 2, 0.9, axis=-1), 0.0)
        people = [
            {
                "image_id": frame,
                "category_id": 1,
                "keypoints": points[frame, person].ravel().round(3).tolist(),
                "score": 0.9,
            }
            for frame, person in np.argwhere(inside.sum(axis=-1) > 8).tolist()
        ]
        (folder / "poses" / f"{name}.json").write_text(json.dumps(people))
    records = {name: camera.to_calibration(name) for name, camera in cameras.items()}
    write_calibration_toml(folder / "calibration.toml", records)
    given = ("--calibration", folder / "calibration.toml", "--detections", folder / "poses")
    succeed("import", *given, "--fps", fps, "--out", folder / "match")
    assert not (folder / "match" / "reference").exists()
    return folder / "match"


def apart_from(found, joints):
    """Differences (frames, people, 17, 3) [m] from the nearest true people, and their number."""
    apart = found.joints[: len(joints), :, None] - joints[:, None]
    distance = np.nan_to_num(np.linalg.norm(apart, axis=-1), nan=1e3).mean(axis=-1)
    nearest = distance.argmin(axis=2)[:, :, None, None, None]
    return np.take_along_axis(apart, nearest, axis=2)[:, :, 0]
