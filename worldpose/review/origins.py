"""Where values come from: computed, corrected by a person, filled by motion, or refused."""

from __future__ import annotations

from collections.abc import Collection, Iterable, Mapping
from typing import Final, get_args

import numpy as np
from numpy.typing import NDArray

from data_contracts.review import Correction, MovedPoint, Origin, RedrawnMarking
from worldpose.review.detections import DETECTION_EDITS
from worldpose.review.identities import IDENTITY_EDITS

ORIGINS: Final[tuple[Origin, ...]] = get_args(Origin)
"""In the order of their codes in arrays: automatic 0, corrected 1, filled 2, rejected 3."""


def unit_origins(
    made_from: Mapping[str, Collection[str]],
    applied: Iterable[Correction],
    rejected: Collection[str],
) -> dict[str, Origin]:
    """Where each unit's result comes from, by `stage/unit`.

    A person's refusal reaches all that is made from what was refused; a correction marks the unit
    whose evidence was corrected, and what is computed from that is automatic.

    Args:
        made_from: for each unit, the units that it is made from.
        applied: the corrections that the results hold.
        rejected: units whose last verdict is a refusal.
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
    """The units with whom a camera sees: where it has none that found them, they were given."""
    found = f"detection/{camera}"
    detected = {unit for unit in units if unit == found or unit.startswith(f"{found}.")}
    return detected or {f"ingest/{camera}"}


def joint_origins(
    joints: NDArray[np.floating], filled: NDArray[np.bool_], unit: Origin
) -> NDArray[np.int8]:
    """The code of each joint's origin: a place in `ORIGINS`, -1 where there is no joint.

    Args:
        joints: (frames, persons, joints, 3) [m], world; NaN where missing.
        filled: (frames, persons, joints) or (frames, persons): there by motion alone.
        unit: origin of the whole result; a refused one has refused joints only.
    """
    code = np.full(joints.shape[:-1], ORIGINS.index(unit), dtype=np.int8)
    if unit != "rejected":
        by_joint = filled if filled.ndim == joints.ndim - 1 else filled[..., None]
        code[np.broadcast_to(by_joint, code.shape)] = ORIGINS.index("filled")
    code[np.isnan(joints).any(axis=-1)] = -1
    return code
