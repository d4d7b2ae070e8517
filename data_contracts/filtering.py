"""Result of stage `filtering`: detections classified by the fitted bodies."""

from __future__ import annotations

from data_contracts.arrays import GroupLayout, array_layouts
from data_contracts.conventions import COCO17
from data_contracts.keypoints import FRAME
from data_contracts.tracking import PERSON

FILTERING = GroupLayout(
    stage="filtering",
    about="Detections compared with fitted bodies: keypoints that the next iteration leaves out, "
    "and systematic errors that it subtracts.",
    coordinates=(FRAME, PERSON),
    arrays=array_layouts(
        """
        rejected (*frame, camera, detection, joint) bool [1]:
            keypoints that the next iteration leaves out
        surprise (*frame, camera, detection, joint) float32 [1], missing nan:
            Mahalanobis distance of a keypoint to the body that it is compared with
        dropped (*frame, camera, detection) bool [1]:
            tracked boxes that fit no person: all their keypoints are rejected
        fits (*frame, camera, detection) int16 [1], missing -1:
            index of the person whose body a box fits, also if `tracking` assigned the box to
            another person or to none
        similarity (*frame, camera, detection) float32 [1], missing nan:
            mean cosine between the bones of a box and of the body that it is compared with
        shift (*frame, camera, detection, joint, axis) float32 [px], missing 0:
            systematic error of a keypoint, from the viewing direction of the body and the camera's
            clock offset; the next iteration subtracts it
        view_bias (joint, axis, wave) float64 [m]:
            the part of `shift` that depends on the camera's azimuth around the body
        clock_late (camera) float64 [frame]:
            clock offset: frame t shows the time t + clock_late of the cameras' mean clock;
            estimated together with camera positions, unlike that of `triangulation`
        """
    ),
    labels={"joint": COCO17, "axis": ("x", "y"), "wave": ("cos2", "cos3", "sin2", "sin3")},
    attributes={"camera": "camera ids in the order of the camera dimension"},
)
"""The detection dimension has the largest length among the cameras; the order is that of `ingest`
or `detection`."""
