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
    "static_calibration": {
        "click_noise": "click_noise_px",
        "survey_error": "survey_error_m",
        "drawn_noise": "drawn_noise_px",
        "drawn_reach": "drawn_correlation_px",
        "drawn_loss": "drawn_loss_scale",
        "sample_spacing": "sample_spacing_m",
        "weak_median": "weak_median_m",
        "weak_p95": "weak_p95_m",
        "map_step": "map_step_m",
        "prior.focal_spread": "prior.log_focal_std",
        "prior.principal_point_spread": "prior.principal_point_std",
        "prior.k1_spread": "prior.k1_std",
        "prior.k2_spread": "prior.k2_std",
        "prior.k3_spread": "prior.k3_std",
        "prior.lens_spread": "prior.lens_std",
        "prior.height": "prior.height_m",
        "prior.height_spread": "prior.log_height_std",
        "prior.distance": "prior.distance_m",
        "prior.distance_spread": "prior.log_distance_std",
        "prior.roll_spread": "prior.roll_std_rad",
        "line_refinement.line_width": "line_refinement.line_width_m",
        "line_refinement.line_shift": "line_refinement.line_shift_px",
        "line_refinement.spacing": "line_refinement.spacing_px",
        "line_refinement.reach": "line_refinement.search_px",
        "line_refinement.loss": "line_refinement.loss_scale",
        "line_refinement.least_found": "line_refinement.min_found",
        "line_refinement.least_share": "line_refinement.min_inlier_share",
    },
    "camera_consistency": {
        "pixel_noise": "pixel_noise_px",
        "stretch_frames": "max_chunk_frames",
    },
    "tracking": {
        "gate": "gate_m",
        "min_gate": "min_gate_m",
        "gate_spreads": "gate_factor",
        "epipolar_gate": "epipolar_gate_m",
        "min_angle": "min_angle_rad",
        "body_heights": "body_heights_m",
        "velocity_time": "velocity_time_s",
        "coast_time": "coast_time_s",
        "agility": "velocity_change_std_m_s",
        "max_coast": "max_coast_s",
        "max_lost": "max_lost_s",
        "min_track": "min_track_s",
        "merge_distance": "merge_distance_m",
        "merge_time": "merge_time_s",
        "shadow_distance": "shadow_distance_m",
        "end_time": "end_time_s",
        "max_gap": "max_join_gap_s",
        "max_gap_s": "max_join_gap_s",
        "velocity_memory": "velocity_memory_s",
        "mean_speed": "rms_speed_m_s",
        "limb_noise": "limb_noise_m",
        "limb_spread": "limb_std_m",
    },
    "triangulation": {
        "mend_limbs": "repair_limb_lengths",
        "undo_exchanges": "undo_swaps",
        "pixel_noise": "pixel_noise_px",
        "joint_noise": "joint_noise_m",
        "common_bias": "common_bias_m",
        "min_angle": "min_angle_rad",
        "calibration_error": "calibration_error_m",
        "max_gap": "max_filled_gap_s",
        "max_gap_s": "max_filled_gap_s",
        "clock_error": "max_clock_error_frames",
    },
    "bundle_adjustment": {
        "frames": "max_frames",
        "frame_gap": "min_frame_gap_s",
        "survey_error": "survey_error_m",
        "click_noise": "click_noise_px",
        "robust_scale": "loss_scale",
        "review": "max_review_items",
        "given.rotation": "given.rotation_rad",
        "solver.iterations": "solver.max_iterations",
        "solver.cost_change": "solver.min_cost_change",
    },
    "body_fitting": {
        "longest_gap": "max_filled_gap_s",
        "max_gap_s": "max_filled_gap_s",
        "noise_time": "noise_time_s",
        "joint_floor": "min_joint_std_m",
        "sight_spread": "ray_std_m",
        "tail": "loss_scale",
        "bias_spread": "bias_std_m",
        "bias_time": "bias_time_s",
        "own_bias": "own_bias_std_m",
        "shape_rate": "shape_rate_hz",
        "shape_acceleration": "shape_acceleration_m_s2",
        "acceleration": "acceleration_m_s2",
        "acceleration_tail": "acceleration_loss_scale",
        "shape_time": "shape_time_s",
        "limit_spread": "limit_std_rad",
        "contact_height": "contact_height_m",
        "contact_speed": "contact_speed_m_s",
        "contact_spread": "contact_std_m",
        "slip_spread": "slip_std_m",
    },
    "filtering": {
        "least_fitting": "min_inlier_share",
        "least_similarity": "min_similarity",
        "fewest": "min_keypoints",
        "held_out_frames": "max_held_out_frames",
    },
    "broadcast_calibration": {
        "click_noise": "click_noise_px",
        "survey_error": "survey_error_m",
        "loss": "loss_scale",
        "line_noise": "line_noise_px",
        "line_shift": "line_shift_px",
        "line_reach": "line_search_px",
        "flow_noise": "flow_noise_px",
        "flow_drift": "flow_drift_px",
        "rounds": "passes",
        "iterations": "max_iterations",
        "weak_error": "weak_error_px",
        "prior.principal_point_spread": "prior.principal_point_std",
        "prior.focal_spread": "prior.log_focal_std",
        "prior.k1_spread": "prior.k1_std",
        "prior.k2_spread": "prior.k2_std",
        "prior.k3_spread": "prior.k3_std",
        "prior.center": "prior.center_m",
        "prior.center_spread": "prior.center_std_m",
    },
}
"""By stage; a dot separates a group of settings from a setting in it."""
REMOVED: Final[Mapping[str, Mapping[str, str]]] = {
    "bundle_adjustment": dict.fromkeys(
        ("candidates", "max_candidates"), "triangulation.max_frames"
    ),
    "body_fitting": {"pose_weight": "body_fitting.pose_time_s"},
}
"""By stage: settings that another one, of other units, replaces; those of earlier runs are not
read."""


def rename_settings(
    overrides: Mapping[str, Mapping[str, JsonValue]],
) -> dict[str, dict[str, JsonValue]]:
    """Return settings by stage under their present names, without removed ones."""
    return {
        stage: _rename_settings(
            SETTINGS.get(stage, {}),
            {name: value for name, value in values.items() if name not in REMOVED.get(stage, {})},
        )
        for stage, values in overrides.items()
    }


def former_names(stage: str, setting: str, value: JsonValue) -> list[tuple[str, str]]:
    """Return the former names in a stage's setting and its value, each with its present name."""
    names = SETTINGS.get(stage, {})
    group = value if isinstance(value, dict) else {}
    given = [setting, *(f"{setting}.{name}" for name in group)]
    return [(name, names[name]) for name in given if name in names]


def _rename_settings(
    names: Mapping[str, str], values: Mapping[str, JsonValue], group: str = ""
) -> dict[str, JsonValue]:
    return {
        names.get(f"{group}{name}", f"{group}{name}").removeprefix(group): (
            _rename_settings(names, value, f"{name}.")
            if isinstance(value, dict) and not group
            else value
        )
        for name, value in values.items()
    }
