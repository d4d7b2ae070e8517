"""Task of stage `camera_consistency`: finds a clip's static cameras that contradict the others."""

from __future__ import annotations

from pathlib import Path

import numpy as np

from data_contracts.camera_consistency import CAMERA_CONSISTENCY
from tasks.clip_inputs import ClipInputs, camera_rates, open_clip, open_venue
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
    if doubt := _doubt_calibration(inputs, clip, found):
        result.warnings.append(doubt)
    rates = camera_rates(inputs)
    faults = describe_faults(found, names, sources["offset_frames"], rates, clip.fps)
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


def _doubt_calibration(inputs: UnitInputs, clip: ClipInputs, found: Consistency) -> str:
    """Return a warning of a calibration that people of most cameras, or stills, contradict."""
    names, folder = clip.camera_ids, Path(inputs.work.folder)
    alone, shares = "", {}
    if found.strangers:
        alone = (
            f"the people of {len(found.strangers)} of {len(names)} cameras "
            f"({', '.join(names[c] for c in found.strangers)}) fit those of no other camera"
        )
    stills = inputs.sources.get("stills", {})
    for name in (name for name in names if name in stills):
        camera, file = clip.cameras[names.index(name)], folder / stills[name]["still"]
        width, height = camera.image_size.tolist()
        picture = read_still(file, (width, height))
        require_registered(file, stills[name]["still_sha256"])
        assert inputs.pitch is not None  # stills are listed on a pitch alone
        if (share := paint_share(picture, camera, inputs.pitch)) is not None:
            shares[name] = share
    off = [name for name, share in shares.items() if share < 0.45]
    unpainted = 2 * len(off) > len(shares)
    fits = f"{np.mean([shares[n] for n in off] or [0.0]):.0%} of the markings lie on paint in the "
    fits += f"stills of {', '.join(off)}, as by chance"
    if alone and unpainted:
        raise InputError(
            "calibration.toml",
            expected="the cameras of this match",
            found=f"others: {fits}, and {alone}",
            todo="Is it the calibration of another match? Give that of this one, or click the "
            "markings.",
        )
    if off and not alone:
        whole = "is of another pitch than the stills" if unpainted else "contradicts stills"
        return f"the calibration (calibration.toml) {whole}: {fits}"
    clocks = "the calibration is of other cameras, the people found are wrong, or the clocks"
    return (
        f"{alone}: {clocks} differ by more than some frames (worldpose synchronize)"
        if alone
        else ""
    )
