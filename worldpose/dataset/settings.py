"""What counts as wrong when a data set is checked."""

from __future__ import annotations

from pydantic import Field

from data_contracts.records import Positive, Record, Share


class CheckSettings(Record):
    """Bounds beyond which a data set is reported."""

    sample: int = Field(default=3000, ge=100, le=1_000_000)
    """2D points of a camera that faults are tried on: their median is sure to a few percent."""
    tolerated: float = Field(default=0.06, ge=1e-6, le=10)
    """Median reprojection error that needs no reason [height of a person in the picture]: detected
    keypoints are within this; a convention that is broken is beyond it or explains itself."""
    explained: float = Field(default=0.7, gt=0, lt=1)
    """A fault is named where undoing it leaves at most this part of the median error [1]."""
    least_gain_px: float = Field(default=0.3, ge=1e-6, le=100)
    """And takes away at least this much [px]: files with rounded pixels are not accused."""
    left: float = Field(default=0.2, ge=1e-6, le=100)
    """And leaves no more than this [height of a person in the picture]: garbage has no reason."""
    ground_low: float = Field(default=-0.4, ge=-100, le=0)
    """Lowest median height of the lower foot [m]: a pitch falls by 0.2 m to its edges, and fits
    sink by some centimetres."""
    ground_high: float = Field(default=0.13, ge=0, le=100)
    """Highest median height of the lower foot [m]: heels and toes are some cm above the ground."""
    bounds: tuple[Positive, Positive] = (65.0, 46.0)
    """Largest |x| and |y| of a person [m]: the pitch of 105 x 68 m and 12 m around it."""
    plausible_share: Share = 0.9
    """Least part of all bodies that are near the ground, head up, within the bounds [1]."""
    top_speed: Positive = 13.0
    """Of a person's hips [m/s]; the fastest sprinters reach 12.4."""
    fast_share: Share = 0.002
    """Part of all steps that may be faster [1]: noise of a single frame at 50 frames/s."""
    bones: tuple[Positive, Positive] = (0.15, 0.62)
    """Least and greatest length of a person's upper arm, forearm, thigh and shin [m]."""
    center_drift: Positive = 0.05
    """Largest distance of a moving camera's centre from its median [m]: the release's cameras turn
    and zoom, and never travel."""
    orthonormal: Positive = 1e-4
    """Largest element of R'R - 1 [1]: files in single precision stay far below."""
    least_seen: Share = 0.02
    """Least part of all people that some frame of a camera must show [1]."""
