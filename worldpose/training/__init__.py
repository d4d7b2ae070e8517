"""Training of the bundled nets on labelled frames, rendered or reviewed (D5).

Input: COCO keypoints data sets. Output: safetensors weights that `worldpose.detection` takes,
and metrics (AP50, PCK) before and after. Only the training of nets needs torch.
"""

from worldpose.training.labels import (
    LabelledPicture,
    PictureCache,
    read_labels,
    read_picture,
    read_yolo_labels,
    write_labels,
)
from worldpose.training.metrics import average_precision, calibration_error, correct_keypoints
from worldpose.training.settings import FineTuningSettings, TrainingSettings

__all__ = [
    "FineTuningSettings",
    "LabelledPicture",
    "PictureCache",
    "TrainingSettings",
    "average_precision",
    "calibration_error",
    "correct_keypoints",
    "read_labels",
    "read_picture",
    "read_yolo_labels",
    "write_labels",
]
