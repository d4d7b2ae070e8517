"""Reader for any method's people in the release's own layout: `poses/<clip>.npz`."""

from __future__ import annotations

from pathlib import Path

import numpy as np

from worldpose.baselines.result import MethodResult, Track, gathered, posed
from worldpose.body import OPEN_BODY, BodyModel
from worldpose.formats.pose_file import read_poses


def read_smpl(path: Path, model: BodyModel, _: tuple[int, int]) -> MethodResult:
    """Return the people of a file with `betas`, `global_orient`, `body_pose` and `transl`.

    Args:
        path: npz file, persons first, NaN where a person is missing (docs/formats.md).
        model: body model to pose; betas of another body model are not used.

    Raises:
        InputError: the file has another format.
    """
    poses, named = read_poses(path)
    people, used = [], ""
    own = named is not None and named == model.name == OPEN_BODY
    for person in range(poses.batch_shape[0]):
        there = np.isfinite(poses.transl[person]).all(-1)
        if not there.any():
            continue
        one = poses[person, there]
        track = Track(
            np.flatnonzero(there), one.global_orient, one.body_pose, one.transl, one.betas
        )
        same = named in (None, model.name)
        joints, used = posed(track, model, "open" if own else "smpl" if same else "other")
        people.append((person, track.frames, joints))
    return MethodResult(gathered(people)[0], "shared", notes={"shape": used})
