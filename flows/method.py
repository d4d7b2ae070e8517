"""The method: its stages in the paper's order, and where people are asked.

Read it beside docs/architecture.md. A stage that is not in the tuple does not exist; the comments
hold the places of those to come, with their units and checklist ids.
"""

from __future__ import annotations

from flows import (
    body_fitting,
    bundle_adjustment,
    ingest,
    retriangulation,
    static_calibration,
    tracking,
    triangulation,
)
from flows.stage import Stage

METHOD: tuple[Stage, ...] = (
    ingest.STAGE,  # [camera]
    static_calibration.STAGE,  # [camera]  C1-C5; then a gate, C7
    # detection [camera, chunk]         people and keypoints from pixels, D1-D5; then a gate, D6
    tracking.STAGE,  # [clip]           T1, T2
    triangulation.STAGE,  # [clip]      T3, T4; then a gate
    bundle_adjustment.STAGE,  #         B1-B3; then a gate
    retriangulation.STAGE,  # [clip]    B2
    body_fitting.STAGE,  # [clip]       S1-S3
    # broadcast_calibration [clip]      M1-M6; then a gate
    # release, evaluation               X1-X3, E1-E6; clip acceptance is the last gate
)
