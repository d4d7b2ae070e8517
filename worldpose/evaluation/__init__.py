"""Evaluation: metrics of predictions against the truth (definitions: docs/reference/metrics.md).

Inputs: predicted and true `JointTracks` and cameras, the pitch, `EvaluationSettings`.
Outputs: `data_contracts.evaluation.Evaluation`, one `PersonScore` per true person and one
`CameraScore` per camera.
"""

from worldpose.evaluation.cameras import CameraScore, evaluate_cameras
from worldpose.evaluation.metrics import PersonScore, evaluate_joints
from worldpose.evaluation.settings import CameraErrorSettings, EvaluationSettings

__all__ = [
    "CameraErrorSettings",
    "CameraScore",
    "EvaluationSettings",
    "PersonScore",
    "evaluate_cameras",
    "evaluate_joints",
]
