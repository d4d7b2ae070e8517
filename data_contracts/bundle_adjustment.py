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
        about="covariance of a step of each camera, in the units of its parameters; zero for a "
        "given camera whose change was refused; relative to the rig if all cameras are given",
    ),
    ArrayLayout(
        name="accepted",
        dims=("camera",),
        dtype="bool",
        unit="1",
        missing="none",
        about="the adjusted camera was accepted; otherwise it is that of `static_calibration`",
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
        about="keypoints of held-out people that validated the camera",
    ),
    _of_cameras("held_out_loss", "side", "1", "nan", "mean loss of these keypoints"),
    _of_cameras("held_out_error", "side", "px", "nan", "median error of these keypoints"),
    _of_cameras(
        "marking_error",
        "side",
        "px",
        "nan",
        "root mean square error per axis of the clicked points that calibration uses",
    ),
    _of_cameras(
        "weak_step",
        "parameter",
        "1",
        "none",
        "one standard deviation along the least certain direction of the camera",
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
            about=f"{about} of an outlier keypoint, the largest Mahalanobis distance first",
        )
        for name, about in (
            ("frame", "match frame"),
            ("camera", "index of the camera"),
            ("person", "person id"),
            ("joint", "joint, missing if most joints of the person in this image are outliers,"),
        )
    ),
    ArrayLayout(
        name="outlier_surprise",
        dims=("outlier",),
        dtype="float64",
        unit="1",
        missing="none",
        about="its Mahalanobis distance to the position from the other cameras",
    ),
    ArrayLayout(
        name="click_camera",
        dims=("click",),
        dtype="int64",
        unit="1",
        missing="none",
        about="camera index of a clicked point, the largest Mahalanobis distance first",
    ),
    ArrayLayout(
        name="click_residual",
        dims=("click", "axis"),
        dtype="float64",
        unit="px",
        missing="nan",
        about="projected minus clicked, after adjustment; missing if the camera cannot image it",
    ),
    ArrayLayout(
        name="click_surprise",
        dims=("click",),
        dtype="float64",
        unit="1",
        missing="nan",
        about="Mahalanobis distance of the residual, given all other evidence; missing if the "
        "camera cannot image the point",
    ),
    ArrayLayout(
        name="click_wrong",
        dims=("click",),
        dtype="bool",
        unit="1",
        missing="none",
        about="proposed for removal; a person decides",
    ),
)

BUNDLE_ADJUSTMENT = GroupLayout(
    stage="bundle_adjustment",
    about="All static cameras of the match, adjusted to its people and markings.",
    arrays=(*_CAMERAS, *_ACCEPTANCE, *_REVIEW),
    labels={
        **CAMERA_LABELS,
        "parameter": CAMERA_STEP,
        "parameter_": CAMERA_STEP,
        "side": ("before", "after"),
    },
    attributes={
        "camera": "camera ids in the order of the camera dimension",
        "surface": "crown and end fall of the pitch that the static cameras show together [m]; "
        "null if no lines of it were found: those of pitch.json hold",
        "reasons": "why each camera's change was accepted or refused",
        "held_out_gain": "relative decrease of the loss of held-out people",
        "held_out_significance": "the same in standard errors",
        "people_shift": "common displacement of held-out people [m]",
        "weak": "parameters that make up each camera's weakest direction",
        "proposed_frames": "match frames with the most information for the adjustment",
        "used_frames": "match frames whose people are used",
        "judged_frames": "match frames whose held-out people validated",
        "noise_scale": "factor from the stated to the observed noise of keypoints",
        "noise_correlation": "number of keypoints with the information of one independent keypoint",
        "outliers_found": "number of outlier keypoints and people, including those not listed",
        "click": "names of the clicked points",
        "click_problem": "why the camera cannot image a clicked point; otherwise empty",
    },
)
