"""Methods with poses relative to the camera of each image: HybrIK and 4DHumans.

Each docstring states the layout as written by the method's own code at that commit.
"""

from __future__ import annotations

import re
from collections.abc import Iterator
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from data_contracts.arrays import Floats
from worldpose.body.model import BodyModel
from worldpose.formats.baselines.result import (
    MethodResult,
    MethodTrack,
    Part,
    Person,
    boxes_around,
    format_error,
    merge_people,
    pose_track,
    read_pickled,
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
    single = isinstance(content.value, dict) and "pred_thetas" in content.value
    rows = {0: _read_person(content)} if single else _read_people(content)
    people, used = [], ""
    for number, (track, boxes) in rows.items():
        joints, used = pose_track(track, model, "smpl", "transl" if single else "pelvis")
        people.append(Person(number, track.frames, joints, boxes))
    return merge_people("camera", people, {"shape": used})


def _read_people(content: Part) -> dict[int, tuple[MethodTrack, Floats]]:
    rows = {}
    for number, person in content.by_person():
        frames = person["frames"].frames()
        turns = person["smpl_pose_quat_wroot"]
        if turns.as_floats().shape[:1] == frames.shape:
            turns = Part(turns.where, turns.as_floats().reshape(len(frames), -1))
        track = _build_track(frames, turns, person["smpl_beta"], person["root_trans"])
        rows[number] = (track, boxes_around(person["kp_2d"].floats(len(frames), None, 2)))
    return rows


def _read_person(content: Part) -> tuple[MethodTrack, Floats]:
    images = content["img_path"]
    names = [str(name) for name in images.value]
    numbers = [int(found[1]) - 1 for n in names if (found := re.search(r"(\d+)\.\w+$", n))]
    if len(numbers) < len(names):
        raise format_error(images.where, "images with a number", f"{names[:3]}")
    frames = Part(images.where, numbers).frames()
    track = _build_track(frames, content["pred_thetas"], content["pred_betas"], content["transl"])
    return track, content["bbox"].floats(len(frames), 4)


def _build_track(frames: NDArray[np.int64], turns: Part, betas: Part, place: Part) -> MethodTrack:
    count = len(frames)
    vectors = rotation_vectors(turns.floats(count, 216).reshape(-1, 24, 3, 3))
    return MethodTrack(
        frames=frames,
        global_orient=vectors[:, 0],
        body_pose=vectors[:, 1:].reshape(-1, 69),
        place=place.floats(count, 3),
        betas=betas.floats(count, None),
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
    if not isinstance(content.value, dict):
        raise format_error(path, "a dictionary by image", f"a {type(content.value).__name__}")
    rows: dict[int, dict[int, _Row]] = {}
    for name, image in content.value.items():
        for number, row in _read_image(Part(f"{path}: {name}", image)):
            rows.setdefault(number, {})[row[0]] = row
    people, used = [], ""
    for number, found in sorted(rows.items()):
        frames, turns, betas, place, boxes = (
            np.array(part) for part in zip(*(found[frame] for frame in sorted(found)), strict=True)
        )
        vectors = rotation_vectors(turns)
        track = MethodTrack(frames, vectors[:, 0], vectors[:, 1:].reshape(-1, 69), place, betas)
        joints, used = pose_track(track, model, "smpl")
        people.append(Person(number, frames, joints, boxes))
    return merge_people("camera", people, {"shape": used})


def _read_image(image: Part) -> Iterator[tuple[int, _Row]]:
    """Yield id and row of every person detected in one image."""
    frame, ages = image["time"].integer(), image["tracked_time"].value
    for place, person in enumerate(image["tid"].value):
        if ages[place]:
            continue
        body, box, camera = (
            Part(image[key].where, image[key].value[place]) for key in ("smpl", "bbox", "camera")
        )
        turns = [body["global_orient"].floats(3, 3)[None], body["body_pose"].floats(23, 3, 3)]
        x, y, width, height = box.floats(4)
        around = np.array([x, y, x + width, y + height])
        row = (frame, np.concatenate(turns), body["betas"].floats(10), camera.floats(3), around)
        yield Part(image.where, person).integer(), row
