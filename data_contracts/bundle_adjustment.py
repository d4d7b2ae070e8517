"""Result of stage `bundle_adjustment`: cameras that agree with markings and people (B1-B3)."""

from __future__ import annotations

from data_contracts.arrays import ArrayLayout, GroupLayout, Missing
from data_contracts.cameras import CAMERA_ARRAYS, CAMERA_LABELS
from data_contracts.static_calibration import CAMERA_STEP


def _of_cameras(name: str, last: str, unit: str, missing: Missing, about: str) -> ArrayLayout:
    return ArrayLayout(
        name=name,
        dims=("camera", last),
        dtype="float64",
        unit=unit,
        missing=missing,
        about=about,
    )


_CAMERAS = tuple(
    array.model_copy(update={"dims": ("camera", *array.dims)}) for array in CAMERA_ARRAYS
)
_ACCEPTANCE = (
    ArrayLayout(
        name="camera_covariance",
        dims=("camera", "parameter", "parameter_"),
        dtype="float64",
        unit="1",
        missing="none",
        about="covariance of a step of each camera, in the units of its parameters; all zero for "
        "a given camera whose change was refused, and relative to all cameras together where all "
        "are given",
    ),
    ArrayLayout(
        name="accepted",
        dims=("camera",),
        dtype="bool",
        unit="1",
        missing="none",
        about="was the camera changed; else it is as `static_calibration` has it",
    ),
    *(
        ArrayLayout(
            name=f"moved_{name}",
            dims=("camera",),
            dtype="float64",
            unit=unit,
            missing="0",
            about=about,
        )
        for name, unit, about in (
            ("center", "m", "distance between the camera's centers before and after"),
            ("rotation", "rad", "angle between its axes before and after"),
            ("focal", "1", "relative change of its focal length"),
        )
    ),
    ArrayLayout(
        name="judges",
        dims=("camera",),
        dtype="int64",
        unit="1",
        missing="0",
        about="keypoints of left-out people that judged the camera",
    ),
    _of_cameras("held_out_loss", "side", "1", "nan", "mean loss of these keypoints, which decides"),
    _of_cameras("held_out_error", "side", "px", "nan", "median error of these keypoints"),
    _of_cameras(
        "marking_error",
        "side",
        "px",
        "nan",
        "root mean square error per axis of the clicked points that calibration rests on",
    ),
    _of_cameras(
        "weak_step",
        "parameter",
        "1",
        "none",
        "one standard deviation along the direction in which the camera is known least",
    ),
)
_REVIEW = (
    *(
        ArrayLayout(
            name=f"outlier_{name}",
            dims=("outlier",),
            dtype="int64",
            unit="frame" if name == "frame" else "1",
            missing="-1" if name == "joint" else "none",
            about=f"{about} of a keypoint that disagrees, the most surprising first",
        )
        for name, about in (
            ("frame", "match frame"),
            ("camera", "place among the cameras"),
            ("person", "person id"),
            ("joint", "joint, missing where most of the person in this picture is off,"),
        )
    ),
    ArrayLayout(
        name="outlier_surprise",
        dims=("outlier",),
        dtype="float64",
        unit="1",
        missing="none",
        about="its distance to where the other cameras put it, in standard deviations",
    ),
    ArrayLayout(
        name="click_camera",
        dims=("click",),
        dtype="int64",
        unit="1",
        missing="none",
        about="place among the cameras of a clicked point, the most surprising first",
    ),
    ArrayLayout(
        name="click_residual",
        dims=("click", "axis"),
        dtype="float64",
        unit="px",
        missing="nan",
        about="projected minus clicked, after adjustment; missing where the camera cannot image it",
    ),
    ArrayLayout(
        name="click_surprise",
        dims=("click",),
        dtype="float64",
        unit="1",
        missing="nan",
        about="residual in standard deviations of what everything else predicts; missing where the "
        "camera cannot image it",
    ),
    ArrayLayout(
        name="click_wrong",
        dims=("click",),
        dtype="bool",
        unit="1",
        missing="none",
        about="is it proposed for removal; a person decides",
    ),
)

BUNDLE_ADJUSTMENT = GroupLayout(
    stage="bundle_adjustment",
    about="All static cameras of a match, adjusted to its people and markings.",
    arrays=(*_CAMERAS, *_ACCEPTANCE, *_REVIEW),
    labels={
        **CAMERA_LABELS,
        "parameter": CAMERA_STEP,
        "parameter_": CAMERA_STEP,
        "side": ("before", "after"),
    },
    attributes={
        "camera": "camera ids in the order of the camera dimension",
        "reasons": "why each camera was changed or not",
        "held_out_gain": "part of their loss that the change spares left-out people",
        "held_out_significance": "the same in standard errors",
        "people_shift": "distance by which left-out people moved together [m]",
        "weak": "parameters that make up each camera's weakest direction",
        "proposed_frames": "match frames that suit adjustment best",
        "used_frames": "match frames that people were taken from",
        "judged_frames": "match frames in which left-out people judged",
        "noise_scale": "factor on the stated noise of keypoints that they show",
        "noise_correlation": "keypoints that are worth one independent one",
        "outliers_found": "keypoints and people that disagree, also beyond the list",
        "click": "names of the clicked points",
        "click_problem": "for each clicked point that its camera cannot image, why; else empty",
    },
)
