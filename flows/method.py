"""The method: its stages in the paper's order; the review gates are in `flows.gates`.

The comments are their units; docs/explanation/architecture.md says what each does.
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
    ingest.STAGE,  # camera, broadcast view
    proposal.STAGE,  # camera without clicks
    static_calibration.STAGE,  # camera
    detection.STAGE,  # camera and clip, broadcast view
    filtering.REDETECTION,  # camera and clip, from the second iteration on
    camera_consistency.STAGE,  # clip
    tracking.STAGE,  # clip
    triangulation.STAGE,  # clip
    bundle_adjustment.STAGE,  # match
    triangulation.RETRIANGULATION,  # clip
    body_fitting.STAGE,  # clip
    broadcast_calibration.STAGE,  # broadcast view
    broadcast_calibration.POOLING,  # broadcast view
    broadcast_calibration.TRACKING,  # clip without static cameras
    body_fitting.REFITTING,  # clip
    filtering.STAGE,  # clip; then again from tracking (flows/iterate.py)
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
