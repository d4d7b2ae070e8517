"""Result of stage `evaluation`: figures against truth; an absent figure could not be computed."""

from __future__ import annotations

from data_contracts.records import Record


class Evaluation(Record):
    """Scores of a prediction against a reference (definitions: docs/metrics.md)."""

    mpjpe_mm: float | None = None
    """Mean distance of matched joints without any alignment [mm]."""
    pcp3d: float | None = None
    """Share of correct limbs at alpha 0.5, missing limbs counted wrong [%]."""
    coverage: float | None = None
    """Share of true person-frames that have a matched prediction [0..1]."""
    joint_coverage: float | None = None
    """Share of true joints that have a predicted joint [0..1]."""
    false_persons_per_frame: float | None = None
    """Predicted people in a frame that match no true one, mean."""
    persons: int | None = None
    """True people."""
    frames: int | None = None
    """Frames scored."""
