"""Former names of commands, options and settings: each is refused with its present name.

Settings in the records of earlier runs are read under their present names.
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import TYPE_CHECKING, Final

if TYPE_CHECKING:
    from pydantic import JsonValue

COMMANDS: Final = {"times": "timings"}
OPTIONS: Final = {
    "serve": {
        "--quiet": "--settle-time",
        "--sweep": "--poll-interval",
        "--at-once": "--max-concurrent",
    },
}
"""By command."""
SETTINGS: Final[Mapping[str, Mapping[str, str]]] = {
    "detection": {
        "mirrored": "flip_test",
        "overlap": "nms_iou",
        "sure": "high_score_threshold",
        "doubtful": "low_score_threshold",
        "patience": "track_buffer_frames",
        "bridge": "max_gap_frames",
        "sightings": "min_hits",
        "beside": "find_occluded",
        "least_keypoint": "min_keypoint_confidence",
        "same_pose": "oks_nms",
        "most_people": "max_people",
    },
    "redetection": {
        "least_height_px": "min_height_px",
        "least_in_sight": "min_visible_share",
        "most_unsure_m": "max_uncertainty_m",
        "least_confidence": "min_confidence",
        "least_fitting": "min_inlier_share",
        "least_similarity": "min_similarity",
        "same_pose": "oks_nms",
    },
    "triangulation": {"mend_limbs": "repair_limb_lengths", "undo_exchanges": "undo_swaps"},
    "body_fitting": {"longest_gap": "max_gap_s"},
    "filtering": {
        "least_fitting": "min_inlier_share",
        "least_similarity": "min_similarity",
        "fewest": "min_keypoints",
    },
}
"""By stage."""


def rename_settings(
    overrides: Mapping[str, Mapping[str, JsonValue]],
) -> dict[str, dict[str, JsonValue]]:
    """Return settings by stage under their present names."""
    return {
        stage: {SETTINGS.get(stage, {}).get(name, name): value for name, value in values.items()}
        for stage, values in overrides.items()
    }
