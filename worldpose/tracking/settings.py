"""Settings of tracking."""

from __future__ import annotations

from pydantic import Field

from data_contracts.pitch import Coordinate
from data_contracts.records import Positive, Record, Share


class TrackingSettings(Record):
    """How near, how many and how long. The paper gives no values; these suit people in metres."""

    causal: bool = False
    """Decide every frame from it and those before it; else the whole clip decides who is who."""
    hungarian: bool = True
    """Match people and detections of a camera by the Hungarian method instead of greedily (T1)."""
    gate: float = Field(default=0.5, ge=1e-6, le=100)
    """Largest mean distance of a detection's rays to the person it is matched with [m] (T1): half
    the shoulder width of two people side by side, and a sprinter's way in two frames of 50 Hz."""
    min_gate: float = Field(default=0.25, ge=1e-6, le=100)
    """Smallest such limit [m]: half of what separates two people who stand side by side. A limit
    that is always `gate` lets a person whom a camera misses take the neighbour's detection: of
    30 simulated rooms with three cameras 33 such exchanges within a track, 7 with this."""
    gate_spreads: float = Field(default=4.0, ge=1e-6, le=1000)
    """A camera's limit is this times the median distance of its matched detections [1], from
    `min_gate` to `gate`: badly calibrated cameras need more."""
    gate_growth: float = Field(default=2.0, ge=1e-6, le=1000)
    """A person's limit is at least this times that person's mean distance of late [1]: bodies
    that fall or jump leave the prediction step by step, a neighbour's detection at once."""
    epipolar_gate: float = Field(default=0.3, ge=1e-6, le=100)
    """Largest mean distance between the rays of two detections of one person [m] (T2)."""
    min_joints: int = Field(default=5, ge=1, le=17)
    """Least joints, seen on both sides, that a mean distance needs [1]."""
    birth_views: int = Field(default=3, ge=2, le=1000)
    """Cameras that must agree on a new person [1]; two count as `pair_odds` says. Two rays alone
    meet at ghosts as well as at people."""
    pair_odds: float = Field(default=10.0, ge=1, le=1000)
    """Odds from which two views of a new person count as much as three [1]: that the rays of one
    person pass as far apart, at limbs of that size, missed by the cameras that should see it,
    against no partner and against every other pair that has one of the two detections."""
    pair_evidence: float = Field(default=0.2, ge=0, le=1)
    """What a frame with two views at lower odds counts towards `min_track` [1], unless other pairs
    explain its detections better. Mean IDF1 of simulated clips with few cameras or people out of
    sight: 0.63 at 0, 0.80 at 0.1, 0.84 at 0.2; at 0.4 as much, with twice the invented people at
    one of three corner kicks."""
    min_angle: float = Field(default=0.1, ge=1e-6, le=10)
    """Least angle between rays that are to fix a position [rad]."""
    size_range: tuple[Positive, Positive] = (0.65, 1.4)
    """Accepted size of a new person relative to an adult of 1.75 m [1]: false intersections are
    mostly giants or dwarfs."""
    body_heights: tuple[Coordinate, Coordinate] = (0.2, 1.6)
    """Heights over the ground that the middle of a body may have, lying and leaping [m]."""
    predict_motion: bool = True
    """Match with the position predicted at constant velocity instead of the last one; not in the
    paper, for sprinters and for frame rates under 50 Hz."""
    velocity_time: float = Field(default=0.1, ge=1e-6, le=10)
    """Time over which a person's velocity is averaged [s]."""
    coast_time: float = Field(default=0.5, ge=1e-6, le=100)
    """Time in which the predicted velocity of an unseen person falls to 37 % [s]."""
    agility: float = Field(default=2.5, ge=1e-6, le=1000)
    """Standard deviation of the change of velocity in the first second [m/s]: what footballers do
    between two sightings. People hidden for up to 8 s: half of it makes 107 switches of 90, twice
    none fewer."""
    max_coast: float = Field(default=0.2, ge=0, le=100)
    """Time for which an unseen person takes detections at the predicted place [s]; later only a
    new sighting in several views can be that person."""
    max_lost: float = Field(default=2.0, ge=0, le=1000)
    """Causal: time after which an unseen person's track ends [s]."""
    min_track: float = Field(default=0.2, ge=0, le=100)
    """Tracks with less time in two or more views are ghosts and dropped [s]."""
    merge_distance: float = Field(default=0.2, ge=0, le=100)
    """Two tracks with mean joint distance below this are on one person [m]: bodies cannot."""
    merge_time: float = Field(default=0.2, ge=1e-6, le=100)
    """Time for which they must be so near to be merged [s]."""
    shadow_distance: float = Field(default=0.5, ge=0, le=100)
    """A track whose body is nearer than this to somebody seen by two and a half times as many
    cameras, for seven tenths of its frames, is no person [m]; 0 keeps it. A stretch of somebody is
    judged by the whole of him. Not where every frame is decided from it and those before it."""
    pitch_margin_m: float = Field(default=2.0, ge=0, le=1000)
    """Who is always farther outside of the pitch than this is a bystander [m], by all tracks that
    are joined: assistants keep within 1.5. Not where every frame is decided from it and those
    before it."""
    end_time: float = Field(default=0.3, ge=1e-6, le=100)
    """Time over which place and velocity at either end of a track are fitted [s]."""
    max_gap: float = Field(default=60.0, ge=1e-6, le=10000)
    """Longest time between two tracks of one person that are joined [s]."""
    velocity_memory: float = Field(default=1.0, ge=1e-6, le=100)
    """Time after which a velocity says nothing about the next [s]."""
    mean_speed: float = Field(default=2.0, ge=1e-6, le=1000)
    """Root mean square speed of people on the pitch, per axis [m/s]."""
    paces: tuple[tuple[Share, Positive], ...] = ((0.5, 1.0), (0.5, 0.3))
    """Shares of time, and what agility and speed are then times [1]: at play, and standing or
    walking, which is half of a match. With the first alone, people hidden for up to 8 s change
    identity 98 times instead of 90, and 43 joins instead of 35 are undecided."""
    limb_noise: float = Field(default=0.02, ge=1e-6, le=10)
    """Standard deviation of a limb's length between two long tracks of one person [m]. Half or
    twice of it changes one join of some 200, and so does leaving limbs out of account."""
    limb_spread: float = Field(default=0.025, ge=1e-6, le=10)
    """Standard deviation of a limb's length among people [m]: 6 % of 0.42 m."""
    newcomer_odds: float = Field(default=0.01, ge=1e-6, le=1)
    """Odds, before looking, that who appears on a pitch is new to the clip and not somebody lost
    [1]. Half or twice of it changes nothing, nor do others where the roster is full."""
    visitor_odds: float = Field(default=0.1, ge=1e-6, le=1)
    """The same without a pitch, where people come and go [1]. At 0.01, a track that fits badly is
    joined where nothing else fits: in 26 subsets of Shelf's cameras 6 tracks show two people, 4
    at 0.1."""
    join_odds: float = Field(default=10.0, ge=1, le=1000)
    """Odds against every other way that decide a join [1]; less goes to review."""
