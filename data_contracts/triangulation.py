"""Result of stage `triangulation`: where every joint is, and how sure that is (T3)."""

from __future__ import annotations

from data_contracts.arrays import ArrayLayout, GroupLayout
from data_contracts.conventions import COCO17
from data_contracts.keypoints import FRAME
from data_contracts.tracking import PERSON

EXCHANGED_PARTS = {
    "face": ("eye", "ear"),
    "arms": ("shoulder", "elbow", "wrist"),
    "legs": ("hip", "knee", "ankle"),
}
"""Parts of a body whose left and right a detector exchanges together, and their joints."""

TRIANGULATION = GroupLayout(
    stage="triangulation",
    about="3D joints of every person with covariance and the views that carry them.",
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
            name="common_bias",
            dims=("joint",),
            dtype="float64",
            unit="m",
            missing="none",
            about="standard deviation per axis of what all views of a joint err in common; "
            "`covariance` contains it",
        ),
        ArrayLayout(
            name="views",
            dims=("frame", "person", "joint"),
            dtype="uint8",
            unit="1",
            missing="0",
            about="cameras whose observation agrees with the joint",
            chunk_dim="frame",
        ),
        ArrayLayout(
            name="spread",
            dims=("frame", "person", "joint"),
            dtype="float32",
            unit="rad",
            missing="nan",
            about="widest angle between rays of agreeing cameras, at most a right one",
            chunk_dim="frame",
        ),
        ArrayLayout(
            name="reprojection_error",
            dims=("frame", "person", "joint"),
            dtype="float32",
            unit="px",
            missing="nan",
            about="root mean square over the agreeing cameras",
            chunk_dim="frame",
        ),
        ArrayLayout(
            name="inliers",
            dims=("frame", "camera", "person", "joint"),
            dtype="bool",
            unit="1",
            missing="none",
            about="does this camera's observation agree with the joint",
            chunk_dim="frame",
        ),
        ArrayLayout(
            name="exchanged",
            dims=("frame", "camera", "person", "part"),
            dtype="bool",
            unit="1",
            missing="none",
            about="did this camera's detection have left and right of this part exchanged; the "
            "joints and `inliers` are from it put right",
            chunk_dim="frame",
        ),
        ArrayLayout(
            name="offsets",
            dims=("frame", "camera", "person", "axis"),
            dtype="float32",
            unit="px",
            missing="0",
            about="by how much the camera sees the person beside where all cameras put him",
            chunk_dim="frame",
        ),
        ArrayLayout(
            name="smoothed",
            dims=("frame", "person", "joint", "coordinate"),
            dtype="float64",
            unit="m",
            missing="nan",
            about="joints of the whole track, world: all its observations, little acceleration",
            chunk_dim="frame",
        ),
        ArrayLayout(
            name="smoothed_covariance",
            dims=("frame", "person", "joint", "coordinate", "coordinate_"),
            dtype="float64",
            unit="m^2",
            missing="nan",
            about="covariance of `smoothed`, growing into gaps",
            chunk_dim="frame",
        ),
        ArrayLayout(
            name="filled",
            dims=("frame", "person", "joint"),
            dtype="bool",
            unit="1",
            missing="none",
            about="is `smoothed` there though `joints` is not",
            chunk_dim="frame",
        ),
        ArrayLayout(
            name="clock_late",
            dims=("camera",),
            dtype="float64",
            unit="frame",
            missing="nan",
            about="frame t shows the time t + clock_late of the cameras' mean clock; missing "
            "where too little moves",
        ),
        ArrayLayout(
            name="clock_error",
            dims=("camera",),
            dtype="float64",
            unit="frame",
            missing="none",
            about="standard error of `clock_late`",
        ),
    ),
    labels={
        "joint": COCO17,
        "part": tuple(EXCHANGED_PARTS),
        "axis": ("x", "y"),
        "coordinate": ("x", "y", "z"),
        "coordinate_": ("x", "y", "z"),
    },
    attributes={"camera": "camera ids in the order of the camera dimension"},
)
