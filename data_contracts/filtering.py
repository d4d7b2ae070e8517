"""Result of stage `filtering`: detections classified by the fitted bodies (R2)."""

from __future__ import annotations

from typing import Literal

from data_contracts.arrays import ArrayLayout, GroupLayout, Missing
from data_contracts.conventions import COCO17
from data_contracts.keypoints import FRAME
from data_contracts.tracking import PERSON

_DETECTION = ("frame", "camera", "detection")


def _array(
    name: str,
    dims: tuple[str, ...],
    dtype: Literal["float32", "int16", "bool"],
    missing: Missing,
    about: str,
) -> ArrayLayout:
    return ArrayLayout(
        name=name,
        dims=dims,
        dtype=dtype,
        unit="1",
        missing=missing,
        about=about,
        chunk_dim="frame",
    )


FILTERING = GroupLayout(
    stage="filtering",
    about="Detections compared with fitted bodies: keypoints that the next iteration leaves out, "
    "and systematic errors that it subtracts.",
    coordinates=(FRAME, PERSON),
    arrays=(
        _array(
            "rejected",
            (*_DETECTION, "joint"),
            "bool",
            "none",
            "keypoints that the next iteration leaves out",
        ),
        _array(
            "surprise",
            (*_DETECTION, "joint"),
            "float32",
            "nan",
            "Mahalanobis distance of a keypoint to the body that it is compared with",
        ),
        _array(
            "dropped",
            _DETECTION,
            "bool",
            "none",
            "tracked boxes that fit no person: all their keypoints are rejected",
        ),
        _array(
            "fits",
            _DETECTION,
            "int16",
            "-1",
            "index of the person whose body a box fits, also if `tracking` assigned the box to "
            "another person or to none",
        ),
        _array(
            "similarity",
            _DETECTION,
            "float32",
            "nan",
            "mean cosine between the bones of a box and of the body that it is compared with",
        ),
        ArrayLayout(
            name="shift",
            dims=(*_DETECTION, "joint", "axis"),
            dtype="float32",
            unit="px",
            missing="0",
            about="systematic error of a keypoint, from the viewing direction of the body and the "
            "camera's clock offset; the next iteration subtracts it",
            chunk_dim="frame",
        ),
        ArrayLayout(
            name="view_bias",
            dims=("joint", "axis", "wave"),
            dtype="float64",
            unit="m",
            missing="none",
            about="the part of `shift` that depends on the camera's azimuth around the body",
        ),
        ArrayLayout(
            name="clock_late",
            dims=("camera",),
            dtype="float64",
            unit="frame",
            missing="none",
            about="clock offset: frame t shows the time t + clock_late of the cameras' mean clock; "
            "estimated together with camera positions, unlike that of `triangulation`",
        ),
    ),
    labels={
        "joint": COCO17,
        "axis": ("x", "y"),
        "wave": ("cos2", "cos3", "sin2", "sin3"),
    },
    attributes={"camera": "camera ids in the order of the camera dimension"},
)
"""The detection dimension has the largest length among the cameras; the order is that of `ingest`
or `detection`."""
