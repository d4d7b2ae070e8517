"""PromptHMR: `results.pkl`, joblib's file, all people in one world.

Layout as written by yufu-wang/PromptHMR at commit ea85d0a, pipeline/pipeline.py and
pipeline/world.py: `people[id]` with `frames` (n,), `bboxes` (n, 4) x0 y0 x1 y1 px and
`smplx_world`, SMPL-X with `pose` (n, 165), `shape` and `trans` (n, 3); `camera.img_center` px is
the principal point of the images, which the method downscales.
"""

from __future__ import annotations

from pathlib import Path

from worldpose.baselines.fields import floats, number, part, rising, whole
from worldpose.baselines.pickled import read_pickled
from worldpose.baselines.result import MethodResult, Track, gathered, posed
from worldpose.body import BodyModel


def read_prompthmr(path: Path, model: BodyModel, _: tuple[int, int]) -> MethodResult:
    """Return the people of PromptHMR's result.

    Args:
        path: joblib's file, or the folder it lies in.
        model: body model to pose.

    Raises:
        InputError: the file has another format.
    """
    file = path / "results.pkl" if path.is_dir() else path
    content = read_pickled(file)
    people, boxes, used = [], [], ""
    for name, person in part(str(file), content, "people").items():
        where = f"{file}: person {name}"
        frames = rising(where, whole(where, part(where, person, "frames")))
        count = len(frames)
        pose = floats(where, part(where, person, "smplx_world", "pose"), (count, 165))
        place = floats(where, part(where, person, "smplx_world", "trans"), (count, 3))
        joints, used = posed(Track(frames, pose[:, :3], pose[:, 3:66], place), model, "other")
        people.append((number(where, name), frames, joints))
        box = floats(where, part(where, person, "bboxes"), (count, None))
        boxes.append(box[:, :4])
    tracks, around = gathered(people, boxes)
    center = floats(f"{file}: img_center", part(str(file), content, "camera", "img_center"), (2,))
    size = (2.0 * float(center[0]), 2.0 * float(center[1]))
    return MethodResult(tracks, "shared", around, size, {"shape": used})
