"""Settings of bundle adjustment."""

from __future__ import annotations

from typing import Literal

from pydantic import Field

from data_contracts.records import Frame, Record
from worldpose.bundle_adjustment.solving import SolverSettings
from worldpose.static_calibration.line_settings import SURVEY_ERROR


class GivenCameraPrior(Record):
    """Uncertainty of a camera that a file gives without a covariance, and what may change it.

    Standard deviations before people are looked at: how much the views disagree then scales all of
    them together. Lens coefficients and principal point are taken as they are.
    """

    rotation: float = Field(default=0.0005, ge=1e-12, le=0.1)
    """About each axis [rad]: a pixel at a focal length of 2000 px."""
    center: float = Field(default=0.0025, ge=1e-6, le=1)
    """Along each axis, relative to the distance between camera and people [1]: 1 cm in a room,
    0.15 m in a stadium."""
    focal: float = Field(default=0.002, ge=1e-6, le=1)
    """Relative [1]: five zoom steps of a survey's rounding, 2 px at the picture's border."""
    min_gain: float = Field(default=0.4, ge=0, le=100)
    """Part by which the loss of left-out people in given cameras must fall, times the number of
    cameras less one [1]: 0.13 with four cameras, 0.03 with sixteen. A detector errs differently in
    every view, and few cameras fit that as well as an error of a camera."""


class BundleAdjustmentSettings(Record):
    """Which people are adjusted to, how much they count, and what is accepted."""

    evidence: Literal["markings_and_players", "markings"] = "markings_and_players"
    """What cameras are adjusted to. `markings` alone, with every parameter of the lens free and
    nothing known beforehand, is the paper's warning (trap 1): it is there to be measured."""
    candidates: int = Field(default=3000, ge=1, le=1_000_000)
    """Most frames of all clips that are looked at [1], evenly spread: a minute at 50 a second, and
    0.3 GB of detections from 16 cameras."""
    frames: int = Field(default=40, ge=1, le=10000)
    """Most frames that people are taken from [1]; more add seconds and little knowledge."""
    frame_gap: float = Field(default=0.1, ge=0, le=10)
    """Least time between two of them [s]: errors of a detector last about 0.3 s."""
    chosen_frames: tuple[Frame, ...] = ()
    """Match frames that a person chose instead; those outside a clip are left out of it."""
    min_views: int = Field(default=3, ge=2, le=1000)
    """Least agreeing cameras of a joint that cameras are adjusted to [1]: two views hardly
    contradict each other."""
    robust_scale: float = Field(default=3.0, ge=1e-6, le=1000)
    """Standard deviations of an observation beyond which it counts less (Cauchy's loss) [1]: a few
    per cent of efficiency for honest ones."""
    folds: int = Field(default=4, ge=2, le=1000)
    """Groups of people, each of which is left out once to judge cameras adjusted without them
    [1]."""
    min_judges: int = Field(default=100, ge=1, le=10000)
    """Least left-out keypoints in a camera that can accept its change [1]: six people once."""
    given: GivenCameraPrior = GivenCameraPrior()
    """Of cameras that a file gives."""
    clicks_uncertainty: float = Field(default=1.0, ge=1e-6, le=100)
    """Factor on the standard deviations that calibration from clicks states [1]."""
    lines_uncertainty: float = Field(default=1.0, ge=1e-6, le=100)
    """Factor on the standard deviations that calibration on painted lines states [1]."""
    min_significance: float = Field(default=3.0, ge=0, le=1000)
    """Standard errors by which the loss of left-out people must fall for given cameras, and for
    rigs of up to four cameras, to change at all [1]."""
    survey_error: float = Field(default=SURVEY_ERROR, ge=0, le=1)
    """How far the ends of painted lines are from the surveyed ones, standard deviation along each
    axis [m]: all cameras share it."""
    click_noise: float = Field(default=1.0, ge=1e-6, le=100)
    """Standard deviation of a clicked point, each axis [px]: a careful click in a zoomed view."""
    wrong_click: float = Field(default=4.2, ge=1e-6, le=1000)
    """Standard deviations from which a click is proposed for removal [1]: 0.015 % of honest ones
    (chi-square, two degrees of freedom)."""
    wrong_keypoint: float = Field(default=4.2, ge=1e-6, le=1000)
    """Standard deviations from which a keypoint is on the review list [1]."""
    review: int = Field(default=1000, ge=0, le=100_000)
    """Longest review list of keypoints and people [1]; the worst come first."""
    solver: SolverSettings = SolverSettings(cost_change=1e-5)
    """When the solver stops: with a robust loss the last steps are small and many, and two more
    digits of the cost move the cameras' ground by less than 0.1 mm."""
