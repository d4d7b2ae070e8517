"""Exchange of detections with external annotation tools.

Inputs and outputs: `AnnotatedPicture`s; COCO keypoints JSON, CVAT for images XML 1.1 or Label
Studio JSON; an annotator's changes, as corrections.
"""

from worldpose.formats.annotations.changes import Changes, changes_of
from worldpose.formats.annotations.formats import (
    FORMATS,
    Format,
    read_annotations,
    write_annotations,
)
from worldpose.formats.annotations.pictures import AnnotatedPerson, AnnotatedPicture

__all__ = [
    "FORMATS",
    "AnnotatedPerson",
    "AnnotatedPicture",
    "Changes",
    "Format",
    "changes_of",
    "read_annotations",
    "write_annotations",
]
