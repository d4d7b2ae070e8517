"""HybrIK: `pose.pkl` of several people, or `res.pk` of one; poses relative to the camera.

Layouts as written by NVlabs/GLAMR at commit 44f820c, pose_est/hybrik_demo/demo.py, which runs
HybrIK for all tracked people (`smpl_pose_quat_wroot` holds the elements of rotation matrices,
`smpl_beta`, `root_trans`, `kp_2d` px, `frames`), and by jeffffffli/HybrIK at commit c281eee,
scripts/demo_video.py (`pred_thetas` (n, 216) rotation matrices, `pred_betas`, `transl`, `bbox`
x0 y0 x1 y1 px, `img_path` numbered from 1).
"""

from __future__ import annotations

import re
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from worldpose.baselines.fields import as_floats, floats, number, part, rising, whole, wrong
from worldpose.baselines.pickled import read_pickled
from worldpose.baselines.result import (
    MethodResult,
    Track,
    around_points,
    gathered,
    posed,
    rotation_vectors,
)
from worldpose.body import BodyModel


def read_hybrik(path: Path, model: BodyModel, _: tuple[int, int]) -> MethodResult:
    """Return the people of HybrIK's result, each frame in its camera's axes.

    Args:
        path: `pose.pkl` or `res.pk`.
        model: body model to pose.

    Raises:
        InputError: it is neither.
    """
    content = read_pickled(path)
    single = isinstance(content, dict) and "pred_thetas" in content
    rows = {0: _single(path, content)} if single else _several(path, content)
    people, boxes, used = [], [], ""
    for person, (track, around) in rows.items():
        joints, used = posed(track, model, "smpl", "transl" if single else "pelvis")
        people.append((person, track.frames, joints))
        boxes.append(around)
    tracks, found = gathered(people, boxes)
    return MethodResult(tracks, "camera", found, notes={"shape": used})


def _several(path: Path, content: Any) -> dict[int, tuple[Track, NDArray[np.float64]]]:  # noqa: ANN401
    if not isinstance(content, dict):
        raise wrong(path, "a dictionary by person", f"a {type(content).__name__}")
    rows = {}
    for name, person in content.items():
        where = f"{path}: person {name}"
        frames = rising(where, whole(where, part(where, person, "frames")))
        turns = as_floats(where, part(where, person, "smpl_pose_quat_wroot"))
        track = _track(
            where,
            frames,
            turns.reshape(len(frames), -1) if turns.shape[:1] == (len(frames),) else turns,
            part(where, person, "smpl_beta"),
            part(where, person, "root_trans"),
        )
        points = floats(where, part(where, person, "kp_2d"), (len(frames), None, 2))
        rows[number(where, name)] = (track, around_points(points))
    return rows


def _single(path: Path, content: Any) -> tuple[Track, NDArray[np.float64]]:  # noqa: ANN401
    where = str(path)
    names = [str(name) for name in part(where, content, "img_path")]
    numbers = [re.search(r"(\d+)\.\w+$", name) for name in names]
    if not all(numbers):
        raise wrong(f"{path}: img_path", "pictures with a number", f"{names[:3]}")
    frames = rising(where, np.array([int(found[1]) - 1 for found in numbers if found]))
    track = _track(
        where,
        frames,
        part(where, content, "pred_thetas"),
        part(where, content, "pred_betas"),
        part(where, content, "transl"),
    )
    return track, floats(where, part(where, content, "bbox"), (len(frames), 4))


def _track(
    where: str, frames: NDArray[np.int64], turns: object, betas: object, place: object
) -> Track:
    matrices = floats(where, turns, (len(frames), 216)).reshape(-1, 24, 3, 3)
    vectors = rotation_vectors(matrices)
    return Track(
        frames=frames,
        global_orient=vectors[:, 0],
        body_pose=vectors[:, 1:].reshape(-1, 69),
        place=floats(where, place, (len(frames), 3)),
        betas=floats(where, betas, (len(frames), None)),
    )
