"""Results of stages `triangulation` and `retriangulation`: 3D joints with covariance."""

from __future__ import annotations

from typing import Literal

from data_contracts.arrays import GroupLayout, array_layouts
from data_contracts.conventions import COCO17
from data_contracts.keypoints import FRAME, POINT_ATTRIBUTE
from data_contracts.records import Amount, Count, Frame, Name, Number, Record
from data_contracts.tracking import PERSON

EXCHANGED_PARTS = {
    "face": ("eye", "ear"),
    "arms": ("shoulder", "elbow", "wrist"),
    "legs": ("hip", "knee", "ankle"),
}
"""Parts of a body whose left and right sides a detector swaps together, and their joints."""


HEALTH_MEASURES = (
    *("misfit", "shift_px", "clock_frames", "unmatched", "missing", "brightness", "sharpness"),
)
"""Health of a camera: robust loss of its keypoints about the people whom all cameras place, 1 as
expected; shift of its view and clock offset as the people whom the others place show them; share
of its detections that no person has, of its frames without an image; brightness and contrast of
edges [0 to 255]."""


CLOCK_CHANGE = "clock_change_frames."
"""Metric of a camera whose clock changes within the clip."""


class CameraChange(Record):
    """A camera whose clock or view changes within a clip."""

    camera: Name
    kind: Literal["clock", "view"]
    frame: Frame | None
    """First match frame after a sudden change; None = gradual over the clip."""
    first_frame: Frame
    frame_count: Count
    """Of the clip."""
    shift_px: tuple[Number, Number] = (0.0, 0.0)
    """Displacement of the image at the principal point, by a turn of the camera [px]."""
    zoom: Number = 0.0
    """Growth of the image about the principal point [1]."""
    roll_rad: Number = 0.0
    late_frames: Number = 0.0
    """How much later its images are than before [frame]."""
    std: Amount | None
    """Standard deviation of the displacement [px] or of `late_frames`; None if unknown."""
    is_explained: bool = True
    """Whether this change explains its images."""
    is_left_out: bool = False
    """Whether its views within the clip are left out."""


EXTRA_JOINTS = array_layouts(
    """
    extra_joints (*frame, person, point, coordinate) float64 [m], missing nan:
        points besides COCO-17, world; attribute `point` names them
    extra_covariance (*frame, person, point, coordinate, coordinate_) float64 [m^2], missing nan:
        covariance of `extra_joints`, from the same errors as `covariance`
    """
)
"""Points besides COCO-17 in 3D; absent where no detector gave any."""
EXTRA_TRIANGULATION = (
    *EXTRA_JOINTS,
    *array_layouts(
        """
        extra_views (*frame, person, point) uint8 [1], missing 0:
            number of inlier cameras of `extra_joints`
        extra_common_bias (point) float64 [m]:
            as `common_bias`; `extra_covariance` contains it
        """
    ),
)
"""The same as triangulation gives them."""

_ARRAYS = array_layouts(
    """
    joints (*frame, person, joint, coordinate) float64 [m], missing nan:
        joints, world
    covariance (*frame, person, joint, coordinate, coordinate_) float64 [m^2], missing nan:
        covariance of `joints`: the detector's noise as the residuals show it, calibration,
        and the bias that all views share
    shared_covariance (*frame, person, coordinate, coordinate_) float64 [m^2], missing nan:
        the part of `covariance` that all joints of a person share: calibration moves the
        whole person
    common_bias (joint) float64 [m]:
        standard deviation per axis of the error that all views of a joint share;
        `covariance` contains it, and more where views miss the joint
    views (*frame, person, joint) uint8 [1], missing 0:
        number of inlier cameras
    spread (*frame, person, joint) float32 [rad], missing nan:
        widest angle between rays of inlier cameras, at most a right angle
    reprojection_error (*frame, person, joint) float32 [px], missing nan:
        root mean square over the inlier cameras
    inliers (*frame, camera, person, joint) bool [1]:
        this camera's observation is an inlier of the joint
    exchanged (*frame, camera, person, part) bool [1]:
        this camera's detection has left and right of this part swapped; joints and
        `inliers` are computed after correction
    offsets (*frame, camera, person, axis) float32 [px], missing 0:
        common image offset of the person in this camera, from calibration errors
    smoothed (*frame, person, joint, coordinate) float64 [m], missing nan:
        joints smoothed over the whole track, world
    smoothed_covariance (*frame, person, joint, coordinate, coordinate_) float64 [m^2], missing nan:
        covariance of `smoothed`, from the same errors as `covariance`; it grows inside gaps
    filled (*frame, person, joint) bool [1]:
        `smoothed` is present and `joints` is missing
    clock_late (camera) float64 [frame], missing nan:
        clock offset: frame t shows the time t + clock_late of the cameras' mean clock;
        missing without enough motion
    clock_error (camera) float64 [frame]:
        standard error of `clock_late`
    health (bin, camera, measure) float32 [1], missing nan:
        health of each camera over time; a measure whose name ends in a unit is in that
    health_frame (bin) int64 [frame]:
        first match frame of each bin
    """
)

TRIANGULATION = GroupLayout(
    stage="triangulation",
    about="3D joints of every person, with covariance and inlier views.",
    coordinates=(FRAME, PERSON),
    arrays=(*_ARRAYS, *EXTRA_TRIANGULATION),
    labels={
        "joint": COCO17,
        "part": tuple(EXCHANGED_PARTS),
        "axis": ("x", "y"),
        "measure": HEALTH_MEASURES,
        "coordinate": ("x", "y", "z"),
        "coordinate_": ("x", "y", "z"),
    },
    attributes={
        "camera": "camera ids in the order of the camera dimension",
        "changes": "cameras that change within the clip, each a CameraChange",
        **POINT_ATTRIBUTE,
    },
    optional=(*(array.name for array in EXTRA_TRIANGULATION), *POINT_ATTRIBUTE),
)

RETRIANGULATION = TRIANGULATION.model_copy(
    update={
        "stage": "retriangulation",
        "about": "3D joints of every person, triangulated again with the adjusted cameras.",
    }
)
