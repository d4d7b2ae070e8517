"""Body poses of a clip as the WorldPose release has them (X3), and the npz file that holds them."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import Any, Final

import numpy as np
from numpy.typing import NDArray

from worldpose.body import BodyParameters
from worldpose.errors import InputError
from worldpose.release.archives import Member, read_archive, write_archive

MEMBERS: Final = {
    "betas": Member(("persons", "shapes"), "float"),
    "global_orient": Member(("persons", "frames", 3), "float"),
    "body_pose": Member(("persons", "frames", 69), "float"),
    "transl": Member(("persons", "frames", 3), "float"),
}
"""Arrays of a pose file; persons first, unlike everywhere else here."""
PLURALS: Final = {"global_orients": "global_orient", "body_poses": "body_pose"}
"""Names in the release's own note, which are read as well."""


def write_poses(path: Path, poses: BodyParameters) -> None:
    """Write `poses/<clip>.npz`, whole or not at all; the same poses give the same bytes.

    Members in single precision, 4 um at most beside the poses on a pitch of 105 m: `betas`
    (persons, shapes), `global_orient` (persons, frames, 3) [rad], `body_pose` (persons, frames, 69)
    [rad], `transl` (persons, frames, 3) [m, world]. NaN where a person is missing. The file does
    not name its body model: the release knows one.

    Args:
        path: the file.
        poses: (persons, frames); each person's betas are those of the first frame.
    """
    arrays: Mapping[str, NDArray[np.float64]] = {
        "betas": poses.betas[:, 0],
        "global_orient": poses.global_orient,
        "body_pose": poses.body_pose,
        "transl": poses.transl,
    }
    write_archive(path, {name: array.astype(np.float32) for name, array in arrays.items()})


def read_poses(path: Path) -> BodyParameters:
    """The poses (persons, frames) of a pose file, with singular or plural names.

    Raises:
        InputError: naming file and member: absent, truncated, members missing or unknown, wrong
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
        return BodyParameters(
            betas=named["betas"][:, None],
            global_orient=named["global_orient"],
            body_pose=named["body_pose"],
            transl=named["transl"],
        )
    raise errors[0]
