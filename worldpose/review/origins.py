"""Origins of values: computed, corrected by a person, filled by the motion model, or rejected."""

from __future__ import annotations

from collections.abc import Collection, Iterable, Mapping
from typing import Final, get_args

import numpy as np
from numpy.typing import NDArray

from data_contracts.review import Correction, MovedPoint, Origin, RedrawnMarking
from worldpose.review.detections import DETECTION_EDITS
from worldpose.review.identities import IDENTITY_EDITS

ORIGINS: Final[tuple[Origin, ...]] = get_args(Origin)
"""Origins in the order of their codes in arrays: automatic 0, corrected 1, filled 2, rejected 3."""


def unit_origins(
    made_from: Mapping[str, Collection[str]],
    applied: Iterable[Correction],
    rejected: Collection[str],
) -> dict[str, Origin]:
    """Return the origin of each unit's result, by `stage/unit`.

    A rejection propagates to all units computed from the rejected one; a correction marks only the
    unit with corrected evidence, and units computed from it are automatic.

    Args:
        made_from: for each unit, its input units.
        applied: the corrections in the results.
        rejected: units whose last verdict is a rejection.
    """
    corrected = set()
    for edit in (correction.edit for correction in applied):
        if isinstance(edit, MovedPoint | RedrawnMarking):
            stage = "static_calibration" if edit.frame is None else "broadcast_calibration"
            corrected.add(f"{stage}/{edit.camera}")
        elif isinstance(edit, IDENTITY_EDITS):
            corrected.add(f"tracking/{edit.clip}")
        elif isinstance(edit, DETECTION_EDITS):
            corrected |= _seen_by(edit.camera, made_from)
    refused = set(rejected)
    while more := {
        unit for unit, sources in made_from.items() if unit not in refused and refused & {*sources}
    }:
        refused |= more
    return {
        unit: "rejected" if unit in refused else "corrected" if unit in corrected else "automatic"
        for unit in made_from
    }


def _seen_by(camera: str, units: Collection[str]) -> set[str]:
    """Return the units of a camera's detections: its detection units, or else its ingest unit."""
    found = f"detection/{camera}"
    detected = {unit for unit in units if unit == found or unit.startswith(f"{found}.")}
    return detected or {f"ingest/{camera}"}


def joint_origins(
    joints: NDArray[np.floating], filled: NDArray[np.bool_], unit: Origin
) -> NDArray[np.int8]:
    """Return the code of each joint's origin: an index into `ORIGINS`, -1 for missing joints.

    Args:
        joints: (frames, persons, joints, 3) [m], world; NaN where missing.
        filled: (frames, persons, joints) or (frames, persons): from the motion model alone.
        unit: origin of the whole result; all joints of a rejected result are rejected.
    """
    code = np.full(joints.shape[:-1], ORIGINS.index(unit), dtype=np.int8)
    if unit != "rejected":
        by_joint = filled if filled.ndim == joints.ndim - 1 else filled[..., None]
        code[np.broadcast_to(by_joint, code.shape)] = ORIGINS.index("filled")
    code[np.isnan(joints).any(axis=-1)] = -1
    return code
