"""Settings of triangulation."""

from __future__ import annotations

from typing import Literal

from pydantic import Field

from data_contracts.records import Record


class TriangulationSettings(Record):
    """What counts as noise, as agreement and as enough views.

    A keypoint is expected to err by sqrt(pixel_noise^2 + (pixels per metre at the joint x
    joint_noise)^2) [px] per axis, so that one setting serves people of 60 and of 600 pixels; times
    factors for its joint and its confidence.
    """

    pixel_noise: float = Field(default=1.5, ge=1e-6, le=1000)
    """Standard deviation per image axis that does not depend on distance [px]: the grid
    of a detector."""
    joint_noise: float = Field(default=0.04, ge=0, le=10)
    """Standard deviation per axis that scales with the person [m]: what a human labels as a hip
    spreads by 2 to 3 % of body height (COCO's keypoint sigmas)."""
    learn_noise: bool = True
    """Learn the factors from how the clip's views disagree; False takes the noise as stated and
    its variance as one over the confidence."""
    common_bias: float = Field(default=0.024, ge=0, le=1)
    """Usual standard deviation per axis of what all views of a joint err in common [m]: a
    detector's labels mean another point than the joint's centre. No residual shows it; it is added
    to the covariance. With `learn_noise` every joint has a factor (`common_bias.BY_JOINT`), and
    the proportions of a clip's people say how far its detector goes. Joints of real people are 27
    mm per axis from hand-made labels (Shelf), of which the views' own noise is 10."""
    max_deviation: float = Field(default=3.5, ge=1e-6, le=1e6)
    """Observations farther than this from the joint, in standard deviations, are rejected [1]:
    0.2 % of honest ones (chi-square, two degrees of freedom)."""
    min_views: int = Field(default=2, ge=2, le=1000)
    """Least cameras that must agree [1]; a joint with fewer is missing."""
    min_angle: float = Field(default=0.1, ge=1e-6, le=10)
    """Least angle between the most different agreeing rays [rad]: below it a pixel moves the
    joint ten times as far along the rays as across them."""
    undo_swaps: bool = True
    """Put right detections whose left and right the other views show to be exchanged."""
    repair_limb_lengths: bool = True
    """Where few views carry the end of a limb of strange length, choose those that keep its length,
    or leave it out."""
    offsets: Literal["none", "midhip", "body"] = "body"
    """How calibration errors are kept from a person's pose (T4): "none" takes the cameras as
    exact; "midhip" moves every picture of a person so that the mid-hips meet, as the paper does;
    "body" moves it by what all joints together make probable."""
    calibration_error: float = Field(default=0.03, ge=1e-6, le=10)
    """Where "body" starts to learn how far cameras misplace people [m], when they come without
    covariance: what careful calibration from pitch markings leaves in the middle of the pitch."""
    max_gap: float = Field(default=0.5, ge=0, le=100)
    """Longest time without a triangulated joint that smoothing fills [s]: a stride."""
    clock_error: float = Field(default=0.05, ge=1e-6, le=10)
    """A camera's clock counts as known when its offset's standard error is below this [frame]."""
    correct_clocks: bool = False
    """Shift every camera's observations in time by the offset that the tracks show."""

    @property
    def noise(self) -> tuple[float, float]:
        """The stated noise [px], [m]."""
        return self.pixel_noise, self.joint_noise
