"""Settings of the refinement on painted lines."""

from __future__ import annotations

from typing import Final

from pydantic import Field

from data_contracts.records import Record

SURVEY_ERROR: Final = 0.006
"""Default of how far surveyed points are from the painted ones, each axis [m]."""


class LineRefinementSettings(Record):
    """What is looked for, how far off, and what is believed."""

    line_width: float = Field(default=0.12, ge=1e-6, le=100)
    """Of the paint [m]: Law 1 allows no more, and most pitches have it."""
    line_shift: float = Field(default=0.05, ge=0, le=10)
    """Standard deviation of what moves a whole marking in the picture [px], such as sharpening or
    a rest of the lens that k1 and k2 leave."""
    samples: int = Field(default=2000, ge=100, le=1_000_000)
    """Samples in the picture at most, about [1]."""
    spacing: float = Field(default=4.0, ge=1e-6, le=1000)
    """Between neighbouring samples in the picture [px]."""
    reach: float = Field(default=40.0, ge=1e-6, le=10000)
    """A sample is looked for where its projection is known to within this [px], three standard
    deviations; others wait until nearer ones have been found."""
    contrast: float = Field(default=6.0, ge=1e-6, le=1000)
    """Least brightness of paint above the grass on either side [levels of 255]."""
    loss: float = Field(default=3.0, ge=1e-6, le=1000)
    """Scale of the robust loss in the end [standard deviations]."""
    least_found: int = Field(default=30, ge=1, le=10000)
    """Fewer samples found make no line [1]."""
    least_share: float = Field(default=0.4, ge=0, le=1)
    """Least share of the samples in the picture, and of a marking's, that is found where the fit
    puts it [1]: people hide some, and worn paint. A wrong camera may find a third, on
    markings that it takes for others."""
    contradiction: float = Field(default=1e-6, gt=0, lt=1)
    """A fit that the start and its covariance give less than this probability is refused [1]."""
