"""Task of stage `camera_consistency`: finds a clip's static cameras that contradict the others."""

from __future__ import annotations

from pathlib import Path

import numpy as np

from data_contracts.camera_consistency import CAMERA_CONSISTENCY
from tasks.clip_inputs import ClipInputs, open_clip, open_venue
from tasks.unit import UnitInputs, require_registered, unit_task
from worldpose.camera_consistency.consistency import (
    check_consistency,
    describe_faults,
    faulty_cameras,
)
from worldpose.camera_consistency.diagnosis import Consistency
from worldpose.camera_consistency.settings import ConsistencySettings
from worldpose.errors import InputError
from worldpose.ingest.footage import read_still
from worldpose.static_calibration.paint_share import paint_share
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
    if found.strangers:
        result.warnings.append(_describe_strangers(inputs, clip, found))
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


def _describe_strangers(inputs: UnitInputs, clip: ClipInputs, found: Consistency) -> str:
    """Return a warning of cameras whose people fit those of no other camera.

    Raises:
        InputError: most stills contradict the calibration, too.
    """
    names, folder = clip.camera_ids, Path(inputs.work.folder)
    alone = (
        f"the people of {len(found.strangers)} of {len(names)} cameras "
        f"({', '.join(names[c] for c in found.strangers)}) fit those of no other camera"
    )
    shares = {}
    for name, still in inputs.sources.get("stills", {}).items():
        camera = clip.cameras[names.index(name)]
        width, height = camera.image_size.tolist()
        picture = read_still(folder / still["still"], (width, height))
        require_registered(folder / still["still"], still["still_sha256"])
        assert inputs.pitch is not None  # stills are listed on a pitch alone
        if (share := paint_share(picture, camera, inputs.pitch)) is not None:
            shares[name] = share
    off = [name for name, share in shares.items() if share < 0.45]
    if 2 * len(off) > len(shares):
        raise InputError(
            "calibration.toml",
            expected="the cameras of this match",
            found=f"others: they show {np.mean([shares[n] for n in off]):.0%} of the markings on "
            f"paint in the stills of {', '.join(off)}, as by chance, and {alone}",
            todo="Is it the calibration of another match? Give that of this one, or click the "
            "markings.",
        )
    return (
        f"{alone}: calibration.toml is that of other cameras, or the clocks differ by more than "
        "some frames (worldpose synchronize)"
    )
