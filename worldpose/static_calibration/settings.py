"""Settings of static calibration, and of its refinement on painted lines."""

from __future__ import annotations

from typing import Annotated, Final, Literal

from pydantic import Field

from data_contracts.pitch import PitchSpec
from data_contracts.records import Record

SURVEY_ERROR: Final = 0.006
"""Default standard deviation of surveyed points from the painted ones, each axis [m]."""


class LineRefinementSettings(Record):
    """Sampling, search widths and acceptance thresholds of the refinement."""

    line_width_m: float = Field(default=0.12, ge=1e-6, le=100)
    """Width of the paint [m]: the maximum of Law 1, which most pitches have."""
    line_shift_px: float = Field(default=0.05, ge=0, le=10)
    """Standard deviation of errors that shift a whole marking in the image [px], such as sharpening
    or lens distortion beyond k1 and k2."""
    samples: int = Field(default=2000, ge=100, le=1_000_000)
    """Approximate maximum number of samples in the image [1]."""
    spacing_px: float = Field(default=4.0, ge=1e-6, le=1000)
    """Spacing of neighbouring samples in the image [px]."""
    search_px: float = Field(default=40.0, ge=1e-6, le=10000)
    """Maximum search width of a sample [px], three standard deviations of its projection; others
    wait for a more accurate camera."""
    contrast: float = Field(default=6.0, ge=1e-6, le=1000)
    """Minimum brightness of paint above the grass on either side [levels of 255]."""
    loss_scale: float = Field(default=3.0, ge=1e-6, le=1000)
    """Final scale of the robust loss [standard deviations]."""
    min_found: int = Field(default=30, ge=1, le=10000)
    """Minimum number of detected samples [1]."""
    min_inlier_share: float = Field(default=0.4, ge=0, le=1)
    """Minimum share of inliers among the samples in the image, and of each marking [1]: people
    occlude some samples, and paint is worn. A wrong camera may match a third, on wrong markings."""
    contradiction: float = Field(default=1e-6, gt=0, lt=1)
    """Minimum probability of a fit under the prior of the start [1]; below, it is rejected."""


_AddedSpread = Annotated[float, Field(ge=0, le=10)]


class CameraPrior(Record):
    """Gaussian prior of a stadium camera.

    Every entry has a mean and a standard deviation; standard deviations of logarithms are
    factors. They are wide: they decide only directions that a view does not observe.
    """

    focal: float = Field(default=1.6, ge=1e-6, le=1000)
    """Focal length in image widths [1]: WorldPose's static cameras have 1.1, its broadcast cameras
    1.25 to 3.7."""
    log_focal_std: float = Field(default=0.6, ge=1e-6, le=100)
    """Standard deviation of the focal length's logarithm [1]: a factor of 1.8 either way."""
    principal_point_std: float = Field(default=0.004, ge=1e-6, le=1)
    """Standard deviation of the principal point about the image center, each axis, in widths [1]: 8
    px of 1920, a lens and a sensor mounted with ordinary care."""
    k1: float = Field(default=0.0, ge=-10, le=10)
    """Mean displacement of the image corner by k1, in the unit of `k1_std` [1]: an unknown lens may
    bend either way."""
    k1_std: float = Field(default=0.025, ge=1e-6, le=10)
    """Standard deviation of the displacement of the image corner by k1, relative to the corner's
    distance from the center [1]: 2.5 % is a visibly bent touch line."""
    k2_std: float = Field(default=0.0015, ge=1e-6, le=1)
    """The same for k2 [1]: a pixel or two in the corner. A larger spread bends the image beyond the
    clicks: on drawn broadcast lines 0.005 predicts worse than 0.0015."""
    k3_std: float = Field(default=0.005, ge=1e-6, le=1)
    """The same for k3 if it is free [1]."""
    lens_std: tuple[_AddedSpread, _AddedSpread, _AddedSpread] = (0.1, 0.02, 0.01)
    """Standard deviations of the coefficients k1, k2, k3 [1], added in squares to the spread from
    the corner's displacement: wide lenses bend their corners more; zero adds nothing."""
    height_m: float = Field(default=18.0, ge=1e-6, le=10000)
    """Height above the pitch [m]: stands and roofs are 8 to 40 m up."""
    log_height_std: float = Field(default=0.4, ge=1e-6, le=100)
    """Standard deviation of the height's logarithm [1]."""
    distance_m: float = Field(default=75.0, ge=1e-6, le=10000)
    """Distance in plan from the centre spot [m]: the stands are 40 to 120 m away. Within two
    standard deviations of it the prior pulls outwards, not from nearer."""
    log_distance_std: float = Field(default=0.35, ge=1e-6, le=100)
    """Standard deviation of the distance's logarithm [1]."""
    roll_std_rad: float = Field(default=0.03, ge=1e-6, le=10)
    """Standard deviation of the roll of the image horizon [rad]: 1.7 degrees, a level tripod or
    bracket."""

    def beside(self, pitch: PitchSpec) -> CameraPrior:
        """Return the prior of a camera beside another game's pitch: nearer and lower in proportion.

        The default means are of football; halls are smaller. Other means stay as they are given.
        """
        football, own = (PitchSpec(template=name).length for name in ("football", pitch.template))
        share = own / football
        usual = CameraPrior()
        means = {"height_m": usual.height_m, "distance_m": usual.distance_m}
        places = {name: share * mean for name, mean in means.items() if getattr(self, name) == mean}
        return self if share == 1.0 else self.model_copy(update=places)


class ProposalSettings(Record):
    """Prior of cameras without clicks, and the people who decide their sides."""

    prior: CameraPrior = CameraPrior()
    """Gaussian prior of the camera."""
    people_frames: int = Field(default=12, ge=1, le=1000)
    """Number of frames, evenly spaced, in which the bundled detector finds people if a camera has
    no stated side [frame]: one or two seconds of one core each."""


class StaticCalibrationSettings(Record):
    """Click noise, camera prior, and thresholds of outliers and accuracy."""

    method: Literal["worldpose", "paper"] = "worldpose"
    """Method; `paper` replaces the camera by that of the paper's three stages, from clicks that are
    inliers (needs the extra `body`)."""
    prior: CameraPrior = CameraPrior()
    """Gaussian prior of the camera."""
    click_noise_px: float = Field(default=1.0, ge=1e-6, le=100)
    """Standard deviation of a clicked point, each axis [px]: a careful click in a zoomed view
   ."""
    survey_error_m: float = Field(default=SURVEY_ERROR, ge=0, le=1)
    """Standard deviation of the template's points from the painted ones, each axis [m], in clicks
    and in painted lines: a total station measures to millimetres, but paint varies by a twentieth
    of its width."""
    drawn_noise_px: float = Field(default=1.5, ge=1e-6, le=1000)
    """Standard deviation of a point drawn along a marking, across it [px]: hand annotations of
    SoccerNet have residuals of 1.2 px (median 0.8)."""
    drawn_correlation_px: float = Field(default=8.0, ge=0, le=1000)
    """Correlation length of drawing errors along a marking, either way [px]: pixels closer together
    than this share the weight of one."""
    drawn_loss_scale: float = Field(default=6.0, ge=1e-6, le=1000)
    """Cauchy scale of drawn points, in their standard deviations [1]: nearly least squares for
    inliers, with bounded influence of a marking under a wrong name."""
    sample_spacing_m: float = Field(default=0.5, ge=1e-6, le=100)
    """Spacing of marking samples [m]: chords then deviate from the circle by 3 mm."""
    wrong_click: float = Field(default=4.2, ge=1e-6, le=1000)
    """Leave-one-out residual above which a click is an outlier, in standard deviations [1]: 0.015 %
    of inliers (chi-square, two degrees of freedom)."""
    wrong_rate: float = Field(default=0.03, gt=0, lt=0.5)
    """Prior probability of a wrong name or a slip of the hand [1]: it decides whether clicks with
    large residuals are outliers, or the noise is larger than stated."""
    wrong_marking: float = Field(default=8.0, ge=1e-6, le=1000)
    """Median residual above which a drawn marking is an outlier, in standard deviations [1]: 12 px,
    no slip of the hand but another marking's name."""
    max_wrong_share: float = Field(default=0.4, gt=0, lt=0.5)
    """Maximum share of outliers among clicks, and among markings [1]; with more, the inliers are no
    reliable majority."""
    distortion: Literal["none", "k1", "k1_k2", "k1_k2_k3"] = "k1_k2"
    """Free radial coefficients."""
    lens_model: Literal["any", "brown"] = "any"
    """Models of an unknown lens: Brown's and fisheyes, or Brown's alone."""
    k3_gain: float = Field(default=0.1, ge=1e-6, le=10)
    """Minimum relative reduction of the held-out error to keep k3 [1]."""
    search_cameras: int = Field(default=24, ge=1, le=10000)
    """Number of best plausible cameras to refine [1]."""
    weak_median_m: float = Field(default=0.15, ge=1e-6, le=100)
    """Median expected ground error over the visible pitch above which a camera is weak [m]: a
    player's foot is then too inaccurate."""
    weak_p95_m: float = Field(default=0.6, ge=1e-6, le=100)
    """Limit as `weak_median_m`, for the 95th percentile over the visible pitch [m]: half a
    stride."""
    map_step_m: float = Field(default=2.0, ge=1e-6, le=1000)
    """Grid spacing of the expected ground error's map [m]."""
    lines: bool = True
    """Refine on the painted lines if there is an image."""
    line_refinement: LineRefinementSettings = LineRefinementSettings()
    """Settings of the refinement on painted lines."""
