"""Settings of body fitting."""

from __future__ import annotations

from typing import Literal

from pydantic import Field

from data_contracts.records import Record
from worldpose.body.body_file import OPEN_BODY


class BodyFittingSettings(Record):
    """Expected errors of detectors, of bodies and of motion.

    Every weight of the objective is the inverse square of a spread with units. The values were
    chosen on simulated seeds 101 to 104, not on the seeds of reported results.
    """

    method: Literal["worldpose", "paper"] = "worldpose"
    """Method; `paper` fits 2D keypoints about the mid-hips without pose prior, offsets, ground or
    robust loss, and uses of these settings the body and the gaps (needs the extra `body`)."""
    body_model: str = OPEN_BODY
    """Body model to fit: the open body, open-neutral/3 with narrower hip joints, or one installed
    with `worldpose body install`."""
    noise_time_s: float = Field(default=0.1, ge=0, le=10)
    """Correlation time of a detector's error [s]: frames within it count as one observation,
    otherwise a slow error would pass for motion."""
    min_joint_std_m: float = Field(default=0.008, ge=0, le=1)
    """Minimum standard deviation of a joint [m]: calibration, and limits of the body model."""
    ray_std_m: float = Field(default=0.06, ge=1e-6, le=10)
    """Distance of a joint that one camera alone sees from its line of sight, per axis, for a joint
    of average difficulty [m]: 2 % of a person's height, and half again since no other view reveals
    errors, or those that last longer than `noise_time_s`."""
    loss_scale: float = Field(default=2.5, ge=1e-6, le=1000)
    """Deviation at which a joint has half its weight (Cauchy's loss) [standard deviations]."""
    bias_std_m: float = Field(default=0.006, ge=1e-6, le=10)
    """Expected offset from the body's joint to the detector's, along each axis of the body [m]; the
    same for all persons and mirrored left to right. Both the offsets and, from the middle of the
    steps on, this spread are estimated. Offsets also absorb what the body model cannot show, and
    then shape and pose are wrong. Real detectors' offsets are larger than 6 mm, but on real people
    and on people of other skeletons 20 mm makes bodies 4 mm worse: shanks become 3 cm too long."""
    bias_time_s: float = Field(default=40.0, ge=1e-6, le=10000)
    """Time of all people together after which offsets get no more certain [s]. 22 people for 10 s,
    seen by a detector without offsets, have errors of 15 mm without that limit, 10 mm with it, as
    for 2 s."""
    own_bias_std_m: float = Field(default=0.006, ge=0, le=1)
    """Additional individual offset of each person per axis of the body [m]: clothes and build. It
    is in the covariance only, since nothing separates it from the pose."""
    shape_rate_hz: float = Field(default=12.5, ge=1e-6, le=10000)
    """Frame rate to estimate shape and offsets from [Hz]: more frames add no independent
    observations."""
    shape_acceleration_m_s2: float = Field(default=50.0, ge=1e-6, le=10000)
    """Standard deviation of the hips' acceleration per axis while shape is estimated [m/s^2].
    Smoothing shortens swings, and shape would follow: with 6 the limbs come out 2 cm short."""
    shape_weight: float = Field(default=0.5, ge=1e-6, le=100)
    """Weight of the betas' normal distribution [1]: 1 assumes that people vary as the body model's
    components do; the proportions of real people vary more."""
    acceleration_m_s2: float = Field(default=20.0, ge=1e-6, le=10000)
    """Standard deviation of the hips' acceleration per axis [m/s^2]; other joints have multiples
    of it (`residuals.ACCELERATION_SCALE`). Players have 2 to 4 on average;
    smoothing to that cuts swings short (G-MPJPE of a match 26 mm at 8, 23 mm at 12)."""
    acceleration_loss_scale: float = Field(default=6.0, ge=1e-6, le=1000)
    """Deviation at which an acceleration has half its weight [standard deviations]: kicks. Jerk
    where views change is 1.2 times the truth's at 3, 0.9 at 8."""
    pose_time_s: float = Field(default=0.55, ge=1e-3, le=100)
    """Time for which a pose lasts [s]: the pose prior counts once per such time at any frame rate,
    since neighbouring frames are one pose, not many. Bodies of real people gain on Shelf
    (25 frames/s) down to 0.4, and lose in held-out cameras of Pose2Sim's demos (60) from 0.33."""
    shape_pose_weight: float = Field(default=0.003, ge=1e-6, le=1)
    """Weight of the pose prior in each frame while shape is estimated [1]: it unbends limbs, and
    longer bones with compensating offsets would follow, increasing with clip length. With 20 mm of
    noise and no ground three people of 30 s come out 5 mm too tall at most, and 21 mm at 0.03."""
    shape_time_s: float = Field(default=10.0, ge=1e-6, le=1000)
    """Time of each person to estimate shape from [s], evenly spread: detector errors by view and
    pose do not average out over more."""
    limit_std_rad: float = Field(default=0.1, ge=1e-6, le=10)
    """Standard deviation of angles beyond the joint limits [rad]."""
    contact_height_m: float = Field(default=0.04, ge=1e-6, le=10)
    """An ankle less than this above that of a flat foot may stand [m]."""
    contact_speed_m_s: float = Field(default=0.5, ge=1e-6, le=100)
    """An ankle slower than this may stand [m/s]."""
    contact_std_m: float = Field(default=0.01, ge=1e-6, le=1)
    """Standard deviation of a standing ankle from the height of a flat foot's [m]."""
    slip_std_m: float = Field(default=0.001, ge=1e-6, le=0.1)
    """Standard deviation of a standing ankle's motion per frame [m]."""
    shape_steps: int = Field(default=7, ge=1, le=1000)
    """Gauss-Newton steps for shape, offsets and coarse poses together [1]."""
    steps: int = Field(default=4, ge=1, le=1000)
    """Gauss-Newton steps for the poses of every frame [1]; feet stand from the third on."""
    max_filled_gap_s: float = Field(default=1.0, ge=0, le=100)
    """Gaps up to this are filled by motion [s]; in longer ones a person is missing."""

    @property
    def prior_weight(self) -> float:
        """Return the weight of the betas' normal distribution in a shape's covariance [1].

        The paper's shapes have none: their unit covariance makes the mean of several a plain one.
        """
        return 0.0 if self.method == "paper" else self.shape_weight

    def repeated(self, fps: float) -> float:
        """Return the number of frames of a clip that count as one observation [1]."""
        return 1.0 + self.noise_time_s * fps

    def smooth_weight(self, fps: float) -> float:
        """Return the weight of E_smooth in each frame of a clip [1].

        Frames nearer than 1/120 s share their acceleration. Joints of real motion with errors of
        2 cm that last 0.1 s are 24.4 mm off at 240 frames/s with a weight of 1, and 22.3 mm so;
        a limit of 50 frames/s lets errors through at 60 to 120.

        Args:
            fps: of the frames that are fitted [1/s].
        """
        return min(1.0, 120.0 / fps)

    def pose_weight(self, fps: float) -> float:
        """Return the weight of the pose prior in each frame of a clip [1].

        Args:
            fps: of the frames that are fitted [1/s].
        """
        return min(1.0, 1.0 / (self.pose_time_s * fps))
