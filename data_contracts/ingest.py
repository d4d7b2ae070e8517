"""Result of stage `ingest`: what a match folder brought in for one camera."""

from __future__ import annotations

from data_contracts.arrays import GroupLayout
from data_contracts.observations import FRAME, OBSERVATION_ARRAYS, OBSERVATION_LABELS

INGEST = GroupLayout(
    stage="ingest",
    about="Given 2D poses of one camera, on the match's clock.",
    coordinates=(FRAME,),
    arrays=OBSERVATION_ARRAYS,
    labels=OBSERVATION_LABELS,
    attributes={"camera_id": "camera of the match, or clip of its broadcast camera"},
)
