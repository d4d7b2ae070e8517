"""Origin of every joint of a clip: triangulated from views, filled in, or corrected."""

from __future__ import annotations

from pathlib import Path
from typing import Final

import numpy as np
from numpy.typing import NDArray

from worldpose.formats.archives import Member, read_archive, write_archive
from worldpose.formats.joints_file import JOINTS, JointTracks

ORIGINS: Final = ("absent", "automatic", "filled", "corrected")
"""Meanings of the origin codes."""

MEMBERS: Final = {
    "frames": Member(("frames",), "int"),
    "person_ids": Member(("persons",), "int"),
    "origin": Member(("frames", "persons", JOINTS), "int"),
    "origin_names": Member((len(ORIGINS),), "text"),
}


def origins_of(
    tracks: JointTracks, corrected: NDArray[np.bool_] | None = None
) -> NDArray[np.uint8]:
    """Return the origin of joints (frames, persons, 17), indices of `ORIGINS`.

    A joint without a contributing camera was filled in, from motion or from the rest of the body.

    Args:
        tracks: joints with their views; unknown views count as seen.
        corrected: (frames, persons, 17), set or confirmed by a person.
    """
    origin = np.full(tracks.joints.shape[:3], ORIGINS.index("automatic"), dtype=np.uint8)
    if tracks.views is not None:
        origin[tracks.views == 0] = ORIGINS.index("filled")
    if corrected is not None:
        origin[corrected] = ORIGINS.index("corrected")
    origin[np.isnan(tracks.joints).any(-1)] = ORIGINS.index("absent")
    return origin


def write_origins(path: Path, tracks: JointTracks, origin: NDArray[np.uint8]) -> None:
    """Write origins/<clip>.npz: `frames`, `person_ids`, `origin`, and the meanings of its codes."""
    write_archive(
        path,
        {
            "frames": tracks.frames,
            "person_ids": tracks.person_ids,
            "origin": origin,
            "origin_names": np.array(ORIGINS),
        },
    )


def read_origins(path: Path) -> NDArray[np.int64]:
    """Read the origins (frames, persons, 17) of a file.

    Raises:
        InputError: names file and member.
    """
    origin: NDArray[np.int64] = read_archive(path, MEMBERS)["origin"]
    return origin
