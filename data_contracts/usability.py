"""Verdict on the results of a run, and the limits behind it."""

from __future__ import annotations

from typing import Literal

from data_contracts.records import Amount, Record, Share

Verdict = Literal["usable", "usable with reservations", "not usable"]


class UsableLimits(Record):
    """Limits beyond which a run's results are usable with reservations, or not usable."""

    max_unreadable_share: Share = 0.01
    """Share of a video's frames of a clip without a readable image [1]: a recorder loses single
    frames, not one second of a hundred."""
    max_absent_share: Share = 0.05
    """Share of the time in which tracked people, or all people, are missing for a second or more,
    or a camera departs from the people as of `max_unhealthy_s` [1]: shorter absences are
    occlusions."""
    max_unhealthy_s: Amount = 2.0
    """Longest time in which a camera departs from the people, or its images are dark, bright,
    blurred or missing [s]. One bad second of a long clip is in the joints of other cameras."""
    max_unmatched_share: Share = 0.15
    """Share of detections without a track [1]: staff and crowd cause some, a camera with a wrong
    clock or pose causes many."""
    max_ray_distance_m: Amount = 0.15
    """Mean distance between the rays of matched detections [m]: beyond a shoulder's width of 0.4 m
    people are mixed up; a third of it means that cameras disagree."""
    max_standard_deviation_m: Amount = 0.10
    """Median over joints of the root of the trace of their covariance [m]: with equal errors along
    all axes, sqrt(3) times the standard deviation along one."""
    max_filled_share: Share = 0.05
    """Share of joints that no camera sees, filled by the motion model alone [1]: accuracy is that
    of a guess there."""
    max_ground_error_m: Amount = 0.15
    """Expected error of a static camera on the pitch, median over what it sees [m], where no joints
    measure the effect on people: the limit of which calibration itself warns."""
    max_misplacement_m: Amount = 0.05
    """Displacement of people by the uncertainty of a camera's calibration, root mean square per
    axis at the median person [m]: as large as the error of a joint."""
    max_moved_deviations: Amount = 3.0
    """Motion of a static camera in the adjustment, over the standard deviation that its calibration
    states, root mean square over the axes of its center or orientation [1]: of correct cameras at
    most 0.3 % exceed it in either."""
    max_body_excess_m: Amount = 0.01
    """Root mean square error of fitted joints beyond that of triangulated joints, as held-out
    cameras show it, its lower limit in the worst joint group [m]. A hundredth of a metre beyond a
    triangulated joint's usual 0.03 to 0.05 is 1 to 2 mm in all."""
    max_body_offset_m: Amount = 0.03
    """Offset of the detector's joints from the body's joints, along an axis, root mean square [m];
    0.005 to 0.015 if the body fits."""
    max_broadcast_error_px: Amount = 3.0
    """Expected error of the pitch in a broadcast camera's image, median over frames [px]: a painted
    line of 0.12 m is 4 px wide at 60 m with a focal length of 2000 px. Beyond 3 px the drawn pitch
    is visibly off."""
    max_plane_std_m: Amount = 1.0
    """Standard deviation of the places of people whom only their feet place, root of the trace,
    median over people and frames [m]: twice that of a good camera in simulation, 0.47 m."""
    max_unusable_share: Share = 0.5
    """Share of the time without people, or of detections without a track, beyond which results are
    not usable [1]: most of the clip has none. Also that of the time in which a camera lacks a
    person whom it should show."""


class Usability(Record):
    """Verdict on a run's results."""

    verdict: Verdict
    reservations: tuple[str, ...] = ()
    """What limits the use, one sentence each: camera, frames or person, and why. Reasons that make
    results not usable come first."""
    limits: UsableLimits = UsableLimits()
    """The limits of the verdict."""
