"""3D joints of people over time, and their npz file format."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Any, Final

import numpy as np
from numpy.typing import NDArray

from data_contracts.conventions import COCO17
from worldpose.errors import InputError
from worldpose.formats.archives import Member, read_archive, write_archive, wrong

JOINTS: Final = len(COCO17)

MEMBERS: Final = {
    "frames": Member(("frames",), "int"),
    "person_ids": Member(("persons",), "int"),
    "joints": Member(("frames", "persons", JOINTS, 3), "float"),
    "covariance": Member(("frames", "persons", JOINTS, 3, 3), "float", required=False),
    "views": Member(("frames", "persons", JOINTS), "int", required=False),
}
"""Arrays of a joints file; `covariance` and `views` are optional."""


@dataclass(frozen=True, eq=False)
class JointTracks:
    """3D joints of several people over time, estimated or true.

    Raises:
        InputError: shapes disagree, frames do not ascend, a duplicate id, a value is infinite, or a
            joint has some but not all of its coordinates.
    """

    frames: NDArray[np.int64]
    """(frames,) match frames, ascending."""
    person_ids: NDArray[np.int64]
    """(persons,), unique."""
    joints: NDArray[np.float64]
    """(frames, persons, 17, 3) [m], world, COCO-17 order; NaN where missing."""
    covariance: NDArray[np.float64] | None = None
    """(frames, persons, 17, 3, 3) [m^2]; None if unknown."""
    views: NDArray[np.int64] | None = None
    """(frames, persons, 17) number of cameras used for the joint, or that saw it for ground
    truth."""

    def __post_init__(self) -> None:
        shape = (*self.frames.shape, *self.person_ids.shape, JOINTS)
        shapes: dict[str, tuple[NDArray[Any], tuple[int, ...]]] = {
            "joints": (self.joints, (*shape, 3))
        }
        if self.covariance is not None:
            shapes["covariance"] = (self.covariance, (*shape, 3, 3))
        if self.views is not None:
            shapes["views"] = (self.views, shape)
        for name, (array, expected) in shapes.items():
            if array.shape != expected:
                raise wrong(name, f"shape {expected}", f"{array.shape}", "Give all arrays alike.")
        if np.any(np.diff(self.frames) <= 0):
            raise wrong("frames", "frame numbers that rise", f"{self.frames}", "Sort the frames.")
        if len(np.unique(self.person_ids)) < len(self.person_ids):
            raise wrong("person_ids", "each id once", f"{self.person_ids}", "Number people anew.")
        missing = np.isnan(self.joints)
        self._refuse(
            "joints", np.any(np.isinf(self.joints), axis=-1), "finite metres, NaN where missing"
        )
        self._refuse(
            "joints", np.any(missing, axis=-1) & ~np.all(missing, axis=-1), "all of x, y, z or none"
        )
        if self.covariance is not None:
            self._refuse(
                "covariance", np.any(np.isinf(self.covariance), axis=(-1, -2)), "finite numbers"
            )
        if self.views is not None:
            self._refuse("views", self.views < 0, "counts from 0")

    def _refuse(self, name: str, bad: NDArray[np.bool_], expected: str) -> None:
        if not bad.any():
            return
        frame, person, joint = (int(i) for i in np.argwhere(bad)[0])
        place = f"frame {self.frames[frame]}, person {self.person_ids[person]}, {COCO17[joint]}"
        raise wrong(
            f"{name}[{place}]",
            expected,
            f"{getattr(self, name)[frame, person, joint]}",
            "Correct it.",
        )


def write_joints(path: Path, tracks: JointTracks) -> None:
    """Write a joints file, whole or not at all; equal tracks give equal bytes.

    Members: `frames` (frames,) int64, `person_ids` (persons,) int64, `joints` (frames, persons,
    17, 3) float64 [m, world], and where known `covariance` (frames, persons, 17, 3, 3) float64
    [m^2] and `views` (frames, persons, 17) uint8.
    """
    arrays: dict[str, NDArray[np.generic]] = {
        "frames": tracks.frames.astype(np.int64),
        "person_ids": tracks.person_ids.astype(np.int64),
        "joints": tracks.joints.astype(np.float64),
    }
    if tracks.covariance is not None:
        arrays["covariance"] = tracks.covariance.astype(np.float64)
    if tracks.views is not None:
        arrays["views"] = tracks.views.astype(np.uint8)
    write_archive(path, arrays)


def read_joints(path: Path) -> JointTracks:
    """Read the tracks of a joints file.

    Raises:
        InputError: names file and place: absent, truncated, members missing or unknown, wrong
            shapes, infinite values.
    """
    arrays = read_archive(path, MEMBERS)
    try:
        return JointTracks(**arrays)
    except InputError as error:
        raise InputError(
            f"{path}: {error.where}", expected=error.expected, found=error.found, todo=error.todo
        ) from error
