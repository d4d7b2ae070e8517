"""npz file format of body poses of a clip, as in the WorldPose release (X3)."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import Any, Final

import numpy as np
from numpy.typing import NDArray

from worldpose.body import BodyParameters
from worldpose.errors import InputError
from worldpose.formats.archives import Member, read_archive, write_archive

MEMBERS: Final = {
    "betas": Member(("persons", "shapes"), "float"),
    "global_orient": Member(("persons", "frames", 3), "float"),
    "body_pose": Member(("persons", "frames", 69), "float"),
    "transl": Member(("persons", "frames", 3), "float"),
    "body_model": Member((1,), "text", required=False),
}
"""Arrays of a pose file; persons first, unlike everywhere else here."""
PLURALS: Final = {"global_orients": "global_orient", "body_poses": "body_pose"}
"""Names in the release's own note, which are also accepted."""


def write_poses(path: Path, poses: BodyParameters, body_model: str) -> None:
    """Write `poses/<clip>.npz`, whole or not at all; equal poses give equal bytes.

    Members in single precision, with an error of at most 4 um on a pitch of 105 m: `betas`
    (persons, shapes), `global_orient` (persons, frames, 3) [rad], `body_pose` (persons, frames, 69)
    [rad], `transl` (persons, frames, 3) [m, world]. NaN where a person is missing. The release has
    one body model; here `body_model` (1,) names it, since betas of another are meaningless.

    Args:
        path: the file.
        poses: (persons, frames); each person's betas are those of the first frame.
        body_model: name and version of the body model.
    """
    arrays: Mapping[str, NDArray[np.float64]] = {
        "betas": poses.betas[:, 0],
        "global_orient": poses.global_orient,
        "body_pose": poses.body_pose,
        "transl": poses.transl,
    }
    single = {name: array.astype(np.float32) for name, array in arrays.items()}
    write_archive(path, {**single, "body_model": np.array([body_model])})


def read_poses(path: Path) -> tuple[BodyParameters, str | None]:
    """Read the poses (persons, frames) of a pose file, with singular or plural names.

    Returns:
        The poses, and the name of their body model if the file has it.

    Raises:
        InputError: names file and member: absent, truncated, members missing or unknown, wrong
            shapes.
    """
    errors: list[InputError] = []
    for renamed in ({}, PLURALS):
        back = {name: plural for plural, name in renamed.items()}
        members = {back.get(name, name): member for name, member in MEMBERS.items()}
        try:
            arrays: dict[str, NDArray[Any]] = read_archive(path, members)
        except InputError as error:
            errors.append(error)
            continue
        named = {renamed.get(name, name): array for name, array in arrays.items()}
        poses = BodyParameters(
            betas=named["betas"][:, None],
            global_orient=named["global_orient"],
            body_pose=named["body_pose"],
            transl=named["transl"],
        )
        return poses, str(named["body_model"][0]) if "body_model" in named else None
    raise errors[0]
