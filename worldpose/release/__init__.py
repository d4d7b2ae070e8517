"""Release: results in the forms that other tools and people read.

Inputs: joints, cameras, observations and figures of a run, as plain arrays and records.
Outputs: the files of docs/formats.md, their readers, what `check` finds wrong with such files, one
HTML report; pictures are in `worldpose.release.*pictures`, which load matplotlib.
"""

from worldpose.release.archives import Member, read_archive, write_archive
from worldpose.release.camera_file import read_camera, write_moving_camera, write_static_camera
from worldpose.release.coco import coco_dataset, write_coco
from worldpose.release.files import whole_file
from worldpose.release.html_page import Picture, Section, Table
from worldpose.release.joints_file import JointTracks, read_joints, write_joints
from worldpose.release.report import CameraSummary, report_page
from worldpose.release.scene import Scene

__all__ = [
    "CameraSummary",
    "JointTracks",
    "Member",
    "Picture",
    "Scene",
    "Section",
    "Table",
    "coco_dataset",
    "read_archive",
    "read_camera",
    "read_joints",
    "report_page",
    "whole_file",
    "write_archive",
    "write_coco",
    "write_joints",
    "write_moving_camera",
    "write_static_camera",
]
