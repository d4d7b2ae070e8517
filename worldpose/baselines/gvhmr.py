"""GVHMR: `hmr4d_results.pt`, torch's file of one person; a folder of such files for several.

Layout as written by zju3dv/GVHMR at commit 44fbc19, tools/demo/demo.py and
hmr4d/model/gvhmr/gvhmr_pl_demo.py: `smpl_params_global` and `smpl_params_incam`, SMPL-X with
`global_orient` (T, 3), `body_pose` (T, 63), `transl` (T, 3) and `betas` (T, 10), and `K_fullimg`
(T, 3, 3) px. The method follows one person through the whole video, in a world that begins at that
person.
"""

from __future__ import annotations

from pathlib import Path

import numpy as np

from worldpose.baselines.fields import floats, part, wrong
from worldpose.baselines.pickled import read_pickled
from worldpose.baselines.result import MethodResult, Track, gathered, posed, seen_boxes
from worldpose.body import BodyModel


def read_gvhmr(path: Path, model: BodyModel, _: tuple[int, int]) -> MethodResult:
    """Return the people of GVHMR's results, one for each file in order of their names.

    Args:
        path: a file, or a folder with one file per person at any depth.
        model: body model to pose.

    Raises:
        InputError: it is neither.
    """
    files = [path] if path.is_file() else sorted(path.rglob("*.pt"))
    # The method keeps other torch files in preprocess/.
    files = [file for file in files if file.parent.name != "preprocess"]
    if not files:
        raise wrong(path, "hmr4d_results.pt, or a folder of such files", "none")
    people, boxes, used = [], [], ""
    for person, file in enumerate(files):
        content = read_pickled(file)
        world, seen = (
            _track(file, part(str(file), content, f"smpl_params_{name}"))
            for name in ("global", "incam")
        )
        intrinsics = floats(
            f"{file}: K_fullimg", part(str(file), content, "K_fullimg"), (len(seen.frames), 3, 3)
        )
        joints, used = posed(world, model, "other")
        in_camera = posed(seen, model, "other")[0]
        people.append((person, world.frames, joints))
        boxes.append(seen_boxes(in_camera, intrinsics[:, (0, 1), (0, 1)], intrinsics[:, :2, 2]))
    tracks, around = gathered(people, boxes)
    return MethodResult(tracks, "own", around, notes={"shape": used})


def _track(file: Path, parameters: object) -> Track:
    where = str(file)
    place = floats(where, part(where, parameters, "transl"), (None, 3))
    turns, angles = (
        floats(f"{file}: {key}", part(where, parameters, key), (len(place), length))
        for key, length in (("global_orient", 3), ("body_pose", 63))
    )
    return Track(np.arange(len(place)), turns, angles, place)
