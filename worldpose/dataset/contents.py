"""A data set as its files give it: 3D points, cameras and 2D points of every clip, unjudged."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Any

import numpy as np
from numpy.typing import NDArray

from data_contracts.release import Finding
from worldpose.formats.camera_rows import CameraRows
from worldpose.formats.challenge import ChallengeClip

Floats = NDArray[np.float64]


@dataclass(frozen=True, eq=False)
class PointSource:
    """3D points of one file."""

    name: str
    """The file, relative to the data set."""
    skeleton: tuple[str, ...]
    """What the points are."""
    points: Floats
    """(frames, persons, points, 3) [m], world."""
    place: Floats | None = None
    """(frames, persons, 3), `transl` of poses; None where the file has points themselves."""
    pivot: Floats | None = None
    """(frames, persons, 3) [m], what turning about the origin and not the pelvis adds."""
    in_degrees: Floats | None = None
    """The points if the file's angles were degrees; None where they cannot be."""

    def moved(self, points: Floats) -> PointSource:
        """The same source with other points."""
        return PointSource(self.name, self.skeleton, points)


@dataclass(frozen=True, eq=False)
class View:
    """One camera, and where it has people in its picture."""

    name: str
    rows: CameraRows
    pixels: Floats | None = None
    """(frames, persons, points, 2) [px]; None where the data set has no 2D."""
    skeleton: tuple[str, ...] = ()


@dataclass(frozen=True, eq=False)
class ShippedClip:
    """Everything that a data set has of one clip."""

    name: str
    fps: float
    sources: tuple[PointSource, ...]
    views: tuple[View, ...]
    pitch: bool = True
    """Whether the ground is z = 0; otherwise the world is that of the cameras' calibration."""
    findings: tuple[Finding, ...] = field(default=())
    """What reading alone has shown."""
    given: ChallengeClip | None = None
    """Boxes and skeletons of the challenge's layout."""


def absent_rows(name: str, arrays: Mapping[str, NDArray[Any]]) -> tuple[Floats, list[Finding]]:
    """Return which of a file's persons and frames are missing, and what is wrong about it.

    Args:
        name: the file.
        arrays: (rows, columns, ...), what must be missing together.

    Returns:
        (rows, columns) bool, missing in any array or written as zeros in all; and findings.
    """
    flat = {key: array.reshape(*array.shape[:2], -1) for key, array in arrays.items()}
    partly = {key: np.isnan(array).any(-1) for key, array in flat.items()}
    missing = np.any(list(partly.values()), axis=0)
    findings = []
    if (uneven := missing & ~np.all(list(partly.values()), axis=0)).any():
        findings.append(
            Finding(
                fault="missing_values_disagree",
                kind="damage",
                where=(name,),
                says=f"{', '.join(flat)} are not missing (NaN) in the same frames",
                figures={"share_of_rows": float(uneven.mean())},
            )
        )
    zeros = np.all([(array == 0.0).all(-1) for array in flat.values()], axis=0)
    if zeros.any():
        findings.append(
            Finding(
                fault="zeros_for_missing",
                kind="convention",
                where=(name,),
                says=f"{', '.join(flat)} are exactly zero where nobody stands; missing is NaN",
                figures={"share_of_rows": float(zeros.mean())},
            )
        )
    gone: Floats = missing | zeros
    return gone, findings
