"""Settings of filtering."""

from __future__ import annotations

from pydantic import Field

from data_contracts.records import Record


class FilteringSettings(Record):
    """Limits of the consistency check between bodies and detections."""

    max_deviation: float = Field(default=2.5, ge=1e-6, le=1e6)
    """Keypoints farther from their body, in standard deviations, are rejected [1]. More than nine
    tenths of keypoints with errors of 4 to 10 of the detector's own deviations are found, and one
    to two in a hundred correct ones are lost; at 3.5, eight tenths and one in a thousand."""
    min_inlier_share: float = Field(default=0.5, ge=0, le=1)
    """Minimum share of keypoints within `max_deviation` for a match of box and body [1]: the box of
    a person in front of another then no longer matches the occluded person."""
    min_similarity: float = Field(default=0.5, ge=-1, le=1)
    """Minimum mean cosine between a box's bones and the body's [1]: 60 degrees, more than between
    two strangers running the same way, and less than for a body with a left-right swap."""
    min_keypoints: int = Field(default=5, ge=1, le=1000)
    """A box with fewer keypoints on a body is not judged as a whole [1]."""
    max_held_out_frames: int = Field(default=64, ge=1, le=10000)
    """Maximum frames, evenly spread, for the prediction of held-out cameras [frame]: with 20
    people in 16 cameras a quarter of a million keypoints."""
