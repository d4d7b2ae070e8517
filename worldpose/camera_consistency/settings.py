"""Settings of the consistency of cameras."""

from __future__ import annotations

from pydantic import Field

from data_contracts.records import Record


class ConsistencySettings(Record):
    """Number of compared frames, and evidence required for a fault."""

    leave_out: bool = True
    """Exclude faulty cameras; else the run continues with them and warns."""
    sample_frames: int = Field(default=48, ge=4, le=10000)
    """Frames at which cameras are compared [frame]."""
    max_chunk_frames: int = Field(default=500, ge=2, le=100_000)
    """Longest chunk of frames in which clocks are compared [frame]."""
    pixel_noise_px: float = Field(default=1.5, ge=1e-6, le=1000)
    """Standard deviation of a keypoint, independent of people's size [px]."""
