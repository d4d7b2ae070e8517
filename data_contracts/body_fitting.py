"""Result of stage `body_fitting`: body-model parameters, named as in the WorldPose release (X3)."""

from __future__ import annotations

from data_contracts.arrays import ArrayLayout, GroupLayout
from data_contracts.conventions import COCO17
from data_contracts.keypoints import FRAME, POINT_ATTRIBUTE
from data_contracts.tracking import PERSON
from data_contracts.triangulation import EXTRA_JOINTS


def _pose_array(name: str, length: str, unit: str, about: str) -> ArrayLayout:
    return ArrayLayout(
        name=name,
        dims=("frame", "person", length),
        dtype="float64",
        unit=unit,
        missing="nan",
        about=about,
        chunk_dim="frame",
    )


EXTRA_BODIES = (
    *EXTRA_JOINTS,
    ArrayLayout(
        name="extra_offsets",
        dims=("point", "segment_axis"),
        dtype="float64",
        unit="m",
        missing="none",
        about="offset from the body's point to the detector's, in the axes of the point's segment, "
        "the same for all persons",
    ),
)
"""Points besides COCO-17 of the bodies; absent where no detector gave any."""

BODY_FITTING = GroupLayout(
    stage="body_fitting",
    about="Shape, pose, orientation and translation of every person's body model.",
    coordinates=(FRAME, PERSON),
    arrays=(
        ArrayLayout(
            name="betas",
            dims=("person", "shape_component"),
            dtype="float64",
            unit="1",
            missing="nan",
            about="body shape; comparable only within one body model",
        ),
        ArrayLayout(
            name="betas_covariance",
            dims=("person", "shape_component", "shape_component_"),
            dtype="float64",
            unit="1",
            missing="nan",
            about="covariance of `betas`",
        ),
        _pose_array("global_orient", "rotation", "rad", "axis-angle of the pelvis, world"),
        _pose_array("body_pose", "rotation_23", "rad", "axis-angle of the 23 other joints"),
        _pose_array("transl", "coordinate", "m", "translation, world, added after rotation"),
        ArrayLayout(
            name="joints",
            dims=("frame", "person", "joint", "coordinate"),
            dtype="float64",
            unit="m",
            missing="nan",
            about="keypoints of the bodies, world",
            chunk_dim="frame",
        ),
        ArrayLayout(
            name="covariance",
            dims=("frame", "person", "joint", "coordinate", "coordinate_"),
            dtype="float64",
            unit="m^2",
            missing="nan",
            about="covariance of `joints`: from poses, the detector's offsets, individual offsets "
            "and the bias that all views share",
            chunk_dim="frame",
        ),
        ArrayLayout(
            name="filled",
            dims=("frame", "person"),
            dtype="bool",
            unit="1",
            missing="none",
            about="the frame has no joint of the person; the motion model filled the body",
            chunk_dim="frame",
        ),
        ArrayLayout(
            name="guided",
            dims=("frame", "person"),
            dtype="bool",
            unit="1",
            missing="none",
            about="a monocular estimate contributed to the body",
            chunk_dim="frame",
        ),
        ArrayLayout(
            name="joint_offsets",
            dims=("joint", "body_axis"),
            dtype="float64",
            unit="m",
            missing="none",
            about="offset from the body's joint to the detector's joint, the same for all persons",
        ),
        *EXTRA_BODIES,
    ),
    labels={
        "joint": COCO17,
        "coordinate": ("x", "y", "z"),
        "coordinate_": ("x", "y", "z"),
        "body_axis": ("forward", "left", "up"),
    },
    attributes={
        "body_model": "name and version of the body model, such as open-neutral/2",
        **POINT_ATTRIBUTE,
    },
    optional=(*(array.name for array in EXTRA_BODIES), *POINT_ATTRIBUTE),
)
