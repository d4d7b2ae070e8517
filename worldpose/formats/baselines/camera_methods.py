"""Methods with poses relative to the camera of each image: HybrIK and 4DHumans.

Each docstring states the layout as written by the method's own code at that commit.
"""

from __future__ import annotations

import re
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from worldpose.body.model import BodyModel
from worldpose.formats.baselines.result import (
    MethodResult,
    Track,
    as_floats,
    boxes_around,
    floats,
    format_error,
    get_part,
    integer,
    integers,
    merge_people,
    pose_track,
    read_pickled,
    require_ascending,
    rotation_vectors,
)


def read_hybrik(path: Path, model: BodyModel, _: tuple[int, int]) -> MethodResult:
    """Return the people of HybrIK's result, each frame in its camera's axes.

    The result is `pose.pkl` of several people, or `res.pk` of one person. Its poses are relative
    to the camera.

    NVlabs/GLAMR at commit 44f820c writes `pose.pkl` in pose_est/hybrik_demo/demo.py, which runs
    HybrIK for all tracked people. It has `smpl_pose_quat_wroot` (the elements of rotation
    matrices), `smpl_beta`, `root_trans`, `kp_2d` px and `frames`. jeffffffli/HybrIK at commit
    c281eee writes `res.pk` in scripts/demo_video.py. It has `pred_thetas` (n, 216) rotation
    matrices, `pred_betas`, `transl`, `bbox` x0 y0 x1 y1 px, and `img_path` numbered from 1.

    Args:
        path: `pose.pkl` or `res.pk`.
        model: body model to pose.

    Raises:
        InputError: the file has neither of the two layouts.
    """
    content = read_pickled(path)
    single = isinstance(content, dict) and "pred_thetas" in content
    rows = {0: _read_person(path, content)} if single else _read_people(path, content)
    people, boxes, used = [], [], ""
    for person, (track, around) in rows.items():
        joints, used = pose_track(track, model, "smpl", "transl" if single else "pelvis")
        people.append((person, track.frames, joints))
        boxes.append(around)
    tracks, found = merge_people(people, boxes)
    return MethodResult(tracks, "camera", found, notes={"shape": used})


def _read_people(path: Path, content: Any) -> dict[int, tuple[Track, NDArray[np.float64]]]:  # noqa: ANN401
    if not isinstance(content, dict):
        raise format_error(path, "a dictionary by person", f"a {type(content).__name__}")
    rows = {}
    for name, person in content.items():
        where = f"{path}: person {name}"
        frames = require_ascending(where, integers(where, get_part(where, person, "frames")))
        turns = as_floats(where, get_part(where, person, "smpl_pose_quat_wroot"))
        track = _build_track(
            where,
            frames,
            turns.reshape(len(frames), -1) if turns.shape[:1] == (len(frames),) else turns,
            get_part(where, person, "smpl_beta"),
            get_part(where, person, "root_trans"),
        )
        points = floats(where, get_part(where, person, "kp_2d"), (len(frames), None, 2))
        rows[integer(where, name)] = (track, boxes_around(points))
    return rows


def _read_person(path: Path, content: Any) -> tuple[Track, NDArray[np.float64]]:  # noqa: ANN401
    where = str(path)
    names = [str(name) for name in get_part(where, content, "img_path")]
    numbers = [re.search(r"(\d+)\.\w+$", name) for name in names]
    if not all(numbers):
        raise format_error(f"{path}: img_path", "images with a number", f"{names[:3]}")
    frames = require_ascending(where, np.array([int(found[1]) - 1 for found in numbers if found]))
    track = _build_track(
        where,
        frames,
        get_part(where, content, "pred_thetas"),
        get_part(where, content, "pred_betas"),
        get_part(where, content, "transl"),
    )
    return track, floats(where, get_part(where, content, "bbox"), (len(frames), 4))


def _build_track(
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


_Row = tuple[int, np.ndarray, np.ndarray, np.ndarray, np.ndarray]


def read_humans4d(path: Path, model: BodyModel, _: tuple[int, int]) -> MethodResult:
    """Return the people of 4DHumans' result in the images with a detection.

    4DHumans (HMR2 with PHALP's tracks) writes `results/demo_<clip>.pkl`, with poses relative to the
    camera.

    The layout is that of brjathu/PHALP at commit 96f7e6c, phalp/trackers/PHALP.py (`track`),
    which shubham-goel/4D-Humans at commit 6ec7965, track.py, runs with HMR2: joblib's file of a
    dictionary by image, with lists over people: `tid`, `tracked_time` (0 if detected in this
    image), `bbox` x y width height px, `camera` (3,) m, `smpl` with `global_orient` (1, 3, 3),
    `body_pose` (23, 3, 3) and `betas` (10,); `time` counts the images from 0.

    Args:
        path: joblib's file.
        model: body model to pose.

    Raises:
        InputError: the file has another format.
    """
    content = read_pickled(path)
    if not isinstance(content, dict):
        raise format_error(path, "a dictionary by image", f"a {type(content).__name__}")
    rows: dict[int, dict[int, _Row]] = {}
    for name, image in content.items():
        for person, row in _read_image(f"{path}: {name}", image):
            rows.setdefault(person, {})[row[0]] = row
    people, boxes, used = [], [], ""
    for person, found in sorted(rows.items()):
        frames, turns, betas, place, around = (
            np.array(part) for part in zip(*(found[frame] for frame in sorted(found)), strict=True)
        )
        vectors = rotation_vectors(turns)
        track = Track(frames, vectors[:, 0], vectors[:, 1:].reshape(-1, 69), place, betas)
        joints, used = pose_track(track, model, "smpl")
        people.append((person, frames, joints))
        boxes.append(around)
    tracks, found_boxes = merge_people(people, boxes)
    return MethodResult(tracks, "camera", found_boxes, notes={"shape": used})


def _read_image(where: str, image: Any) -> list[tuple[int, _Row]]:  # noqa: ANN401
    """Return id and row of every person detected in one image."""
    frame = integer(where, get_part(where, image, "time"))
    ages = get_part(where, image, "tracked_time")
    found = []
    for place, person in enumerate(get_part(where, image, "tid")):
        if ages[place]:
            continue
        body, box = (get_part(where, image, key)[place] for key in ("smpl", "bbox"))
        turns = np.concatenate(
            [
                floats(where, get_part(where, body, "global_orient"), (3, 3))[None],
                floats(where, get_part(where, body, "body_pose"), (23, 3, 3)),
            ]
        )
        x, y, width, height = floats(where, box, (4,))
        row = (
            frame,
            turns,
            floats(where, get_part(where, body, "betas"), (10,)),
            floats(where, get_part(where, image, "camera")[place], (3,)),
            np.array([x, y, x + width, y + height]),
        )
        found.append((integer(where, person), row))
    return found
