"""4DHumans (HMR2 with PHALP's tracks): `results/demo_<clip>.pkl`, poses relative to the camera.

Layout as written by brjathu/PHALP at commit 96f7e6c, phalp/trackers/PHALP.py (`track`), which
shubham-goel/4D-Humans at commit 6ec7965, track.py, runs with HMR2: joblib's file of a dictionary by
image, with lists over people: `tid`, `tracked_time` (0 if detected in this image), `bbox` x y width
height px, `camera` (3,) m, `smpl` with `global_orient` (1, 3, 3), `body_pose` (23, 3, 3) and
`betas` (10,); `time` counts the images from 0.
"""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np

from worldpose.baselines.fields import floats, number, part, wrong
from worldpose.baselines.pickled import read_pickled
from worldpose.baselines.result import MethodResult, Track, gathered, posed, rotation_vectors
from worldpose.body import BodyModel

_Row = tuple[int, np.ndarray, np.ndarray, np.ndarray, np.ndarray]


def read_humans4d(path: Path, model: BodyModel, _: tuple[int, int]) -> MethodResult:
    """Return the people of 4DHumans' result in the images with a detection.

    Args:
        path: joblib's file.
        model: body model to pose.

    Raises:
        InputError: the file has another format.
    """
    content = read_pickled(path)
    if not isinstance(content, dict):
        raise wrong(path, "a dictionary by picture", f"a {type(content).__name__}")
    rows: dict[int, dict[int, _Row]] = {}
    for name, picture in content.items():
        for person, row in _people(f"{path}: {name}", picture):
            rows.setdefault(person, {})[row[0]] = row
    people, boxes, used = [], [], ""
    for person, found in sorted(rows.items()):
        frames, turns, betas, place, around = (
            np.array(part) for part in zip(*(found[frame] for frame in sorted(found)), strict=True)
        )
        vectors = rotation_vectors(turns)
        track = Track(frames, vectors[:, 0], vectors[:, 1:].reshape(-1, 69), place, betas)
        joints, used = posed(track, model, "smpl")
        people.append((person, frames, joints))
        boxes.append(around)
    tracks, found_boxes = gathered(people, boxes)
    return MethodResult(tracks, "camera", found_boxes, notes={"shape": used})


def _people(where: str, picture: Any) -> list[tuple[int, _Row]]:  # noqa: ANN401
    """Return id and row of every person detected in one image."""
    frame = number(where, part(where, picture, "time"))
    ages = part(where, picture, "tracked_time")
    found = []
    for place, person in enumerate(part(where, picture, "tid")):
        if ages[place]:
            continue
        body, box = (part(where, picture, key)[place] for key in ("smpl", "bbox"))
        turns = np.concatenate(
            [
                floats(where, part(where, body, "global_orient"), (3, 3))[None],
                floats(where, part(where, body, "body_pose"), (23, 3, 3)),
            ]
        )
        x, y, width, height = floats(where, box, (4,))
        row = (
            frame,
            turns,
            floats(where, part(where, body, "betas"), (10,)),
            floats(where, part(where, picture, "camera")[place], (3,)),
            np.array([x, y, x + width, y + height]),
        )
        found.append((number(where, person), row))
    return found
