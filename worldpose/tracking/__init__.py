"""Multi-view tracking: association of every camera's detections with people, over time (T1, T2).

Inputs: cameras and the detections of each. Outputs: the detection of every person in every frame
and camera, quick joints [m], and a summary of each track.
"""

from worldpose.tracking.diagnosis import NoPeople, diagnose_no_people
from worldpose.tracking.doubts import describe_doubts
from worldpose.tracking.people_selection import roster_limit
from worldpose.tracking.settings import TrackingSettings
from worldpose.tracking.tracker import Tracking, TrackingReport, track_people

__all__ = [
    "NoPeople",
    "Tracking",
    "TrackingReport",
    "TrackingSettings",
    "describe_doubts",
    "diagnose_no_people",
    "roster_limit",
    "track_people",
]
