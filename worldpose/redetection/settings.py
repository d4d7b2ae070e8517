"""Settings of redetection."""

from __future__ import annotations

from pydantic import Field

from data_contracts.records import Record


class RedetectionSettings(Record):
    """Where people are looked for again, and which answers are theirs."""

    enabled: bool = True
    """Whether people are looked for at all; otherwise detections stay as they are."""
    least_height_px: float = Field(default=40.0, ge=1e-6, le=10000)
    """Whose box is lower in the picture is not looked for [px]: detectors are measured down to
    this height."""
    least_in_sight: float = Field(default=0.5, ge=0, le=1)
    """Share of the joints that must lie in the picture with no nearer body before them [1]: of
    those who are hidden a net finds whoever hides them."""
    most_unsure_m: float = Field(default=0.15, ge=1e-6, le=100)
    """Median standard deviation of the joints across the view, up to which it is known where to
    look [m]: about half a trunk's width."""
    least_confidence: float = Field(default=0.5, ge=1e-6, le=1)
    """Least mean confidence of the twelve surest keypoints of an answer [1]."""
    max_deviation: float = Field(default=2.5, ge=1e-6, le=1e6)
    """Keypoints farther from the body, in standard deviations, are left out [1]; that of
    `filtering`, which would reject them afterwards."""
    least_fitting: float = Field(default=0.7, ge=0, le=1)
    """Share of an answer's keypoints within `max_deviation` that makes it the person's [1]; more
    than `filtering` asks of detections, which were looked for without knowing where."""
    least_similarity: float = Field(default=0.7, ge=-1, le=1)
    """Least mean cosine between an answer's bones and the body's [1]: 45 degrees."""
    same_pose: float = Field(default=0.7, ge=1e-6, le=1)
    """An answer more alike than this to a detection of the picture, or to another answer, is that
    [1, COCO's object keypoint similarity]."""
