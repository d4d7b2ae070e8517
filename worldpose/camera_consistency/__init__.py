"""Detection and diagnosis of cameras that are inconsistent with the others."""

from worldpose.camera_consistency.consistency import check_consistency
from worldpose.camera_consistency.diagnosis import Consistency, Fault
from worldpose.camera_consistency.explanation import describe_faults, faulty_cameras
from worldpose.camera_consistency.settings import ConsistencySettings

__all__ = [
    "Consistency",
    "ConsistencySettings",
    "Fault",
    "check_consistency",
    "describe_faults",
    "faulty_cameras",
]
