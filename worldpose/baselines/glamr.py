"""GLAMR: `grecon/<clip>_seed<n>.pkl`, a pickle of arrays by person, all in one world.

Layout as written by NVlabs/GLAMR at commit 44f820c, global_recon/run_demo.py and
global_recon/models/global_recon_model.py (`init_data`, `optimize`): `person_data[id]` with
`smpl_orient_world` (T, 3), `smpl_pose` (T, 69), `smpl_beta`, `root_trans_world` (T, 3), where the
pelvis is, `scale` or None, `exist_frames` (T,) and `kp_2d` (T, 26, 2) px, 0 where there is none.
"""

from __future__ import annotations

from pathlib import Path

import numpy as np

from worldpose.baselines.fields import floats, number, part
from worldpose.baselines.pickled import read_pickled
from worldpose.baselines.result import MethodResult, Track, around_points, gathered, posed
from worldpose.body import BodyModel


def read_glamr(path: Path, model: BodyModel, _: tuple[int, int]) -> MethodResult:
    """Return the people of GLAMR's result, in the frames that contain them.

    Args:
        path: the pickle.
        model: body model to pose.

    Raises:
        InputError: the file has another format.
    """
    people, boxes, used = [], [], ""
    for name, person in part(str(path), read_pickled(path), "person_data").items():
        where = f"{path}: person {name}"
        exists = floats(where, part(where, person, "exist_frames"), (None,)) > 0.5
        count = len(exists)

        def numbers(key: str, *shape: int | None, data: object = person) -> np.ndarray:
            return floats(f"{path}: {key}", part(str(path), data, key), shape)

        scale = None if part(where, person, "scale") is None else numbers("scale", count)
        track = Track(
            frames=np.flatnonzero(exists),
            global_orient=numbers("smpl_orient_world", count, 3)[exists],
            body_pose=numbers("smpl_pose", count, 69)[exists],
            place=numbers("root_trans_world", count, 3)[exists],
            betas=numbers("smpl_beta", count, None)[exists],
            scale=None if scale is None else scale[exists],
        )
        joints, used = posed(track, model, "smpl", "pelvis")
        points = numbers("kp_2d", count, None, 2)[exists]
        # Joints that HybrIK lacks, and people in frames without an image of them, are zeros.
        points = np.where((points == 0.0).all(-1, keepdims=True), np.nan, points)
        people.append((number(where, name), track.frames, joints))
        boxes.append(around_points(points))
    tracks, around = gathered(people, boxes)
    return MethodResult(tracks, "shared", around, notes={"shape": used})
