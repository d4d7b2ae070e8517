"""Settings of the evaluation."""

from __future__ import annotations

from pydantic import Field

from data_contracts.records import Record


class EvaluationSettings(Record):
    """Thresholds for matches, correct limbs and visible joints."""

    match_gate_m: float = Field(default=1.0, ge=1e-6, le=100)
    """Maximum mean joint distance of matched persons [m]: more than the error of a poor
    reconstruction, less than the distance between two players without contact."""
    pcp_alpha: float = Field(default=0.5, ge=1e-6, le=100)
    """Maximum mean error of a correct limb's ends, as a share of its length [1]: the value of the
    published PCP3D results."""
    min_views: int = Field(default=2, ge=1, le=1000)
    """Minimum cameras that see a true joint for it to count [1]: one view does not determine depth.
    Applies if the truth has `views`."""
    min_joint_share: float = Field(default=0.5, ge=1e-6, le=1)
    """Minimum share of counting joints for a true person to count in a frame [1]: half a person at
    the border of all images is no false negative."""
    min_overlap: float = Field(default=0.5, ge=1e-6, le=1)
    """Minimum intersection over union of matched boxes [1]; the usual value, since the paper gives
    none (E3)."""
    min_aligned_joints: int = Field(default=7, ge=3, le=1000)
    """Minimum joints, of 14, of a person in a frame for PA-MPJPE [1]: alignment to a few joints
    removes most of their error, and half a body hides the error of the other half."""
    min_trajectory_m: float = Field(default=1.0, ge=1e-6, le=100)
    """Minimum true path length of people for the drift [m]: the drift per metre of a standing
    goalkeeper is arbitrary."""
    min_matched_share: float = Field(default=0.5, ge=0, le=1)
    """Minimum share of matched people without registration [1]; below, the evaluation assumes that
    the prediction has its own world, and registers it before it matches tracks."""


class CameraErrorSettings(Record):
    """Grid of test points for camera errors."""

    spacing_m: float = Field(default=2.5, ge=1e-6, le=1000)
    """Spacing of the grid over the pitch [m]: some 1200 points, of which a tight broadcast frame
    shows about a hundred."""
    player_height_m: float = Field(default=1.0, ge=1e-6, le=100)
    """Height above the surface of the points for the reprojection error [m]: a player's middle,
    since cameras that are accurate on the grass can be wrong above it."""
