"""Settings of bundle adjustment."""

from __future__ import annotations

from typing import Final, Literal

from pydantic import Field

from data_contracts.records import Frame, Record
from worldpose.static_calibration.settings import SURVEY_ERROR

CHANCE: Final = 2.0
"""Standard errors by which a loss falls or rises by chance [1]: where many people judge, one in
forty falls by more."""


class SolverSettings(Record):
    """Stopping rule and initial damping of the solver."""

    max_iterations: int = Field(default=50, ge=1, le=10000)
    """Maximum steps [1]; a dozen are usual."""
    min_cost_change: float = Field(default=1e-8, ge=1e-12, le=1)
    """Relative gain below which a step is the last [1]: two orders below the gain that moves a
    joint by a tenth of a millimetre."""
    damping: float = Field(default=1e-4, ge=1e-12, le=1e6)
    """Initial Marquardt damping [1]: initial errors are a few pixels, where plain steps work."""


class GivenCameraPrior(Record):
    """Prior of a camera that a file gives without a covariance, and when it may change.

    Standard deviations before adjustment; the residuals between views then scale all of them
    together. Lens coefficients and principal point are fixed.
    """

    rotation_rad: float = Field(default=0.0005, ge=1e-12, le=0.1)
    """About each axis [rad]: a pixel at a focal length of 2000 px."""
    center: float = Field(default=0.0025, ge=1e-6, le=1)
    """Along each axis, relative to the distance between camera and people [1]: 1 cm in a room,
    0.15 m in a stadium."""
    focal: float = Field(default=0.002, ge=1e-6, le=1)
    """Relative [1]: five zoom steps of a survey's rounding, 2 px at the image border."""
    min_gain: float = Field(default=0.4, ge=0, le=100)
    """Relative decrease of the held-out loss that given cameras need, times the number of cameras
    less one [1]: 0.13 with four cameras, 0.03 with sixteen. Detector errors differ between views,
    and few cameras fit them as well as camera errors."""


class BundleAdjustmentSettings(Record):
    """Selection and weights of people in the adjustment, and conditions of acceptance."""

    method: Literal["worldpose", "paper"] = "worldpose"
    """Method; `paper` is the paper's, without robust loss, prior or held-out validation (needs the
    extra `body`)."""
    evidence: Literal["markings_and_players", "markings"] = "markings_and_players"
    """Observations in the adjustment. `markings` alone, with every parameter of the lens free and
    no prior, is the case that the paper warns of; it exists for measurements."""
    max_frames: int = Field(default=40, ge=1, le=10000)
    """Maximum frames in the adjustment [frame]; more add seconds and little information."""
    min_frame_gap_s: float = Field(default=0.1, ge=0, le=10)
    """Minimum time between two of them [s]: detector errors last about 0.3 s."""
    chosen_frames: tuple[Frame, ...] = ()
    """Match frames that a user chose instead [frame]; a clip ignores those outside it."""
    min_views: int = Field(default=3, ge=2, le=1000)
    """Minimum inlier cameras of a joint in the adjustment [1]: two views hardly contradict each
    other."""
    loss_scale: float = Field(default=3.0, ge=1e-6, le=1000)
    """Standard deviations of an observation beyond which it counts less (Cauchy's loss) [1]:
    inliers lose a few per cent of efficiency."""
    folds: int = Field(default=4, ge=2, le=1000)
    """Groups of people; each is held out once to validate cameras adjusted without it [1]."""
    min_judges: int = Field(default=100, ge=1, le=10000)
    """Minimum held-out keypoints in a camera to accept its change [1]: six people once."""
    given: GivenCameraPrior = GivenCameraPrior()
    """Prior of cameras that a file gives."""
    clicks_uncertainty: float = Field(default=1.0, ge=1e-6, le=100)
    """Factor on the standard deviations that calibration from clicks states [1]."""
    lines_uncertainty: float = Field(default=1.0, ge=1e-6, le=100)
    """Factor on the standard deviations that calibration on painted lines states [1]."""
    min_significance: float = Field(default=3.0, ge=0, le=1000)
    """Standard errors by which the held-out loss must fall for given cameras, and for rigs of up to
    four cameras, to change at all [1]."""
    survey_error_m: float = Field(default=SURVEY_ERROR, ge=0, le=1)
    """Error of the surveyed ends of painted lines, standard deviation along each axis [m]; all
    cameras share it."""
    click_noise_px: float = Field(default=1.0, ge=1e-6, le=100)
    """Standard deviation of a clicked point, each axis [px]: a careful click in a zoomed view."""
    wrong_click: float = Field(default=4.2, ge=1e-6, le=1000)
    """Mahalanobis distance from which a click is proposed for removal [1]: 0.015 % of correct ones
    (chi-square, two degrees of freedom)."""
    wrong_keypoint: float = Field(default=4.2, ge=1e-6, le=1000)
    """Mahalanobis distance from which a keypoint is on the review list [1]."""
    max_review_items: int = Field(default=1000, ge=0, le=100_000)
    """Maximum length of the review list of keypoints and people [1]; the worst come first."""
    solver: SolverSettings = SolverSettings(min_cost_change=1e-5)
    """Stopping rule of the solver: with a robust loss the last steps are small and many, and two
    more digits of the cost move the cameras' ground by less than 0.1 mm."""
