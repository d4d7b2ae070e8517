"""Settings of triangulation."""

from __future__ import annotations

from typing import Literal

from pydantic import Field

from data_contracts.records import Record


class TriangulationSettings(Record):
    """Noise, inlier limit and minimum views of triangulation.

    The expected error of a keypoint is sqrt(pixel_noise_px^2 + (pixels per metre at the joint x
    joint_noise_m)^2) [px] per axis, times factors for its joint and its confidence. So one setting
    serves people of 60 and of 600 pixels.
    """

    method: Literal["worldpose", "paper", "paper_midhip"] = "worldpose"
    """Method: `paper` is plain least squares over all views in each frame, and `paper_midhip` the
    same with the mid-hips of each person moved together (needs the extra `body`)."""
    pixel_noise_px: float = Field(default=1.5, ge=1e-6, le=1000)
    """Standard deviation per image axis that does not depend on distance [px]: the grid
    of a detector."""
    joint_noise_m: float = Field(default=0.04, ge=0, le=10)
    """Standard deviation per axis that scales with the person [m]: human labels of a hip spread by
    2 to 3 % of body height (COCO's keypoint sigmas)."""
    learn_noise: bool = True
    """Learn the factors from residuals between the clip's views; False uses the stated noise, with
    a variance proportional to the inverse confidence."""
    common_bias_m: float = Field(default=0.018, ge=0, le=1)
    """Usual standard deviation per axis of the error that all views of a joint share [m]: a
    detector's labels mean another point than the joint's centre, and that depends on the pose. No
    residual shows it; it is added to the covariance, and more of it where views miss the joint
    (`noise_model.shared_variance`). With `learn_noise` the proportions of a clip's people determine
    its size. Joints of real people are 22 mm per axis from hand-made labels and a constant offset
    for each joint (Shelf, frames 300 to 420); 10 of these are noise of the views."""
    max_deviation: float = Field(default=3.5, ge=1e-6, le=1e6)
    """Observations farther than this from the joint, in standard deviations, are rejected [1]: 0.2
    % of correct ones (chi-square, two degrees of freedom). It is also the limit for left-right
    swaps and limb lengths, and the scale of the losses of smoothing and clocks."""
    min_views: int = Field(default=2, ge=2, le=1000)
    """Minimum inlier cameras [1]; a joint with fewer is missing."""
    min_angle_rad: float = Field(default=0.1, ge=1e-6, le=10)
    """Minimum of the widest angle between inlier rays [rad]: below it a pixel moves the joint ten
    times as far along the rays as across them."""
    undo_swaps: bool = True
    """Correct left-right swaps that contradict the other views."""
    repair_limb_lengths: bool = True
    """For a limb of wrong length whose end has few inlier views, choose the views that keep its
    length, or drop the end."""
    offsets: Literal["none", "midhip", "body"] = "body"
    """How calibration errors are kept from a person's pose: "none" treats the cameras as
    exact; "midhip" shifts every image of a person so that the mid-hips meet, as the paper does;
    "body" shifts it by the most probable offset of all joints together."""
    calibration_error_m: float = Field(default=0.03, ge=1e-6, le=10)
    """Initial displacement of people by calibration errors [m], from which "body" learns if cameras
    have no covariance: the residual error of careful calibration from pitch markings in the middle
    of the pitch."""
    max_filled_gap_s: float = Field(default=0.5, ge=0, le=100)
    """Longest time without a triangulated joint that smoothing fills [s]: a stride."""
    max_clock_error_frames: float = Field(default=0.05, ge=1e-6, le=10)
    """A camera's clock offset is determined if its standard error is below this [frame]."""
    correct_clocks: bool = False
    """Shift every camera's observations in time by the clock offset estimated from tracks."""

    max_frames: int = Field(default=1000, ge=1, le=10_000_000)
    """Maximum frames of a match that the first triangulation computes, evenly spread over its clips
    [frame]. Bundle adjustment reads no others; retriangulation then computes every frame."""

    def stride(self, frames: int) -> int:
        """Return the step between frames of the first triangulation of a match of `frames`."""
        return -(-frames // self.max_frames)

    @property
    def noise(self) -> tuple[float, float]:
        """The stated noise [px], [m]."""
        return self.pixel_noise_px, self.joint_noise_m
