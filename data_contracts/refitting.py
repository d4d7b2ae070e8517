"""Result of stage `refitting`: the arrays of `body_fitting`, from additional evidence."""

from __future__ import annotations

from data_contracts.arrays import ArrayLayout
from data_contracts.body_fitting import BODY_FITTING

REFITTING = BODY_FITTING.model_copy(
    update={
        "stage": "refitting",
        "about": "Every person's body, fitted again with keypoints of the broadcast camera and "
        "shapes of other clips.",
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
        ),
    }
)
