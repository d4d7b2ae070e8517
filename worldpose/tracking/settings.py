"""Settings of tracking."""

from __future__ import annotations

from pydantic import Field

from data_contracts.records import Record


class TrackingSettings(Record):
    """How near, how many and how long. The paper gives no values; these suit people in metres."""

    gate: float = Field(default=0.5, gt=0)
    """Largest mean distance of a detection's rays to the person it is matched with [m] (T1): half
    the shoulder width of two people side by side, and a sprinter's way in two frames of 50 Hz."""
    epipolar_gate: float = Field(default=0.3, gt=0)
    """Largest mean distance between the rays of two detections of one person [m] (T2)."""
    min_joints: int = Field(default=5, ge=1, le=17)
    """Least joints, seen on both sides, that a mean distance needs [1]."""
    birth_views: int = Field(default=3, ge=2)
    """Cameras that must agree on a new person [1]; two on a rig of two. Two rays alone meet at
    ghosts as well as at people."""
    min_angle: float = Field(default=0.1, gt=0)
    """Least angle between rays that are to fix a position [rad]."""
    size_range: tuple[float, float] = (0.65, 1.4)
    """Accepted size of a new person relative to an adult of 1.75 m [1]: false intersections are
    mostly giants or dwarfs."""
    predict_motion: bool = True
    """Match with the position predicted at constant velocity instead of the last one; not in the
    paper, for sprinters and for frame rates under 50 Hz."""
    velocity_time: float = Field(default=0.1, gt=0)
    """Time over which a person's velocity is averaged [s]."""
    coast_time: float = Field(default=0.5, gt=0)
    """Time in which the predicted velocity of an unseen person falls to 37 % [s]."""
    max_lost: float = Field(default=2.0, ge=0)
    """Time after which an unseen person's track ends [s]."""
    refound_speed: float = Field(default=3.0, ge=0)
    """A new person within `gate` plus this times the time unseen of a lost one's predicted place
    is that one [m/s]."""
    min_track: float = Field(default=0.2, ge=0)
    """Tracks with less time in two or more views are ghosts and dropped [s]."""
    merge_distance: float = Field(default=0.2, ge=0)
    """Two tracks with mean joint distance below this are on one person [m]: bodies cannot."""
    merge_time: float = Field(default=0.2, gt=0)
    """Time for which they must be so near to be merged [s]."""
