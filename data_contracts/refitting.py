"""Result of stage `refitting`: the arrays of `body_fitting`, from additional evidence."""

from __future__ import annotations

from data_contracts.arrays import ArrayLayout
from data_contracts.body_fitting import BODY_FITTING

REFITTING = BODY_FITTING.model_copy(
    update={
        "stage": "refitting",
        "about": "Every person's body, fitted again with keypoints of the broadcast camera and "
        "shapes of other clips; or the bodies of people that the broadcast camera alone films.",
        "arrays": (
            *BODY_FITTING.arrays,
            ArrayLayout(
                name="recognised",
                dims=("frame", "person"),
                dtype="bool",
                unit="1",
                missing="none",
                about="the broadcast camera contributed a view of the person",
                chunk_dim="frame",
            ),
            ArrayLayout(
                name="pooled",
                dims=("person",),
                dtype="bool",
                unit="1",
                missing="none",
                about="other clips contributed to the person's shape",
            ),
            ArrayLayout(
                name="views",
                dims=("frame", "person", "joint"),
                dtype="int16",
                unit="1",
                missing="0",
                about="1 where the broadcast camera shows the joint; only of people that no static "
                "camera films",
                chunk_dim="frame",
            ),
        ),
        "optional": ("views", *BODY_FITTING.optional),
        "attributes": {
            **BODY_FITTING.attributes,
            "without_body": "people that no static camera films and who have no body: id to reason",
        },
    }
)
