"""Settings of tracking."""

from __future__ import annotations

from pydantic import Field

from data_contracts.pitch import Coordinate
from data_contracts.records import Positive, Record, Share


class TrackingSettings(Record):
    """Gates, counts and times. The paper gives no values; these suit people in metres."""

    causal: bool = False
    """Identities in a frame depend on it and earlier frames only; else on the whole clip.
    The roster then does not limit the number of people."""
    hungarian: bool = True
    """Match people and detections of a camera by the Hungarian method instead of greedily."""
    gate_m: float = Field(default=0.5, ge=1e-6, le=100)
    """Largest mean distance of a detection's rays to the person it is matched with [m]: half
    the shoulder width of two people side by side, and a sprinter's way in two frames of 50 Hz."""
    min_gate_m: float = Field(default=0.25, ge=1e-6, le=100)
    """Smallest such gate [m]: half the distance of two people who stand side by side. If a camera
    misses a person, a constant `gate_m` lets the track take the neighbour's detection. In 30
    simulated rooms with three cameras there were 33 such swaps within a track, and 7 with this
    setting."""
    gate_factor: float = Field(default=4.0, ge=1e-6, le=1000)
    """A camera's gate is this times the median distance of its matched detections [1], from
    `min_gate_m` to `gate_m`: badly calibrated cameras need more."""
    gate_growth: float = Field(default=2.0, ge=1e-6, le=1000)
    """A person's gate is at least this times that person's recent mean distance [1]: bodies that
    fall or jump leave the prediction step by step, a neighbour's detection at once."""
    epipolar_gate_m: float = Field(default=0.3, ge=1e-6, le=100)
    """Largest mean distance between the rays of two detections of one person [m]."""
    min_joints: int = Field(default=5, ge=1, le=17)
    """Least number of joints, seen on both sides, for a mean distance [1]."""
    birth_views: int = Field(default=3, ge=2, le=1000)
    """Cameras that must agree on a new person [1]; `pair_odds` decides about two. Two rays alone
    also intersect where no person is."""
    pair_odds: float = Field(default=3.0, ge=1, le=1000)
    """Odds from which two views of a new person count as much as three [1]: that the rays of one
    person pass at that distance, with limbs of that size and undetected by the cameras that should
    see it, against no partner and against every other pair that has one of the two detections. In
    single frames of pairs of Shelf's cameras 3 finds 98 % of people and 10 finds 89 %, with as few
    false ones; lower odds find hardly more."""
    pair_evidence: float = Field(default=0.2, ge=0, le=1)
    """Weight towards `min_track_s` of a frame with two views at lower odds [1], unless other pairs
    explain its detections better. Mean IDF1 of simulated clips with few cameras or occluded people:
    0.63 at 0, 0.80 at 0.1, 0.84 at 0.2; at 0.4 as much, with twice the false people at one of three
    corner kicks."""
    min_angle_rad: float = Field(default=0.1, ge=1e-6, le=10)
    """Least angle between rays that determine a position [rad]."""
    size_range: tuple[Positive, Positive] = (0.65, 1.4)
    """Accepted size of a new person relative to an adult of 1.75 m [1]: false intersections are
    mostly giants or dwarfs."""
    body_heights_m: tuple[Coordinate, Coordinate] = (0.2, 1.6)
    """Range of heights over the ground of a body's centre, lying and leaping [m]."""
    predict_motion: bool = True
    """Match with the position predicted at constant velocity instead of the last one; not in the
    paper, for sprinters and for frame rates under 50 Hz."""
    velocity_time_s: float = Field(default=0.1, ge=1e-6, le=10)
    """Averaging time of a person's velocity [s]."""
    coast_time_s: float = Field(default=0.5, ge=1e-6, le=100)
    """Time in which the predicted velocity of an unseen person falls to 37 % [s]."""
    velocity_change_std_m_s: float = Field(default=2.5, ge=1e-6, le=1000)
    """Standard deviation of the change of velocity in the first second [m/s], for footballers
    between two sightings. With people occluded for up to 8 s: half of it makes 107 identity
    switches instead of 90, twice of it none fewer."""
    max_coast_s: float = Field(default=0.2, ge=0, le=100)
    """Time for which an unseen person takes detections at the predicted position [s]; later only a
    new sighting in several views can be that person."""
    max_lost_s: float = Field(default=2.0, ge=0, le=1000)
    """Causal: time after which an unseen person's track ends [s]."""
    min_track_s: float = Field(default=0.2, ge=0, le=100)
    """Tracks with less time in two or more views are false positives and dropped [s]. There is no
    maximum length."""
    merge_distance_m: float = Field(default=0.2, ge=0, le=100)
    """Two tracks with mean joint distance below this are one person [m]: two bodies cannot be."""
    merge_time_s: float = Field(default=0.2, ge=1e-6, le=100)
    """Time of such proximity after which tracks merge [s]. At the end of a clip, so do tracks whose
    bodies are so near in seven tenths of the shorter one's frames, where no camera shows both; not
    in causal mode."""
    shadow_distance_m: float = Field(default=0.5, ge=0, le=100)
    """A track whose body is nearer than this to a person seen by two and a half times as many
    cameras, for seven tenths of its frames, is no person [m]; 0 keeps it. The whole person decides
    about a fragment. Not in causal mode."""
    pitch_margin_m: float = Field(default=2.0, ge=0, le=1000)
    """A person always farther outside of the pitch than this is a bystander [m], by all joined
    tracks: assistants keep within 1.5. Not in causal mode."""
    end_time_s: float = Field(default=0.3, ge=1e-6, le=100)
    """Time over which position and velocity at either end of a track are fitted [s]."""
    max_join_gap_s: float = Field(default=60.0, ge=1e-6, le=10000)
    """Longest time between two tracks of one person that are joined [s]."""
    velocity_memory_s: float = Field(default=1.0, ge=1e-6, le=100)
    """Time after which a velocity does not predict the next one [s]."""
    rms_speed_m_s: float = Field(default=2.0, ge=1e-6, le=1000)
    """Root mean square speed of people on the pitch, per axis [m/s]."""
    paces: tuple[tuple[Share, Positive], ...] = ((0.5, 1.0), (0.5, 0.3))
    """Two modes of motion: their shares of time, and their factors on agility and speed [1]. People
    play in the first mode, and stand or walk in the second, which is half of a match. With the
    first alone, people occluded for up to 8 s switch identity 98 times instead of 90, and 43 joins
    instead of 35 are undecided."""
    place_memory_s: float = Field(default=5.0, ge=1e-3, le=10000)
    """Time after which 37 % of the lost people are still where their motion leads [s]; others may
    be anywhere."""
    size_noise_m: float = Field(default=0.005, ge=1e-6, le=10)
    """Standard deviation of the mean limb length between two tracks of one person, besides the
    scatter of their frames [m]: 3.8 mm with it on Shelf, 3 mm in simulation."""
    size_std_m: float = Field(default=0.018, ge=1e-6, le=10)
    """Standard deviation of the mean limb length among people [m]: 5 % of 0.36 m."""
    limb_noise_m: float = Field(default=0.01, ge=1e-6, le=10)
    """Standard deviation of a limb's length besides the size, between two tracks of one person
    [m]: together with the scatter 14 mm on Shelf."""
    limb_std_m: float = Field(default=0.013, ge=1e-6, le=10)
    """Standard deviation of a limb's length among people of one size [m]."""
    newcomer_odds: float = Field(default=0.01, ge=1e-6, le=1)
    """Prior odds that a person who appears on a pitch is new to the clip and not one lost a second
    ago [1]; they grow with the square of the time since, up to even odds."""
    visitor_odds: float = Field(default=0.1, ge=1e-6, le=1)
    """The same without a pitch, where people come and go [1]. At 0.01, a track that fits badly is
    joined where no other fits: in 26 subsets of Shelf's cameras 6 tracks show two people, 4 at
    0.1."""
    join_odds: float = Field(default=10.0, ge=1, le=1000)
    """Odds against every alternative that decide a join [1]; other joins go to review."""
