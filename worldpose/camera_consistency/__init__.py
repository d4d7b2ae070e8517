"""Detection and diagnosis of cameras that are inconsistent with the others."""

from worldpose.camera_consistency.comparison import ConsistencySettings
from worldpose.camera_consistency.consistency import (
    check_consistency,
    describe_faults,
    faulty_cameras,
)
from worldpose.camera_consistency.diagnosis import Consistency, Fault

__all__ = [
    "Consistency",
    "ConsistencySettings",
    "Fault",
    "check_consistency",
    "describe_faults",
    "faulty_cameras",
]
