"""Task of stage `camera_consistency`: finds a clip's static cameras that contradict the others."""

from __future__ import annotations

import numpy as np

from data_contracts.camera_consistency import CAMERA_CONSISTENCY
from tasks.clip_inputs import open_clip, open_venue
from tasks.unit import UnitInputs, unit_task
from worldpose.camera_consistency.consistency import (
    check_consistency,
    describe_faults,
    faulty_cameras,
)
from worldpose.camera_consistency.settings import ConsistencySettings
from worldpose.store.writer import ResultWriter


@unit_task
def camera_consistency(inputs: UnitInputs, result: ResultWriter) -> None:
    """Write the consistency of the cameras, leaving out faulty ones."""
    sources, settings = inputs.sources, inputs.settings(ConsistencySettings)
    clip = open_clip(inputs)
    names = clip.camera_ids
    found = check_consistency(
        clip.cameras,
        open_venue(inputs, names).covariance,
        clip.detections,
        clip.fps,
        settings,
        ground=sources["ground"],
    )
    faults = describe_faults(found, names, sources["offset_frames"], clip.fps)
    wrong = faulty_cameras(found) if settings.leave_out else set()
    result.write(
        CAMERA_CONSISTENCY,
        arrays={"agreement": found.agreement.astype(np.float32)},
        attributes={
            "camera": list(names),
            "faults": [fault.model_dump(mode="json") for fault in faults],
            "left_out": sorted(names[c] for c in wrong),
            "confirmed": [names[c] for c in found.confirmed],
            "unconfirmed": [names[c] for c in found.unconfirmed],
        },
    )
    for place, fault in zip(found.faults, faults, strict=True):
        if place.camera in wrong:
            result.left_out[fault.camera] = fault.reason
        else:
            result.warnings.append(f"camera {fault.camera}: {fault.reason}")
    named = len(faulty_cameras(found))
    result.figures.update(
        cameras_wrong=float(named),
        contradictions=float(len(found.faults) - named),
        cameras_confirmed=float(len(found.confirmed)),
        cameras_unconfirmed=float(len(found.unconfirmed)),
    )
