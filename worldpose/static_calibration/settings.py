"""Settings of static calibration."""

from __future__ import annotations

from typing import Annotated, Literal

from pydantic import Field

from data_contracts.records import Record
from worldpose.static_calibration.line_settings import SURVEY_ERROR, LineRefinementSettings

_AddedSpread = Annotated[float, Field(ge=0, le=10)]


class CameraPrior(Record):
    """What is known of a stadium camera before anything is clicked.

    Every entry is the middle and the spread (one standard deviation) of a Gaussian; spreads of
    logarithms are read as factors. They are wide: they decide only what a view cannot tell.
    """

    focal: float = Field(default=1.6, ge=1e-6, le=1000)
    """Focal length in widths of the picture [1]: seats of WorldPose's static cameras 1.1, its
    broadcast cameras 1.25 to 3.7."""
    focal_spread: float = Field(default=0.6, ge=1e-6, le=100)
    """Of the focal length's logarithm [1]: a factor of 1.8 either way."""
    principal_point_spread: float = Field(default=0.004, ge=1e-6, le=1)
    """About the picture's middle, each axis, in widths [1]: 8 px of 1920, a lens and a sensor
    mounted with ordinary care."""
    k1: float = Field(default=0.0, ge=-10, le=10)
    """As `k1_spread`, its middle [1]: a lens that nobody named may bend either way."""
    k1_spread: float = Field(default=0.025, ge=1e-6, le=10)
    """What k1 moves a pixel in the picture's corner by, in its distance from the middle [1]:
    2.5 % is a visibly bent touch line."""
    k2_spread: float = Field(default=0.0015, ge=1e-6, le=1)
    """As `k1_spread`, of k2 [1]: a pixel or two in the corner. Wider, it bends what lies beyond
    the clicks: on drawn broadcast lines 0.005 predicts worse than 0.0015."""
    k3_spread: float = Field(default=0.005, ge=1e-6, le=1)
    """As `k1_spread`, of k3 where it is solved for [1]."""
    lens_spread: tuple[_AddedSpread, _AddedSpread, _AddedSpread] = (0.1, 0.02, 0.01)
    """Of k1, k2, k3 themselves [1], added in squares to what the corner's displacement allows: wide
    lenses bend their corners more (C5); zero adds nothing."""
    height: float = Field(default=18.0, ge=1e-6, le=10000)
    """Above the pitch [m]: stands and roofs are 8 to 40 m up."""
    height_spread: float = Field(default=0.4, ge=1e-6, le=100)
    """Of the height's logarithm [1]."""
    distance: float = Field(default=75.0, ge=1e-6, le=10000)
    """In plan from the centre spot [m]: the stands are 40 to 120 m away."""
    distance_spread: float = Field(default=0.35, ge=1e-6, le=100)
    """Of the distance's logarithm [1]."""
    roll_spread: float = Field(default=0.03, ge=1e-6, le=10)
    """Of the picture's horizon [rad]: 1.7 degrees, a level tripod or bracket."""


class StaticCalibrationSettings(Record):
    """How well clicks are placed, what a plausible camera is, and what counts as good enough."""

    prior: CameraPrior = CameraPrior()
    """What the view cannot tell."""
    click_noise: float = Field(default=1.0, ge=1e-6, le=100)
    """Standard deviation of a clicked point, each axis [px]: a careful click in a zoomed view
    (C7)."""
    survey_error: float = Field(default=SURVEY_ERROR, ge=0, le=1)
    """Standard deviation of the template's points from the painted ones, each axis [m], in clicks
    and in painted lines: a total station knows millimetres, and what is the middle of painted
    corners that wander by a twentieth of their width does not."""
    drawn_noise: float = Field(default=1.5, ge=1e-6, le=1000)
    """Standard deviation of a point drawn along a marking, across it [px]: hand annotations of
    SoccerNet lie 1.2 px (median 0.8) off the best camera."""
    drawn_reach: float = Field(default=8.0, ge=0, le=1000)
    """Stretch of a drawn marking, either way, along which a hand errs alike [px]: pixels nearer to
    each other than this share the weight of one."""
    drawn_loss: float = Field(default=6.0, ge=1e-6, le=1000)
    """Cauchy scale of drawn points, in their standard deviations [1]: nearly least squares for
    honest ones, and a marking under a wrong name cannot drag the camera along."""
    sample_spacing: float = Field(default=0.5, ge=1e-6, le=100)
    """Between samples of the markings [m]: chords of the circle are then 3 mm off it."""
    wrong_click: float = Field(default=4.2, ge=1e-6, le=1000)
    """A click is wrong when leaving it out moves its own residual by more than this many standard
    deviations [1]: 0.015 % of honest clicks (chi-square, two degrees of freedom)."""
    wrong_rate: float = Field(default=0.03, gt=0, lt=0.5)
    """Share of clicks that have a wrong name or a slip of the hand [1]: it decides whether clicks
    that are far off are wrong, or honest ones of a larger noise than stated."""
    wrong_marking: float = Field(default=8.0, ge=1e-6, le=1000)
    """A drawn marking is wrong when half of it is farther off than this many standard deviations
    [1]: 12 px, no slip of the hand but another marking's name."""
    max_wrong_share: float = Field(default=0.4, gt=0, lt=0.5)
    """Largest share of clicks, and of markings, that may be wrong [1]; more, and no
    majority is left to trust."""
    distortion: Literal["none", "k1", "k1_k2", "k1_k2_k3"] = "k1_k2"
    """Radial coefficients to solve for (C5)."""
    k3_gain: float = Field(default=0.1, ge=1e-6, le=10)
    """Share of the held-out error that k3 must take away to be kept [1]."""
    search_cameras: int = Field(default=24, ge=1, le=10000)
    """Best starts of the search over plausible cameras that are followed to their minimum [1]."""
    weak_median: float = Field(default=0.15, ge=1e-6, le=100)
    """A camera is weak where the median over the seen pitch of its expected ground error is above
    this [m]: a player's foot is no longer where the field needs it."""
    weak_p95: float = Field(default=0.6, ge=1e-6, le=100)
    """As `weak_median`, for the worst twentieth of the seen pitch [m]: half a stride."""
    map_step: float = Field(default=2.0, ge=1e-6, le=1000)
    """Between the places of the expected ground error's map [m]."""
    lines: bool = True
    """Refine on the painted lines where there is a picture (C4)."""
    line_refinement: LineRefinementSettings = LineRefinementSettings()
    """How the painted lines are looked for."""
