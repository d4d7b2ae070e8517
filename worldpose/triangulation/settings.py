"""Settings of triangulation."""

from __future__ import annotations

from pydantic import Field

from data_contracts.records import Record


class TriangulationSettings(Record):
    """What counts as noise, as agreement and as enough views.

    A keypoint of confidence c is expected to err by
    sqrt(pixel_noise^2 + (pixels per metre at the joint x joint_noise)^2) / sqrt(c) [px] per axis,
    so that one setting serves people of 60 and of 600 pixels.
    """

    pixel_noise: float = Field(default=1.5, gt=0)
    """Standard deviation per image axis that does not depend on distance [px]: the grid
    of a detector, and calibration."""
    joint_noise: float = Field(default=0.04, ge=0)
    """Standard deviation per axis that scales with the person [m]: what a human labels as a hip
    spreads by 2 to 3 % of body height (COCO's keypoint sigmas)."""
    max_deviation: float = Field(default=3.5, gt=0)
    """Observations farther than this from the joint, in standard deviations, are rejected [1]:
    0.2 % of honest ones (chi-square, two degrees of freedom)."""
    min_views: int = Field(default=2, ge=2)
    """Least cameras that must agree [1]; a joint with fewer is missing."""
    min_angle: float = Field(default=0.1, gt=0)
    """Least angle between the most different agreeing rays [rad]: below it a pixel moves the
    joint ten times as far along the rays as across them."""
