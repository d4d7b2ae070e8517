"""Settings of filtering."""

from __future__ import annotations

from pydantic import Field

from data_contracts.records import Record


class FilteringSettings(Record):
    """What counts as a contradiction between a body and a detection."""

    max_deviation: float = Field(default=2.5, ge=1e-6, le=1e6)
    """Keypoints farther from their body, in standard deviations, are rejected [1]. Keypoints
    that are put 4 to 10 of the detector's own deviations off are found to more than nine tenths,
    and one to two in a hundred honest ones are lost; at 3.5, eight tenths and one in a thousand."""
    least_fitting: float = Field(default=0.5, ge=0, le=1)
    """Share of its keypoints within `max_deviation` that makes a box the body's [1]: a person who
    hides half of another is the other's no more."""
    least_similarity: float = Field(default=0.5, ge=-1, le=1)
    """Least mean cosine between a box's bones and the body's [1]: 60 degrees, which two strangers
    who run the same way stay below, and a body with its sides exchanged does not."""
    fewest: int = Field(default=5, ge=1, le=1000)
    """A box with fewer keypoints on a body is not judged as a whole [1]."""
    held_out_frames: int = Field(default=64, ge=1, le=10000)
    """Most frames, evenly spread, in which cameras are left out to be foreseen [1]: with 20 people
    before 16 cameras a quarter of a million keypoints."""
