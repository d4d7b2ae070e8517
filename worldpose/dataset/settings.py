"""Thresholds for the validation of a data set."""

from __future__ import annotations

from pydantic import Field

from data_contracts.records import Positive, Record, Share


class CheckSettings(Record):
    """Thresholds beyond which a fault is reported."""

    max_sample: int = Field(default=3000, ge=100, le=1_000_000)
    """Maximum number of 2D points per camera to test faults: their median is accurate to a few
    percent."""
    max_error: float = Field(default=0.06, ge=1e-6, le=10)
    """Tolerated median reprojection error [height of a person in the image]: detected keypoints
    are within it; a broken convention exceeds it or has an explanation."""
    max_share_left: float = Field(default=0.7, gt=0, lt=1)
    """A fault is named if its repair leaves at most this share of the median error [1]."""
    min_gain_px: float = Field(default=0.3, ge=1e-6, le=100)
    """And removes at least this much [px]: rounded pixels must not cause a fault."""
    max_error_left: float = Field(default=0.2, ge=1e-6, le=100)
    """And leaves at most this [height of a person in the image]: random data has no explanation."""
    min_ground_m: float = Field(default=-0.4, ge=-100, le=0)
    """Minimum median height of the lower foot [m]: a pitch falls by 0.2 m to its edges, and fits
    sink by some centimetres."""
    max_ground_m: float = Field(default=0.13, ge=0, le=100)
    """Maximum median height of the lower foot [m]: heels and toes are some cm above the ground."""
    bounds_m: tuple[Positive, Positive] = (65.0, 46.0)
    """Maximum |x| and |y| of people [m]: the pitch of 105 x 68 m and 12 m around it."""
    min_plausible_share: Share = 0.9
    """Minimum share of bodies near the ground, head up, within the bounds [1]."""
    max_speed_m_s: Positive = 13.0
    """Maximum speed of a person's hips [m/s]; the fastest sprinters reach 12.4."""
    max_fast_share: Share = 0.002
    """Tolerated share of faster steps [1]: noise of a single frame at 50 frames/s."""
    bones_m: tuple[Positive, Positive] = (0.15, 0.62)
    """Minimum and maximum length of a person's upper arm, forearm, thigh and shin [m]."""
    max_center_drift_m: Positive = 0.05
    """Maximum distance of a moving camera's centre from its median [m]: the release's cameras
    rotate and zoom, and never translate."""
    max_rotation_error: Positive = 1e-4
    """Largest element of R'R - 1 [1]: files in single precision stay far below."""
    min_visible_share: Share = 0.02
    """Minimum share of people that a camera must show in some frame [1]."""
