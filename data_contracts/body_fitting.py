"""Result of stage `body_fitting`: body-model parameters, named as in the WorldPose release (X3)."""

from __future__ import annotations

from data_contracts.arrays import ArrayLayout, GroupLayout
from data_contracts.observations import FRAME
from data_contracts.tracking import PERSON


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


BODY_FITTING = GroupLayout(
    stage="body_fitting",
    about="Shape, pose, orientation and place of every person's body model.",
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
        _pose_array("global_orient", "rotation", "rad", "axis-angle of the pelvis, world"),
        _pose_array("body_pose", "rotation_23", "rad", "axis-angle of the 23 other joints"),
        _pose_array("transl", "coordinate", "m", "translation, world, added after rotation"),
    ),
    labels={"coordinate": ("x", "y", "z")},
    attributes={"body_model": "name and version of the body model, such as open-neutral/1"},
)
