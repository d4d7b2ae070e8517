"""Evaluation: metrics of predictions against the truth (definitions: docs/reference/metrics.md).

Inputs: predicted and true `JointTracks` and cameras, the pitch, `EvaluationSettings`.
Outputs: `data_contracts.evaluation.Evaluation`, one `PersonScore` per true person and one
`CameraScore` per camera.
"""
