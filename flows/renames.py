"""Former names of commands, options and settings: each is refused with its present name."""

from __future__ import annotations

from typing import Final

COMMANDS: Final = {"times": "timings"}
OPTIONS: Final = {
    "serve": {
        "--quiet": "--settle-time",
        "--sweep": "--poll-interval",
        "--at-once": "--max-concurrent",
    },
}
"""By command."""
SETTINGS: Final = {
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
