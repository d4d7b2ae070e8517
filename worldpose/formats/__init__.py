"""Exchange file formats, written from plain arrays and read back.

Joints, cameras, body poses, COCO keypoints, the FIFA skeletal tracking challenge, motion capture
(TRC, BVH); docs/reference/formats.md describes each of them.
"""

from typing import TYPE_CHECKING

from worldpose.lazy_names import import_on_use

if TYPE_CHECKING:
    from worldpose.formats.archives import Member, read_archive, write_archive
    from worldpose.formats.challenge import read_camera, write_moving_camera, write_static_camera
    from worldpose.formats.files import whole_file
    from worldpose.formats.joints_file import JointTracks, read_joints, write_joints
    from worldpose.formats.motion_capture import coco_dataset, write_coco

__all__ = [
    "JointTracks",
    "Member",
    "coco_dataset",
    "read_archive",
    "read_camera",
    "read_joints",
    "whole_file",
    "write_archive",
    "write_coco",
    "write_joints",
    "write_moving_camera",
    "write_static_camera",
]

__getattr__ = import_on_use(
    __name__,
    {
        "worldpose.formats.archives": (
            "Member",
            "read_archive",
            "write_archive",
        ),
        "worldpose.formats.challenge": (
            "read_camera",
            "write_moving_camera",
            "write_static_camera",
        ),
        "worldpose.formats.files": ("whole_file",),
        "worldpose.formats.joints_file": (
            "JointTracks",
            "read_joints",
            "write_joints",
        ),
        "worldpose.formats.motion_capture": (
            "coco_dataset",
            "write_coco",
        ),
    },
)
