"""The method: its stages in the paper's order. Its review gates are in `flows.gates`.

See docs/explanation/architecture.md. Only the stages of this tuple exist; the comments mark the
places of planned ones, with their units and checklist ids.
"""

from __future__ import annotations

from collections.abc import Iterable

from flows.stage import Stage
from flows.stages import (
    body_fitting,
    broadcast_calibration,
    bundle_adjustment,
    camera_consistency,
    detection,
    filtering,
    ingest,
    proposal,
    static_calibration,
    tracking,
    triangulation,
)

METHOD: tuple[Stage, ...] = (
    ingest.STAGE,  # [camera]
    proposal.STAGE,  # [camera], without clicks  C2
    static_calibration.STAGE,  # [camera]  C1-C5; then gate CAMERAS, C7
    detection.STAGE,  # [camera, clip]  D1-D5; then gate PEOPLE, D6
    filtering.REDETECTION,  # [camera, clip]  R2, from the second iteration on
    camera_consistency.STAGE,  # [clip]  then gate CONSISTENCY
    tracking.STAGE,  # [clip]           T1, T2; then gate IDENTITIES
    triangulation.STAGE,  # [clip]      T3, T4; then gate JOINTS
    bundle_adjustment.STAGE,  #         B1-B3; then gate ADJUSTMENT
    triangulation.RETRIANGULATION,  # [clip]  B2
    body_fitting.STAGE,  # [clip]       S1-S3; then gate ACCEPTANCE of the clip
    broadcast_calibration.STAGE,  # [clip]  M1-M6; then gate BROADCAST
    broadcast_calibration.POOLING,  # [clip]  M1
    broadcast_calibration.TRACKING,  # [clip]  without static cameras
    body_fitting.REFITTING,  # [clip]   S1, S4
    filtering.STAGE,  # [clip]          R2; then again from tracking, R1 (flows/iterate.py)
    # release, evaluation               X1-X3, E1-E6
)


def task_modules(stages: Iterable[str]) -> list[str]:
    """Return the modules with the tasks of some stages, sorted."""
    names = set(stages)
    return sorted({stage.task_module for stage in METHOD if stage.name in names})


def unit_order(name: str) -> tuple[int, str]:
    """Return the sort key of a unit, `stage/unit`: in the order of the method, then by name."""
    stage = name.partition("/")[0]
    names = [each.name for each in METHOD]
    return (names.index(stage) if stage in names else len(names), name)
