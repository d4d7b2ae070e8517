"""Settings of redetection."""

from __future__ import annotations

from pydantic import Field

from data_contracts.records import Record


class RedetectionSettings(Record):
    """Settings of the search for missed people, and acceptance thresholds."""

    enabled: bool = True
    """Whether redetection runs; otherwise detections stay as they are."""
    min_height_px: float = Field(default=40.0, ge=1e-6, le=10000)
    """Least height of a box in the frame [px]: the accuracy of detectors is measured down to this
    height."""
    min_visible_share: float = Field(default=0.5, ge=0, le=1)
    """Share of the joints that must lie in the frame with no nearer body in front [1]: for occluded
    people a net returns the occluder."""
    max_uncertainty_m: float = Field(default=0.15, ge=1e-6, le=100)
    """Largest median standard deviation of the joints across the view at which a body is searched
    for [m]: about half a trunk's width."""
    min_confidence: float = Field(default=0.5, ge=1e-6, le=1)
    """Least mean confidence of the twelve surest keypoints of a result [1]."""
    max_deviation: float = Field(default=2.5, ge=1e-6, le=1e6)
    """Keypoints farther from the body, in standard deviations, are left out [1]; that of
    `filtering`, which would reject them afterwards."""
    min_inlier_share: float = Field(default=0.7, ge=0, le=1)
    """Share of a result's keypoints within `max_deviation` that makes it the person's [1]; more
    than `filtering` requires of detections, which do not depend on the body."""
    min_similarity: float = Field(default=0.7, ge=-1, le=1)
    """Least mean cosine between a result's bones and the body's [1]: 45 degrees."""
    oks_nms: float = Field(default=0.7, ge=1e-6, le=1)
    """A result more similar than this to a detection in the frame, or to another result, is a
    duplicate [1, COCO's object keypoint similarity]."""
