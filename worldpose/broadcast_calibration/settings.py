"""Settings of broadcast calibration."""

from __future__ import annotations

import math
from typing import Annotated, Literal

from pydantic import Field

from data_contracts.pitch import Coordinate
from data_contracts.records import Positive, Record
from worldpose.static_calibration.settings import CameraPrior, StaticCalibrationSettings

_Offset = Annotated[float, Field(ge=-1, le=1)]
"""Offset in widths of the image [1]."""


class BroadcastPrior(Record):
    """Gaussian prior of a main camera: means and standard deviations.

    They come from 20 released clips of the 2022 World Cup (K, k, R, t of WorldPose), and are
    widened for lenses and stadiums of other broadcasters.
    """

    principal_point: tuple[_Offset, _Offset] = (0.0, -0.018)
    """Mean offset of the principal point from the image center, in image widths [1]; 2022: 0, and
    -35 px of 1920."""
    principal_point_std: tuple[Positive, Positive] = (0.01, 0.012)
    """Standard deviation of the principal point in image widths [1]; 2022: 19 and 23 px of 1920."""
    focal: float = Field(default=2.1, ge=1e-6, le=1000)
    """Focal length in image widths [1]; 2022: 1.25 to 3.7."""
    log_focal_std: float = Field(default=0.4, ge=1e-6, le=100)
    """Standard deviation of the focal length's logarithm [1]."""
    k1: float = Field(default=0.4, ge=-100, le=100)
    """Mean of k1 at a focal length of 2.19 widths [1]; it grows with the focal length to the power
    1.6."""
    k1_std: float = Field(default=0.25, ge=1e-6, le=100)
    """Standard deviation of k1, with the same growth [1]; 2022: 0.08. It is wide enough for a lens
    without distortion."""
    k2: float = Field(default=1.5, ge=-100, le=100)
    """Mean of k2 at a focal length of 2.19 widths [1]; it grows with the focal length."""
    k2_std: float = Field(default=0.8, ge=1e-6, le=100)
    """Standard deviation of k2, with the same growth [1]; 2022: 0.5 to 0.8."""
    k3_std: float = Field(default=0.5, ge=1e-6, le=100)
    """Standard deviation of k3 about zero, with the growth of k2 [1]: the released cameras have no
    k3."""
    given_rotation_std_deg: float = Field(default=0.3, ge=1e-6, le=180)
    """Standard deviation of a camera's angles in camera data, about each axis [deg]: of heads that
    were aligned by eye. Data that key frames contradict by three deviations are no prior."""
    given_log_focal_std: float = Field(default=0.03, ge=1e-6, le=100)
    """Standard deviation of the logarithm of a focal length in camera data [1]."""
    given_center_std_m: float = Field(default=1.0, ge=1e-6, le=1000)
    """Standard deviation of a camera's place in camera data, each axis [m]."""
    center_m: tuple[Coordinate, Coordinate, Annotated[float, Field(ge=0.1, le=300)]] = (0, -75, 17)
    """Mean center in the world [m], above the pitch: on the main stand, at the halfway line."""
    center_std_m: tuple[Positive, Positive, Positive] = (15.0, 20.0, 8.0)
    """Standard deviation of the center [m]; 2022: 0.1, 6 and 2 m, of cameras at the halfway line in
    large stadiums."""


class BroadcastCalibrationSettings(Record):
    """Weights, noise and gates of the moving camera."""

    prior: BroadcastPrior = BroadcastPrior()
    """Gaussian prior of the camera."""
    click_noise_px: float = Field(default=1.0, ge=1e-6, le=100)
    """Standard deviation of a clicked point, each axis [px]."""
    survey_error_m: float = Field(default=0.006, ge=0, le=1)
    """Standard deviation of a surveyed point of the template from the painted one, each axis
    [m]."""
    paint_error_m: float = Field(default=0.03, ge=1e-6, le=1)
    """Standard deviation of a point that has its place from the rules of the game [m], in plan and
    height. The clip's own markings may lower it, not raise it."""
    crown_std_m: float = Field(default=0.1, ge=0, le=1)
    """Standard deviation of an unmeasured crown from the standard 0.2 m [m]: prior. The pitches of
    two real cameras have about 0.1 m; 0 = as given."""
    end_fall_std_m: float = Field(default=0.1, ge=0, le=1)
    """Standard deviation of an unmeasured fall from the halfway line to the goal lines from 0 [m]:
    prior; 0 = as given. A clip of one half hardly tells it, unlike static cameras on both sides,
    and its camera then serves on level pitches, too."""
    pitch_size_std_m: float = Field(default=0.1, ge=0, le=10)
    """Standard deviation of an unmeasured length or width from 105 and 68 m [m]: prior. Top
    competitions prescribe this size; 0 = as given. A pitch of another size needs pitch.json."""
    field_weight: float = Field(default=1.0, ge=1e-6, le=100)
    """Factor on the loss of markings (the paper's 1)."""
    player_weight: float = Field(default=0.5, ge=0, le=100)
    """Factor on the loss of players' keypoints (the paper's 0.5): with residuals in standard
    deviations, two keypoints of a person are worth one; a detector's errors are correlated."""
    loss_scale: float = Field(default=3.0, ge=1e-6, le=1000)
    """Scale of the Geman-McClure losses [standard deviations]; the paper gives none."""
    line_noise_px: float = Field(default=0.3, ge=1e-6, le=100)
    """Minimum standard deviation of a painted line's sample across it [px]: survey error and paint
    edges, which the image noise does not include."""
    line_shift_px: float = Field(default=0.05, ge=0, le=10)
    """Common shift of all painted lines in the image, each axis, standard deviation [px], from
    sharpening or a lens beyond k1 to k3: it enters the covariance, since no residual shows it."""
    player_shift: float = Field(default=0.05, ge=0, le=10)
    """Common shift of all keypoints in all frames, each axis, standard deviation [standard
    deviations of a keypoint], such as from another joint definition: it enters the covariance;
    0.05 is 3 mm in the world."""
    line_samples: int = Field(default=240, ge=20, le=100_000)
    """Approximate maximum number of line samples per frame [1]."""
    line_search_px: float = Field(default=12.0, ge=1e-6, le=10000)
    """Maximum distance of lines from their projection in the search [px]."""
    flow_points: int = Field(default=400, ge=30, le=100_000)
    """Approximate number of points followed from frame to frame [1]."""
    flow_noise_px: float = Field(default=0.1, ge=1e-6, le=10)
    """Minimum standard deviation of a followed point's motion [px]; a larger value measured in the
    clip replaces it."""
    flow_outlier: float = Field(default=3.5, ge=1e-6, le=1000)
    """Maximum modified z-score of a followed point (threshold of Iglewicz and Hoaglin)."""
    flow_weight: float = Field(default=1.0, ge=0, le=100)
    """Factor on the loss of followed points; 0 = without."""
    flow_drift_px: float = Field(default=0.15, ge=1e-6, le=100)
    """Drift of tracking after one frame, growing with the square root of the frames [px]; the drift
    measured between two or more key frames replaces it."""
    smooth: bool = True
    """Smooth focal length and distortion as much as the clip's own tracking supports."""
    feed_offset: Literal["report", "correct"] = "report"
    """Handling of the feed's clock offset from the static cameras: report it, or shift people in
    time by it if it is determined."""
    passes: int = Field(default=2, ge=1, le=1000)
    """Iterations of player matching and line search [1]."""
    max_iterations: int = Field(default=30, ge=1, le=10000)
    """Maximum solver iterations in each of these passes [1]."""
    method: Literal["worldpose", "paper"] = "worldpose"
    """Method of the last fit; `paper` minimizes E_field and E_player alone by Adam, from the
    tracked camera (needs the extra `body`)."""
    adam_iterations: int = Field(default=2000, ge=1, le=1_000_000)
    """Iterations of Adam, if `method` is `paper` [1]."""
    cut_share: float = Field(default=0.25, gt=0, lt=1)
    """Minimum share of followed points consistent with a rotating and zooming camera between two
    frames of one shot [1]."""
    weak_error_px: float = Field(default=3.0, ge=1e-6, le=1000)
    """A clip is weak if more than a twentieth of its frames have a larger expected image error of
    places on the pitch [px]."""

    @property
    def key_frame(self) -> StaticCalibrationSettings:
        """Settings for the calibration of a single key frame."""
        prior = self.prior
        # In units of the static prior: displacement of the image corner by k1 and k2, relative to
        # its distance from the center, at a focal length of 2.19 widths.
        corner = (0.574 / 2.19) ** 2
        camera = CameraPrior(
            focal=prior.focal,
            log_focal_std=prior.log_focal_std,
            principal_point_std=0.02,
            k1=prior.k1 * corner,
            k1_std=1.5 * prior.k1_std * corner,
            k2_std=2.0 * prior.k2 * corner**2,
            height_m=prior.center_m[2],
            log_height_std=0.35,
            # Nearer to the centre spot than its own deviation, a mean tells no distance.
            distance_m=max(math.hypot(*prior.center_m[:2]), *prior.center_std_m[:2]),
            log_distance_std=0.25,
        )
        return StaticCalibrationSettings(
            prior=camera,
            click_noise_px=self.click_noise_px,
            survey_error_m=self.survey_error_m,
            lens_model="brown",  # that of the clip
        )
