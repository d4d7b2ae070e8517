"""Settings of the evaluation."""

from __future__ import annotations

from pydantic import Field

from data_contracts.records import Record


class EvaluationSettings(Record):
    """What counts as the same person, as a correct limb and as visible truth."""

    match_gate: float = Field(default=1.0, ge=1e-6, le=100)
    """Largest mean joint distance at which a prediction is a true person [m]: more than the
    worst fair reconstruction, less than the distance between two players who do not touch."""
    pcp_alpha: float = Field(default=0.5, ge=1e-6, le=100)
    """A limb is correct when its ends are off by at most this share of its length on average [1]:
    the value of the published PCP3D figures."""
    min_views: int = Field(default=2, ge=1, le=1000)
    """A true joint counts when this many cameras saw it [1]: no method can place a joint in
    depth from one view. Used where the truth says who saw what."""
    min_joint_share: float = Field(default=0.5, ge=1e-6, le=1)
    """A true person counts in a frame when at least this share of its joints does [1]: half a
    person at the border of all pictures is not missed."""
    min_overlap: float = Field(default=0.5, ge=1e-6, le=1)
    """Least intersection over union of two boxes of one person [1]; the paper gives no value,
    this is the usual one (E3)."""
    min_aligned_joints: int = Field(default=7, ge=3, le=1000)
    """PA-MPJPE takes a person in a frame who has this many of the 14 joints [1]: three points are
    aligned to any triangle of the same shape, and half a body flatters the other half."""
    min_trajectory: float = Field(default=1.0, ge=1e-6, le=100)
    """Drift takes people whose true path is at least this long [m]: a goalkeeper who stands
    still has any drift per metre."""
    min_matched_share: float = Field(default=0.5, ge=0, le=1)
    """Where fewer of the predicted and true people match in the world as it is, the prediction
    is taken to have a world of its own, and is registered before tracks are matched [1]."""


class CameraErrorSettings(Record):
    """Where on the pitch cameras are compared."""

    spacing: float = Field(default=2.5, ge=1e-6, le=1000)
    """Between neighbours on the grid over the pitch [m]: some 1200 points, of which a tight
    broadcast picture holds about a hundred."""
    player_height: float = Field(default=1.0, ge=1e-6, le=100)
    """Above the surface, where the reprojection error is taken [m]: a player's middle, because
    cameras that are right on the grass can be wrong above it."""
