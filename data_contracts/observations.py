"""Detected people in one camera: keypoints, confidences, boxes."""

from __future__ import annotations

from data_contracts.arrays import ArrayLayout
from data_contracts.conventions import COCO17

OBSERVATION_LABELS: dict[str, tuple[str, ...]] = {
    "joint": COCO17,
    "axis": ("x", "y"),
    "corner": ("x0", "y0", "x1", "y1"),
}

FRAME = ArrayLayout(
    name="frame",
    dims=("frame",),
    dtype="int64",
    unit="frame",
    missing="none",
    about="match frame",
)

OBSERVATION_ARRAYS = (
    ArrayLayout(
        name="keypoints",
        dims=("frame", "detection", "joint", "axis"),
        dtype="float32",
        unit="px",
        missing="nan",
        about="detected 2D joints; a detection's place in its frame is its identity",
        chunk_dim="frame",
    ),
    ArrayLayout(
        name="confidence",
        dims=("frame", "detection", "joint"),
        dtype="float32",
        unit="1",
        missing="nan",
        about="the detector's confidence of each keypoint, in (0, 1]",
        chunk_dim="frame",
    ),
    ArrayLayout(
        name="boxes",
        dims=("frame", "detection", "corner"),
        dtype="float32",
        unit="px",
        missing="nan",
        about="bounding boxes",
        chunk_dim="frame",
    ),
    ArrayLayout(
        name="score",
        dims=("frame", "detection"),
        dtype="float32",
        unit="1",
        missing="nan",
        about="the detector's confidence of each person",
        chunk_dim="frame",
    ),
)
"""Arrays of the people one camera saw; the detection dimension is padded with missing values."""
