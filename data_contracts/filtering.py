"""Result of stage `filtering`: what the fitted bodies say of every detection (R2)."""

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
    about="What fitted bodies say of detections: what the next iteration leaves out or takes off.",
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
            "distance of a keypoint to the body it is judged by, in standard deviations",
        ),
        _array(
            "dropped",
            _DETECTION,
            "bool",
            "none",
            "boxes that were taken for a person and fit nobody: all their keypoints are rejected",
        ),
        _array(
            "fits",
            _DETECTION,
            "int16",
            "-1",
            "place among the persons of the body that a box fits, also where `tracking` took it "
            "for another or for nobody",
        ),
        _array(
            "similarity",
            _DETECTION,
            "float32",
            "nan",
            "mean cosine between the bones of a box and of the body it is judged by",
        ),
        ArrayLayout(
            name="shift",
            dims=(*_DETECTION, "joint", "axis"),
            dtype="float32",
            unit="px",
            missing="0",
            about="by how far a keypoint is beside its joint for lasting reasons, the side that "
            "the body is seen from and the camera's clock; the next iteration takes it off",
            chunk_dim="frame",
        ),
        ArrayLayout(
            name="view_bias",
            dims=("joint", "axis", "wave"),
            dtype="float64",
            unit="m",
            missing="none",
            about="the part of `shift` that goes with the azimuth of the camera seen from the body",
        ),
        ArrayLayout(
            name="clock_late",
            dims=("camera",),
            dtype="float64",
            unit="frame",
            missing="none",
            about="frame t shows the time t + clock_late of the cameras' mean clock; told apart "
            "from the cameras' places, unlike that of `triangulation`",
        ),
    ),
    labels={
        "joint": COCO17,
        "axis": ("x", "y"),
        "wave": ("cos2", "cos3", "sin2", "sin3"),
    },
    attributes={"camera": "camera ids in the order of the camera dimension"},
)
"""The detection dimension is the largest among the cameras; the order is that of `ingest` or
`detection`."""
