"""TRAM: a folder with `camera.npy` and `hps/hps_track_<n>.npy`, all people in one world.

Layout as written by yufu-wang/tram at commit 4861c11, scripts/estimate_camera.py,
scripts/estimate_humans.py and lib/models/hmr_vimo.py: numpy files that hold a dictionary; of the
camera `world_cam_R` (T, 3, 3), `world_cam_T` (T, 3), `img_focal` and `img_center` px; of a person
torch tensors `pred_rotmat` (n, 24, 3, 3), `pred_shape` (n, 10), `pred_trans` (n, 1, 3) in camera
axes and `frame` (n,). World points are `world_cam_R x + world_cam_T`, the shape is the mean over
the frames (lib/pipeline/visualization.py).
"""

from __future__ import annotations

import re
from pathlib import Path

import numpy as np

from worldpose.baselines.fields import floats, part, rising, whole, wrong
from worldpose.baselines.pickled import read_pickled
from worldpose.baselines.result import (
    MethodResult,
    Track,
    gathered,
    posed,
    rotation_vectors,
    seen_boxes,
)
from worldpose.body import BodyModel


def read_tram(path: Path, model: BodyModel, _: tuple[int, int]) -> MethodResult:
    """Return the people of TRAM's result.

    Args:
        path: the folder of the video.
        model: body model to pose.

    Raises:
        InputError: the folder has another layout.
    """
    files = {
        int(found[1]): file
        for file in (path / "hps").glob("hps_track_*.npy")
        if (found := re.search(r"(\d+)\.npy$", file.name))
    }
    if not files:
        raise wrong(path, "hps/hps_track_<n>.npy", "none")
    file = path / "camera.npy"
    camera = read_pickled(file)
    turns = floats(f"{file}: world_cam_R", part(str(file), camera, "world_cam_R"), (None, 3, 3))
    shifts = floats(f"{file}: world_cam_T", part(str(file), camera, "world_cam_T"), (len(turns), 3))
    focal = floats(f"{file}: img_focal", part(str(file), camera, "img_focal"), ())
    center = floats(f"{file}: img_center", part(str(file), camera, "img_center"), (2,))
    people, boxes, used = [], [], ""
    for person, name in sorted(files.items()):
        where, content = str(name), read_pickled(name)
        # A track consists of pieces, in temporal order.
        frames = rising(where, whole(where, part(where, content, "frame")))
        if frames[-1] >= len(turns):
            raise wrong(where, f"frames below {len(turns)}, as the camera has", f"{frames[-1]}")
        count = len(frames)
        matrices = floats(where, part(where, content, "pred_rotmat"), (count, 24, 3, 3))
        vectors = rotation_vectors(matrices)
        track = Track(
            frames=frames,
            global_orient=vectors[:, 0],
            body_pose=vectors[:, 1:].reshape(-1, 69),
            place=floats(where, part(where, content, "pred_trans"), (count, 3)),
            betas=floats(where, part(where, content, "pred_shape"), (count, None)).mean(0),
        )
        joints, used = posed(track, model, "smpl")
        world = np.einsum("fab,fjb->fja", turns[frames], joints) + shifts[frames, None]
        people.append((person, frames, world))
        boxes.append(seen_boxes(joints, np.full(2, focal), center))
    tracks, around = gathered(people, boxes)
    return MethodResult(tracks, "shared", around, notes={"shape": used})
