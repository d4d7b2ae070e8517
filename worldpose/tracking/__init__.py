"""Multi-view tracking: association of every camera's detections with people, over time (T1, T2).

Inputs: cameras and the detections of each. Outputs: the detection of every person in every frame
and camera, quick joints [m], and a summary of each track.
"""

from typing import TYPE_CHECKING

from worldpose.lazy_names import import_on_use

if TYPE_CHECKING:
    from worldpose.tracking.diagnosis import NoPeople, diagnose_no_people
    from worldpose.tracking.feet import (
        FrameBlocks,
        GroundPositions,
        count_covering_cameras,
        locate_feet,
    )
    from worldpose.tracking.ground_tracks import (
        GroundTracks,
        TriangulatedPeople,
        locate_tracks,
        track_on_plane,
        triangulated_places,
    )
    from worldpose.tracking.joins import describe_doubts
    from worldpose.tracking.plane_clocks import PlaneClocks, estimate_plane_clocks
    from worldpose.tracking.settings import TrackingSettings
    from worldpose.tracking.shirts import measure_shirts
    from worldpose.tracking.tracker import Tracking, TrackingReport, track_people

__all__ = [
    "FrameBlocks",
    "GroundPositions",
    "GroundTracks",
    "NoPeople",
    "PlaneClocks",
    "Tracking",
    "TrackingReport",
    "TrackingSettings",
    "TriangulatedPeople",
    "count_covering_cameras",
    "describe_doubts",
    "diagnose_no_people",
    "estimate_plane_clocks",
    "locate_feet",
    "locate_tracks",
    "measure_shirts",
    "track_on_plane",
    "track_people",
    "triangulated_places",
]

__getattr__ = import_on_use(
    __name__,
    {
        "worldpose.tracking.diagnosis": (
            "NoPeople",
            "diagnose_no_people",
        ),
        "worldpose.tracking.feet": (
            "FrameBlocks",
            "GroundPositions",
            "count_covering_cameras",
            "locate_feet",
        ),
        "worldpose.tracking.ground_tracks": (
            "GroundTracks",
            "TriangulatedPeople",
            "locate_tracks",
            "track_on_plane",
            "triangulated_places",
        ),
        "worldpose.tracking.joins": ("describe_doubts",),
        "worldpose.tracking.plane_clocks": (
            "PlaneClocks",
            "estimate_plane_clocks",
        ),
        "worldpose.tracking.settings": ("TrackingSettings",),
        "worldpose.tracking.shirts": ("measure_shirts",),
        "worldpose.tracking.tracker": (
            "Tracking",
            "TrackingReport",
            "track_people",
        ),
    },
)
