"""Settings of the evaluation."""

from __future__ import annotations

from pydantic import Field

from data_contracts.records import Record


class EvaluationSettings(Record):
    """What counts as the same person, as a correct limb and as visible truth."""

    match_gate: float = Field(default=1.0, gt=0)
    """Largest mean joint distance at which a prediction is a true person [m]: more than the
    worst fair reconstruction, less than the distance between two players who do not touch."""
    pcp_alpha: float = Field(default=0.5, gt=0)
    """A limb is correct when its ends are off by at most this share of its length on average [1]:
    the value of the published PCP3D figures."""
    min_views: int = Field(default=2, ge=1)
    """A true joint counts when this many cameras saw it [1]: no method can place a joint in
    depth from one view. Used where the truth says who saw what."""
    min_joint_share: float = Field(default=0.5, gt=0, le=1)
    """A true person counts in a frame when at least this share of its joints does [1]: half a
    person at the border of all pictures is not missed."""
