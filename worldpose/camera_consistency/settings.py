"""Settings of the consistency check."""

from __future__ import annotations

from pydantic import Field

from data_contracts.records import Record


class ConsistencySettings(Record):
    """How many frames are compared, and what evidence names a camera."""

    leave_out: bool = True
    """Leave out cameras that are named; else the run goes on with them and warns."""
    sample_frames: int = Field(default=48, ge=4, le=10000)
    """Frames at which cameras are compared [1]."""
    stretch_frames: int = Field(default=500, ge=2, le=100_000)
    """Longest stretch of frames in which clocks are compared [frame]."""
    pixel_noise: float = Field(default=1.5, ge=1e-6, le=1000)
    """Standard deviation of a keypoint that is the same for people of every size [px]."""
