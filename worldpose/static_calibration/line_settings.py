"""Settings of the refinement on painted lines."""

from __future__ import annotations

from typing import Final

from pydantic import Field

from data_contracts.records import Record

SURVEY_ERROR: Final = 0.006
"""Default standard deviation of surveyed points from the painted ones, each axis [m]."""


class LineRefinementSettings(Record):
    """Sampling, search widths and acceptance thresholds of the refinement."""

    line_width: float = Field(default=0.12, ge=1e-6, le=100)
    """Width of the paint [m]: the maximum of Law 1, which most pitches have."""
    line_shift: float = Field(default=0.05, ge=0, le=10)
    """Standard deviation of errors that shift a whole marking in the image [px], such as sharpening
    or lens distortion beyond k1 and k2."""
    samples: int = Field(default=2000, ge=100, le=1_000_000)
    """Approximate maximum number of samples in the image [1]."""
    spacing: float = Field(default=4.0, ge=1e-6, le=1000)
    """Spacing of neighbouring samples in the image [px]."""
    reach: float = Field(default=40.0, ge=1e-6, le=10000)
    """Maximum search width of a sample [px], three standard deviations of its projection; others
    wait for a more accurate camera."""
    contrast: float = Field(default=6.0, ge=1e-6, le=1000)
    """Minimum brightness of paint above the grass on either side [levels of 255]."""
    loss: float = Field(default=3.0, ge=1e-6, le=1000)
    """Final scale of the robust loss [standard deviations]."""
    least_found: int = Field(default=30, ge=1, le=10000)
    """Minimum number of detected samples [1]."""
    least_share: float = Field(default=0.4, ge=0, le=1)
    """Minimum share of inliers among the samples in the image, and of each marking [1]: people
    occlude some samples, and paint is worn. A wrong camera may match a third, on wrong markings."""
    contradiction: float = Field(default=1e-6, gt=0, lt=1)
    """Minimum probability of a fit under the prior of the start [1]; below, it is rejected."""
