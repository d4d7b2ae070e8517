"""Result of stage `refitting`: the arrays of `body_fitting`, and what more they rest on."""

from __future__ import annotations

from data_contracts.arrays import ArrayLayout
from data_contracts.body_fitting import BODY_FITTING

REFITTING = BODY_FITTING.model_copy(
    update={
        "stage": "refitting",
        "about": "Every person's body fitted again with what the broadcast camera and other clips "
        "say.",
        "arrays": (
            *BODY_FITTING.arrays,
            ArrayLayout(
                name="recognised",
                dims=("frame", "person"),
                dtype="bool",
                unit="1",
                missing="none",
                about="a person whom the broadcast camera saw, as one more view",
                chunk_dim="frame",
            ),
            ArrayLayout(
                name="pooled",
                dims=("person",),
                dtype="bool",
                unit="1",
                missing="none",
                about="a person whose shape other clips had a say in",
            ),
        ),
    }
)
