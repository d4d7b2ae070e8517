"""Result of stage `triangulation`: 3D joints with covariance (T3)."""

from __future__ import annotations

from data_contracts.arrays import ArrayLayout, GroupLayout
from data_contracts.conventions import COCO17
from data_contracts.keypoints import FRAME, POINT_ATTRIBUTE
from data_contracts.tracking import PERSON

EXCHANGED_PARTS = {
    "face": ("eye", "ear"),
    "arms": ("shoulder", "elbow", "wrist"),
    "legs": ("hip", "knee", "ankle"),
}
"""Parts of a body whose left and right sides a detector swaps together, and their joints."""

EXTRA_JOINTS = (
    ArrayLayout(
        name="extra_joints",
        dims=("frame", "person", "point", "coordinate"),
        dtype="float64",
        unit="m",
        missing="nan",
        about="points besides COCO-17, world; attribute `point` names them",
        chunk_dim="frame",
    ),
    ArrayLayout(
        name="extra_covariance",
        dims=("frame", "person", "point", "coordinate", "coordinate_"),
        dtype="float64",
        unit="m^2",
        missing="nan",
        about="covariance of `extra_joints`, from the same errors as `covariance`",
        chunk_dim="frame",
    ),
)
"""Points besides COCO-17 in 3D; absent where no detector gave any."""
EXTRA_TRIANGULATION = (
    *EXTRA_JOINTS,
    ArrayLayout(
        name="extra_views",
        dims=("frame", "person", "point"),
        dtype="uint8",
        unit="1",
        missing="0",
        about="number of inlier cameras of `extra_joints`",
        chunk_dim="frame",
    ),
    ArrayLayout(
        name="extra_common_bias",
        dims=("point",),
        dtype="float64",
        unit="m",
        missing="none",
        about="as `common_bias`; `extra_covariance` contains it",
    ),
)
"""The same as triangulation gives them."""

TRIANGULATION = GroupLayout(
    stage="triangulation",
    about="3D joints of every person, with covariance and inlier views.",
    coordinates=(FRAME, PERSON),
    arrays=(
        ArrayLayout(
            name="joints",
            dims=("frame", "person", "joint", "coordinate"),
            dtype="float64",
            unit="m",
            missing="nan",
            about="joints, world",
            chunk_dim="frame",
        ),
        ArrayLayout(
            name="covariance",
            dims=("frame", "person", "joint", "coordinate", "coordinate_"),
            dtype="float64",
            unit="m^2",
            missing="nan",
            about="covariance of `joints`: the detector's noise as the residuals show it, "
            "calibration, and the bias that all views share",
            chunk_dim="frame",
        ),
        ArrayLayout(
            name="shared_covariance",
            dims=("frame", "person", "coordinate", "coordinate_"),
            dtype="float64",
            unit="m^2",
            missing="nan",
            about="the part of `covariance` that all joints of a person share: calibration moves "
            "the whole person",
            chunk_dim="frame",
        ),
        ArrayLayout(
            name="common_bias",
            dims=("joint",),
            dtype="float64",
            unit="m",
            missing="none",
            about="standard deviation per axis of the error that all views of a joint share; "
            "`covariance` contains it",
        ),
        ArrayLayout(
            name="views",
            dims=("frame", "person", "joint"),
            dtype="uint8",
            unit="1",
            missing="0",
            about="number of inlier cameras",
            chunk_dim="frame",
        ),
        ArrayLayout(
            name="spread",
            dims=("frame", "person", "joint"),
            dtype="float32",
            unit="rad",
            missing="nan",
            about="widest angle between rays of inlier cameras, at most a right angle",
            chunk_dim="frame",
        ),
        ArrayLayout(
            name="reprojection_error",
            dims=("frame", "person", "joint"),
            dtype="float32",
            unit="px",
            missing="nan",
            about="root mean square over the inlier cameras",
            chunk_dim="frame",
        ),
        ArrayLayout(
            name="inliers",
            dims=("frame", "camera", "person", "joint"),
            dtype="bool",
            unit="1",
            missing="none",
            about="this camera's observation is an inlier of the joint",
            chunk_dim="frame",
        ),
        ArrayLayout(
            name="exchanged",
            dims=("frame", "camera", "person", "part"),
            dtype="bool",
            unit="1",
            missing="none",
            about="this camera's detection has left and right of this part swapped; joints and "
            "`inliers` are computed after correction",
            chunk_dim="frame",
        ),
        ArrayLayout(
            name="offsets",
            dims=("frame", "camera", "person", "axis"),
            dtype="float32",
            unit="px",
            missing="0",
            about="common image offset of the person in this camera, from calibration errors",
            chunk_dim="frame",
        ),
        ArrayLayout(
            name="smoothed",
            dims=("frame", "person", "joint", "coordinate"),
            dtype="float64",
            unit="m",
            missing="nan",
            about="joints smoothed over the whole track, world",
            chunk_dim="frame",
        ),
        ArrayLayout(
            name="smoothed_covariance",
            dims=("frame", "person", "joint", "coordinate", "coordinate_"),
            dtype="float64",
            unit="m^2",
            missing="nan",
            about="covariance of `smoothed`; it grows inside gaps",
            chunk_dim="frame",
        ),
        ArrayLayout(
            name="filled",
            dims=("frame", "person", "joint"),
            dtype="bool",
            unit="1",
            missing="none",
            about="`smoothed` is present and `joints` is missing",
            chunk_dim="frame",
        ),
        ArrayLayout(
            name="clock_late",
            dims=("camera",),
            dtype="float64",
            unit="frame",
            missing="nan",
            about="clock offset: frame t shows the time t + clock_late of the cameras' mean clock; "
            "missing without enough motion",
        ),
        ArrayLayout(
            name="clock_error",
            dims=("camera",),
            dtype="float64",
            unit="frame",
            missing="none",
            about="standard error of `clock_late`",
        ),
        *EXTRA_TRIANGULATION,
    ),
    labels={
        "joint": COCO17,
        "part": tuple(EXCHANGED_PARTS),
        "axis": ("x", "y"),
        "coordinate": ("x", "y", "z"),
        "coordinate_": ("x", "y", "z"),
    },
    attributes={"camera": "camera ids in the order of the camera dimension", **POINT_ATTRIBUTE},
    optional=(*(array.name for array in EXTRA_TRIANGULATION), *POINT_ATTRIBUTE),
)
