"""Evaluation: how far a prediction is from the truth (definitions: docs/metrics.md).

Inputs: predicted and true `JointTracks` and `EvaluationSettings`.
Outputs: `data_contracts.evaluation.Evaluation` and one `PersonScore` per true person.
"""

from worldpose.evaluation.matching import match_frame
from worldpose.evaluation.metrics import PersonScore, evaluate_joints
from worldpose.evaluation.settings import EvaluationSettings

__all__ = ["EvaluationSettings", "PersonScore", "evaluate_joints", "match_frame"]
