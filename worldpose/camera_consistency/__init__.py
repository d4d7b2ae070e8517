"""Detection and diagnosis of cameras that are inconsistent with the others."""

from typing import TYPE_CHECKING

from worldpose.lazy_names import import_on_use

if TYPE_CHECKING:
    from worldpose.camera_consistency.consistency import (
        check_consistency,
        describe_faults,
        faulty_cameras,
    )
    from worldpose.camera_consistency.diagnosis import Consistency, Fault
    from worldpose.camera_consistency.settings import ConsistencySettings

__all__ = [
    "Consistency",
    "ConsistencySettings",
    "Fault",
    "check_consistency",
    "describe_faults",
    "faulty_cameras",
]

__getattr__ = import_on_use(
    __name__,
    {
        "worldpose.camera_consistency.consistency": (
            "check_consistency",
            "describe_faults",
            "faulty_cameras",
        ),
        "worldpose.camera_consistency.diagnosis": (
            "Consistency",
            "Fault",
        ),
        "worldpose.camera_consistency.settings": ("ConsistencySettings",),
    },
)
