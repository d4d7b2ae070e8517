"""Result of stage `refitting`: the arrays of `body_fitting`, from additional evidence."""

from __future__ import annotations

from data_contracts.arrays import array_layout
from data_contracts.body_fitting import BODY_FITTING

REFITTING = BODY_FITTING.model_copy(
    update={
        "stage": "refitting",
        "about": "Every person's body, fitted again with keypoints of the broadcast camera and "
        "shapes of other clips; or the bodies of people that the broadcast camera alone films.",
        "arrays": (
            *BODY_FITTING.arrays,
            array_layout(
                "recognised",
                "(*frame, person) bool [1]",
                "the broadcast camera contributed a view of the person",
            ),
            array_layout(
                "pooled", "(person) bool [1]", "other clips contributed to the person's shape"
            ),
            array_layout(
                "views",
                "(*frame, person, joint) int16 [1], missing 0",
                "1 where the broadcast camera shows the joint; only of people that no static "
                "camera films",
            ),
        ),
        "optional": ("views", *BODY_FITTING.optional),
        "attributes": {
            **BODY_FITTING.attributes,
            "without_body": "people that no static camera films and who have no body: id to reason",
        },
    }
)
