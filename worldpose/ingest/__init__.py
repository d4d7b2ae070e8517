"""Ingest: validated records and dense arrays from a match folder.

Inputs: match.yaml, calibration.toml, clicked markings, detections/, pitch.json, videos; or files of
other tools.
Outputs: `MatchFolder`, `Registration`, `KeypointDetections` on match frames.
"""

from typing import TYPE_CHECKING

from worldpose.lazy_names import import_on_use

if TYPE_CHECKING:
    from worldpose.formats.calibration_files import write_calibration_toml
    from worldpose.formats.calibration_forms import read_calibration
    from worldpose.formats.keypoint_files import read_observations
    from worldpose.ingest.clicks import ImportedClicks, import_clicks
    from worldpose.ingest.footage import UnitFrames, read_unit, unit_frames
    from worldpose.ingest.importing import (
        import_lenses,
        import_match,
        import_pose2sim,
        import_videos,
    )
    from worldpose.ingest.match_folder import (
        MatchFolder,
        read_match,
        require_calibrated,
        unclicked_clips,
    )
    from worldpose.ingest.registration import register_match
    from worldpose.ingest.writing import MatchAnnotations, import_boxes, write_match

__all__ = [
    "ImportedClicks",
    "MatchAnnotations",
    "MatchFolder",
    "UnitFrames",
    "import_boxes",
    "import_clicks",
    "import_lenses",
    "import_match",
    "import_pose2sim",
    "import_videos",
    "read_calibration",
    "read_match",
    "read_observations",
    "read_unit",
    "register_match",
    "require_calibrated",
    "unclicked_clips",
    "unit_frames",
    "write_calibration_toml",
    "write_match",
]

__getattr__ = import_on_use(
    __name__,
    {
        "worldpose.formats.calibration_files": ("write_calibration_toml",),
        "worldpose.formats.calibration_forms": ("read_calibration",),
        "worldpose.formats.keypoint_files": ("read_observations",),
        "worldpose.ingest.clicks": (
            "ImportedClicks",
            "import_clicks",
        ),
        "worldpose.ingest.footage": (
            "UnitFrames",
            "read_unit",
            "unit_frames",
        ),
        "worldpose.ingest.importing": (
            "import_lenses",
            "import_match",
            "import_pose2sim",
            "import_videos",
        ),
        "worldpose.ingest.match_folder": (
            "MatchFolder",
            "read_match",
            "require_calibrated",
            "unclicked_clips",
        ),
        "worldpose.ingest.registration": ("register_match",),
        "worldpose.ingest.writing": (
            "MatchAnnotations",
            "import_boxes",
            "write_match",
        ),
    },
)
