"""Result of stage `broadcast_tracking`: people of the broadcast camera on the pitch."""

from __future__ import annotations

from data_contracts.arrays import array_layout
from data_contracts.tracking import TRACKING

_GROUND = ("ground", "ground_velocity", "ground_covariance", "ground_height")

BROADCAST_TRACKING = TRACKING.model_copy(
    update={
        "stage": "broadcast_tracking",
        "about": "The people of a broadcast clip on the pitch, where no static camera films them.",
        "arrays": (
            array_layout(
                "detection_index",
                "(*frame, person) int16 [1], missing -1",
                "index among the clip's detections of the frame, in `ingest` or `detection`",
            ),
            *(TRACKING.layout(name) for name in _GROUND),
        ),
        "labels": {"axis": ("x", "y"), "axis_": ("x", "y")},
        "optional": (),
        "attributes": {
            "clip_id": "clip of the match",
            "tracks": "one `track` record per person",
        },
    }
)
