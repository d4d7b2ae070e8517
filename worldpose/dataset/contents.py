"""Content of a data set's files, unvalidated: 3D points, cameras and 2D points per clip."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Any

import numpy as np
from numpy.typing import NDArray

from data_contracts.arrays import Floats
from data_contracts.release import Finding
from worldpose.formats.camera_file import CameraRows
from worldpose.formats.challenge import ChallengeClip


@dataclass(frozen=True, eq=False)
class PointSource:
    """3D points of one file."""

    name: str
    """The file, relative to the data set."""
    skeleton: tuple[str, ...]
    """Names of the points."""
    points: Floats
    """(frames, persons, points, 3) [m], world."""
    place: Floats | None = None
    """(frames, persons, 3), `transl` of poses; None if the file has points instead of poses."""
    pivot: Floats | None = None
    """(frames, persons, 3) [m], difference between rotation about the origin and about the
    pelvis."""
    in_degrees: Floats | None = None
    """The points if the file's angles were degrees; None if they cannot be."""

    def moved(self, points: Floats) -> PointSource:
        """Return the same source with other points."""
        return PointSource(self.name, self.skeleton, points)


@dataclass(frozen=True, eq=False)
class View:
    """One camera and its 2D points of people."""

    name: str
    rows: CameraRows
    pixels: Floats | None = None
    """(frames, persons, points, 2) [px]; None if the data set has no 2D."""
    skeleton: tuple[str, ...] = ()


@dataclass(frozen=True, eq=False)
class ShippedClip:
    """All data of one clip."""

    name: str
    fps: float
    sources: tuple[PointSource, ...]
    views: tuple[View, ...]
    pitch: bool = True
    """Whether the ground is z = 0; otherwise the world frame is that of the camera calibration."""
    findings: tuple[Finding, ...] = field(default=())
    """Findings of the reader."""
    given: ChallengeClip | None = None
    """Boxes and skeletons of the challenge's layout."""


def absent_rows(name: str, arrays: Mapping[str, NDArray[Any]]) -> tuple[Floats, list[Finding]]:
    """Return a mask of missing persons and frames of a file, and findings on it.

    Args:
        name: the file.
        arrays: (rows, columns, ...), which must be missing together.

    Returns:
        (rows, columns) bool, missing in any array or zero in all; and findings.
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
