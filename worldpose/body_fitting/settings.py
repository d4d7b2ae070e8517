"""Settings of body fitting."""

from __future__ import annotations

from pydantic import Field

from data_contracts.records import Record
from worldpose.body.body_file import OPEN_BODY


class BodyFittingSettings(Record):
    """What is expected of detectors, of bodies and of motion.

    Every weight of the objective is one over the square of a spread that has a unit. The values
    were chosen on simulated seeds 101 to 104, not on those that figures are taken from.
    """

    body_model: str = OPEN_BODY
    """Whose shape and joints are fitted: the open body, or one that was brought with
    `worldpose body install`."""
    noise_scale: float = Field(default=1.3, ge=1e-6, le=1000)
    """Standard deviation of the joints over what triangulation states [1]: it knows the noise of
    a detector, not what a hidden joint or a wrong view adds."""
    noise_time: float = Field(default=0.1, ge=0, le=10)
    """Time in which a detector's error stays what it is [s]: so long its frames are one witness,
    else a slow error would pass for motion."""
    joint_floor: float = Field(default=0.008, ge=0, le=1)
    """Least standard deviation of a joint [m]: calibration, and what the body model cannot do."""
    sight_spread: float = Field(default=0.06, ge=1e-6, le=10)
    """Distance of a joint that one camera alone sees from its line of sight, per axis, for a joint
    of average difficulty [m]: 2 % of a person's height, and half again since no other view tells
    what is wrong, or lasts longer than `noise_time`."""
    tail: float = Field(default=2.5, ge=1e-6, le=1000)
    """Deviation at which a joint has half its weight (Cauchy's loss) [standard deviations]."""
    bias_spread: float = Field(default=0.02, ge=1e-6, le=10)
    """Expected offset of what a detector takes for a joint from the body's joint, along each axis
    of the body [m]; the same for everybody and mirrored left to right. Both the offsets and, from
    the middle of the steps on, this spread are estimated."""
    bias_time: float = Field(default=40.0, ge=1e-6, le=10000)
    """So many seconds of all people together make offsets as sure as they get [s]. 22 people for
    10 s whose detector has none are 15 mm off without that limit, 10 mm with it, as for 2 s."""
    own_bias: float = Field(default=0.006, ge=0, le=1)
    """Further offset per axis of the body that each person has on his own [m]: clothes and build.
    It is in the covariance only, for nothing tells it from the pose."""
    shape_rate: float = Field(default=12.5, ge=1e-6, le=10000)
    """Frames a second that shape and offsets are estimated from [1/s]: more add no witnesses."""
    shape_acceleration: float = Field(default=50.0, ge=1e-6, le=10000)
    """Standard deviation of the hips' acceleration per axis while shape is estimated [m/s^2].
    Smoothing shortens swings, and shape would follow: with 6 the limbs come out 2 cm short."""
    shape_weight: float = Field(default=1.0, ge=1e-6, le=100)
    """Weight of the betas' normal distribution [1]: 1 takes people to be as varied as the body
    model's components say."""
    acceleration: float = Field(default=20.0, ge=1e-6, le=10000)
    """Standard deviation of the hips' acceleration per axis [m/s^2]; other joints have multiples
    of it (`objective.LIVELINESS`). Players have 2 to 4 on average;
    smoothing to that cuts swings short (G-MPJPE of a match 26 mm at 8, 23 mm at 12)."""
    acceleration_tail: float = Field(default=6.0, ge=1e-6, le=1000)
    """Deviation at which an acceleration has half its weight [standard deviations]: kicks. Jerk
    where views change is 1.2 times the truth's at 3, 0.9 at 8."""
    pose_weight: float = Field(default=0.03, ge=1e-6, le=10)
    """Weight of the pose prior in each frame [1]: neighbouring frames are one pose, not many.
    PA-MPJPE of penalty boxes is 25 mm at 0.01, 24 at 0.03 and 22 at 0.1; but simulated people are
    closer to a prior made from their like than others will be."""
    shape_pose_weight: float = Field(default=0.003, ge=1e-6, le=1)
    """The same while shape is estimated [1]: it unbends limbs, and longer bones with offsets that
    take it back would follow, the farther the longer a clip. With 20 mm of noise and no ground
    three people of 30 s come out 5 mm too tall at most, and 21 mm at 0.03."""
    shape_time: float = Field(default=10.0, ge=1e-6, le=1000)
    """So many seconds of a person are looked at for his shape [s], evenly spread: what a detector
    gets wrong of him by view and pose does not average out over more."""
    limit_spread: float = Field(default=0.1, ge=1e-6, le=10)
    """How far angles go beyond the joint limits [rad]."""
    contact_height: float = Field(default=0.04, ge=1e-6, le=10)
    """An ankle less than this above that of a flat foot may stand [m]."""
    contact_speed: float = Field(default=0.5, ge=1e-6, le=100)
    """An ankle slower than this may stand [m/s]."""
    contact_spread: float = Field(default=0.01, ge=1e-6, le=1)
    """How far a standing ankle is from the height of a flat foot's [m]."""
    slip_spread: float = Field(default=0.001, ge=1e-6, le=0.1)
    """How far a standing ankle moves in a frame [m]."""
    shape_steps: int = Field(default=7, ge=1, le=1000)
    """Gauss-Newton steps for shape, offsets and coarse poses together [1]."""
    steps: int = Field(default=4, ge=1, le=1000)
    """Gauss-Newton steps for the poses of every frame [1]; feet stand from the third on."""
    longest_gap: float = Field(default=1.0, ge=0, le=100)
    """Gaps up to this are filled by motion [s]; in longer ones a person is missing."""
