"""WHAM: `wham_output.pkl`, joblib's file by person, each in its own world.

Layout as written by yohanshin/WHAM at commit 2b54f77, demo.py: `pose_world` and `pose` (n, 72),
`trans_world` and `trans` (n, 3), `betas` (n, 10), `frame_ids` (n,). `trans_world` is the mid-hip
(lib/models/smpl.py, `get_output`), `trans` is SMPL's own in camera axes; the focal length is the
image diagonal (lib/vis/run_vis.py). Every trajectory begins at its own origin, so only scores of
single people are meaningful.
"""

from __future__ import annotations

from pathlib import Path

import numpy as np

from worldpose.baselines.fields import floats, number, part, rising, whole, wrong
from worldpose.baselines.pickled import read_pickled
from worldpose.baselines.result import MethodResult, Track, gathered, posed, seen_boxes
from worldpose.body import BodyModel


def read_wham(path: Path, model: BodyModel, picture: tuple[int, int]) -> MethodResult:
    """Return the people of WHAM's result.

    Args:
        path: joblib's file.
        model: body model to pose.
        picture: width and height of the video [px], which determine the focal length.

    Raises:
        InputError: the file has another format.
    """
    content = read_pickled(path)
    if not isinstance(content, dict):
        raise wrong(path, "a dictionary by person", f"a {type(content).__name__}")
    size = np.array(picture, dtype=np.float64)
    people, boxes, used = [], [], ""
    for name, person in content.items():
        where = f"{path}: person {name}"
        frames = rising(where, whole(where, part(where, person, "frame_ids")))
        count = len(frames)

        def track(suffix: str, data: object = person, own: np.ndarray = frames) -> Track:
            pose, place, betas = (
                floats(f"{path}: {key}", part(str(path), data, key), (len(own), length))
                for key, length in ((f"pose{suffix}", 72), (f"trans{suffix}", 3), ("betas", None))
            )
            return Track(own, pose[:, :3], pose[:, 3:], place, betas)

        joints, used = posed(track("_world"), model, "smpl", "mid_hip")
        seen = posed(track(""), model, "smpl")[0]
        focal = np.full(2, np.linalg.norm(size))
        people.append((number(where, name), frames, joints))
        boxes.append(seen_boxes(seen, focal, size / 2.0) if count else None)
    tracks, around = gathered(people, boxes)
    return MethodResult(tracks, "own", around, notes={"shape": used})
