"""Results of stages `body_fitting` and `refitting`, named as in the WorldPose release."""

from __future__ import annotations

from data_contracts.arrays import GroupLayout, array_layout, array_layouts
from data_contracts.conventions import COCO17
from data_contracts.keypoints import FRAME, POINT_ATTRIBUTE
from data_contracts.tracking import PERSON
from data_contracts.triangulation import EXTRA_JOINTS

EXTRA_BODIES = (
    *EXTRA_JOINTS,
    array_layout(
        "extra_offsets",
        "(point, segment_axis) float64 [m]",
        "offset from the body's point to the detector's, in the axes of the point's segment, "
        "the same for all persons",
    ),
)
"""Points besides COCO-17 of the bodies; absent where no detector gave any."""

_ARRAYS = array_layouts(
    """
    betas (person, shape_component) float64 [1], missing nan:
        body shape; comparable only within one body model
    betas_covariance (person, shape_component, shape_component_) float64 [1], missing nan:
        covariance of `betas`
    global_orient (*frame, person, rotation) float64 [rad], missing nan:
        axis-angle of the pelvis, world
    body_pose (*frame, person, rotation_23) float64 [rad], missing nan:
        axis-angle of the 23 other joints
    transl (*frame, person, coordinate) float64 [m], missing nan:
        translation, world, added after rotation
    joints (*frame, person, joint, coordinate) float64 [m], missing nan:
        keypoints of the bodies, world
    covariance (*frame, person, joint, coordinate, coordinate_) float64 [m^2], missing nan:
        covariance of `joints`: from poses, the detector's offsets, individual offsets and
        the bias that all views share
    filled (*frame, person) bool [1]:
        the frame has no joint of the person; the motion model filled the body
    guided (*frame, person) bool [1]:
        a monocular estimate contributed to the body
    joint_offsets (joint, body_axis) float64 [m]:
        offset from the body's joint to the detector's joint, the same for all persons
    """
)

BODY_FITTING = GroupLayout(
    stage="body_fitting",
    about="Shape, pose, orientation and translation of every person's body model.",
    coordinates=(FRAME, PERSON),
    arrays=(*_ARRAYS, *EXTRA_BODIES),
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

REFITTING = BODY_FITTING.model_copy(
    update={
        "stage": "refitting",
        "about": "Every person's body, fitted again with keypoints of the broadcast camera and "
        "shapes of other clips; or the bodies of people that the broadcast camera alone films.",
        "arrays": (
            *BODY_FITTING.arrays,
            *array_layouts(
                """
                recognised (*frame, person) bool [1]:
                    the broadcast camera contributed a view of the person
                pooled (person) bool [1]:
                    other clips contributed to the person's shape
                views (*frame, person, joint) int16 [1], missing 0:
                    1 where the broadcast camera shows the joint; only of people that no static
                    camera films
                """
            ),
        ),
        "optional": ("views", *BODY_FITTING.optional),
        "attributes": {
            **BODY_FITTING.attributes,
            "without_body": "people that no static camera films and who have no body: id to reason",
        },
    }
)
