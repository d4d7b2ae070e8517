"""Evaluation: metrics of predictions against the truth (definitions: docs/reference/metrics.md).

Inputs: predicted and true `JointTracks` and cameras, the pitch, `EvaluationSettings`.
Outputs: `data_contracts.evaluation.Evaluation`, one `PersonScore` per true person and one
`CameraScore` per camera.
"""

from typing import TYPE_CHECKING

from worldpose.lazy_names import import_on_use

if TYPE_CHECKING:
    from worldpose.evaluation.cameras import CameraErrorSettings, CameraScore, evaluate_cameras
    from worldpose.evaluation.matching import EvaluationSettings
    from worldpose.evaluation.metrics import PersonScore, evaluate_joints

__all__ = [
    "CameraErrorSettings",
    "CameraScore",
    "EvaluationSettings",
    "PersonScore",
    "evaluate_cameras",
    "evaluate_joints",
]

__getattr__ = import_on_use(
    __name__,
    {
        "worldpose.evaluation.cameras": (
            "CameraErrorSettings",
            "CameraScore",
            "evaluate_cameras",
        ),
        "worldpose.evaluation.matching": ("EvaluationSettings",),
        "worldpose.evaluation.metrics": (
            "PersonScore",
            "evaluate_joints",
        ),
    },
)
