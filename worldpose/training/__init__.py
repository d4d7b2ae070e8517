"""Training of the embedded nets on labelled frames, rendered or reviewed (D5).

Input: COCO keypoints data sets. Output: safetensors weights that `worldpose.detection.bundled`
takes, and metrics (AP50, PCK) before and after. Only the training of nets needs torch.
"""

from worldpose.training.average_precision import average_precision
from worldpose.training.keypoint_accuracy import calibration_error, correct_keypoints
from worldpose.training.labels import LabelledPicture, read_labels, write_labels
from worldpose.training.pictures import PictureCache, read_picture
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
    "write_labels",
]
