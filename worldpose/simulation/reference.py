"""Detections in random order with their persons, and the ground truth of a match folder."""

from __future__ import annotations

import json
from collections.abc import Callable, Mapping
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any, Final

import numpy as np
from numpy.typing import NDArray

from data_contracts.arrays import Flags, Floats, Integers
from data_contracts.keypoints import KeypointDetections
from data_contracts.pitch import PitchSpec
from worldpose.formats.archives import write_archive
from worldpose.formats.calibration_writer import write_calibration_toml
from worldpose.formats.joints_file import JointTracks, write_joints
from worldpose.formats.release_cameras import write_static_camera
from worldpose.geometry.cameras import Camera

CLIP_ID: Final = "clip"


@dataclass(frozen=True, eq=False)
class Report:
    """A camera's detections and the person of each.

    Attributes:
        observations: input of the factory.
        person: (frames, detections) int16 index into the truth's `person_ids`; -1 for false
            positives and padding.
        displaced: (frames, detections, 17), joints with gross errors.
    """

    observations: KeypointDetections
    person: NDArray[np.int16]
    displaced: Flags


def list_detections(
    keypoints: Floats,
    confidence: Floats,
    displaced: Flags,
    whose: Integers,
    box: Callable[[Integers, Floats, Flags], Floats],
    rng: np.random.Generator,
) -> Report:
    """Return the detections of bodies, in shuffled order.

    Of the bodies: `keypoints` (frames, bodies, 17, 2) [px], `confidence` (frames, bodies, 17), NaN
    where not found, `displaced` alike, gross errors, and `whose` (bodies,), their persons, -1 for
    none. `box` returns boxes (frames, detections, 4) [px] for the order (frames, detections) of the
    bodies, their keypoints, and which are found.
    """
    found: Flags = np.asarray(np.isfinite(confidence).any(axis=-1))
    order = np.argsort(np.where(found, rng.random(found.shape), np.inf), axis=1)
    order = order[:, : int(found.sum(axis=1).max(initial=0))]
    rows = np.arange(len(found))[:, None]
    found = found[rows, order]
    # Padding has neither keypoints nor box nor score.
    keypoints = np.where(found[..., None, None], keypoints[rows, order], np.nan)
    confidence = np.where(found[..., None], confidence[rows, order], np.nan)
    boxes = np.where(found[..., None], box(order, keypoints, found), np.nan)
    joints = np.maximum(np.isfinite(confidence).sum(axis=-1), 1)
    score = np.where(found, np.nansum(confidence, axis=-1) / joints, np.nan)
    observations = KeypointDetections(
        frame=np.arange(len(found), dtype=np.int64),
        keypoints=keypoints.astype(np.float32),
        confidence=confidence.astype(np.float32),
        boxes=boxes.astype(np.float32),
        score=score.astype(np.float32),
    )
    person = np.where(found, whose[order], -1).astype(np.int16)
    return Report(observations, person, displaced[rows, order] & found[..., None])


def write_reference(
    folder: Path,
    truth: JointTracks,
    defined: Floats | None,
    cameras: Mapping[str, Camera],
    reports: Mapping[str, Report],
    records: Mapping[str, object],
    pitch: PitchSpec | None,
) -> None:
    """Write the ground truth of a match.

    `defined` are the joints where the detector takes them to be; None without detections. `reports`
    are by camera or clip, `records` the content of JSON files by name.
    """
    write_joints(folder / "joints.npz", truth)
    if defined is not None:
        write_joints(folder / "defined_joints.npz", replace(truth, joints=defined))
    calibrations = {name: camera.to_calibration(name) for name, camera in cameras.items()}
    for name, calibration in calibrations.items():
        write_static_camera(folder / "cameras" / f"{name}.npz", calibration)
    write_calibration_toml(folder / "calibration.toml", calibrations)
    for name, report in reports.items():
        content: dict[str, NDArray[Any]] = {"frame": report.observations.frame}
        content |= {"person": report.person, "displaced": report.displaced.astype(np.uint8)}
        write_archive(folder / "identities" / f"{name}.npz", content)
    if pitch is not None:
        records = {"pitch": pitch.model_dump(mode="json"), **records}
    for name, record in records.items():
        text = json.dumps(record, indent=2) + "\n"
        (folder / f"{name}.json").write_text(text, encoding="utf-8")
