"""Result of stage `bundle_adjustment`: cameras that agree with markings and people."""

from __future__ import annotations

from data_contracts.arrays import GroupLayout, array_layout, array_layouts
from data_contracts.cameras import CAMERA_ARRAYS, CAMERA_LABELS
from data_contracts.static_calibration import CAMERA_STEP

_CAMERAS = tuple(
    array.model_copy(update={"dims": ("camera", *array.dims)}) for array in CAMERA_ARRAYS
)
_ACCEPTANCE = (
    *array_layouts(
        """
        camera_covariance (camera, parameter, parameter_) float64 [1]:
            covariance of a step of each camera, in the units of its parameters; zero for a given
            camera whose change was refused; relative to the rig if all cameras are given
        accepted (camera) bool [1]:
            the adjusted camera was accepted; otherwise it is that of `static_calibration`
        """
    ),
    *(
        array_layout(f"moved_{name}", f"(camera) float64 [{unit}], missing 0", about)
        for name, unit, about in (
            ("center", "m", "distance between the camera's centers before and after"),
            ("rotation", "rad", "angle between its axes before and after"),
            ("focal", "1", "relative change of its focal length"),
        )
    ),
    *array_layouts(
        """
        judges (camera) int64 [1], missing 0:
            keypoints of held-out people that validated the camera
        held_out_loss (camera, side) float64 [1], missing nan:
            mean loss of these keypoints
        held_out_error (camera, side) float64 [px], missing nan:
            median error of these keypoints
        marking_error (camera, side) float64 [px], missing nan:
            root mean square error per axis of the clicked points that calibration uses
        weak_step (camera, parameter) float64 [1]:
            one standard deviation along the least certain direction of the camera
        """
    ),
)
_REVIEW = (
    *(
        array_layout(
            f"outlier_{name}",
            f"(outlier) int64 {form}",
            f"{about} of an outlier keypoint, the largest Mahalanobis distance first",
        )
        for name, form, about in (
            ("frame", "[frame]", "match frame"),
            ("camera", "[1]", "index of the camera"),
            ("person", "[1]", "person id"),
            (
                "joint",
                "[1], missing -1",
                "joint, missing if most joints of the person in this image are outliers,",
            ),
        )
    ),
    *array_layouts(
        """
        outlier_surprise (outlier) float64 [1]:
            its Mahalanobis distance to the position from the other cameras
        click_camera (click) int64 [1]:
            camera index of a clicked point, the largest Mahalanobis distance first
        click_residual (click, axis) float64 [px], missing nan:
            projected minus clicked, after adjustment; missing if the camera cannot image it
        click_surprise (click) float64 [1], missing nan:
            Mahalanobis distance of the residual, given all other evidence; missing if the camera
            cannot image the point
        click_wrong (click) bool [1]:
            proposed for removal; a person decides
        """
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
