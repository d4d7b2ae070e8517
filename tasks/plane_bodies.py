"""Part of task `refitting`: bodies of a match without static cameras."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import xarray as xr

from data_contracts.arrays import Flags, Floats, Integers
from data_contracts.keypoints import KeypointDetections
from data_contracts.refitting import REFITTING
from data_contracts.work import Work
from tasks.body_fitting import find_same_body
from tasks.broadcast_tracking import BroadcastInputs, open_broadcast
from tasks.unit import figures_of, open_input, require_registered
from worldpose.body_fitting.body_fit import BodyFit
from worldpose.body_fitting.fit_quality import report_fit
from worldpose.body_fitting.monocular import read_monocular
from worldpose.body_fitting.plane_bodies import PlaneEvidence, fit_bodies_on_plane
from worldpose.broadcast_calibration.uncertainty import moving_from_arrays, static_covariance
from worldpose.geometry.cameras import Camera
from worldpose.pitch.template import PitchTemplate
from worldpose.static_calibration.ground_error import surface_motion
from worldpose.store.store import Store
from worldpose.store.writer import ResultWriter


def publish_plane_bodies(store: Store, work: Work, result: ResultWriter) -> None:
    """Fit and write the bodies of the clip's people that the broadcast camera alone films."""
    sources: dict[str, Any] = work.recipe.sources
    path = Path(work.folder) / sources["estimates"]
    estimates = read_monocular(path)
    require_registered(path, sources["estimates_sha256"])
    model = find_same_body(work)
    filmed = open_broadcast(store, work)
    tracked = open_input(store, work, f"broadcast_tracking/{work.recipe.unit}")
    evidence = _observe_people(filmed, tracked, work)
    bodies = fit_bodies_on_plane(model, evidence, estimates, filmed.pitch.height)
    persons = tracked["person"].values
    kept = np.array([reason is None for reason in bodies.missing], dtype=np.bool_)
    without = {
        str(person): reason
        for person, reason in zip(persons.tolist(), bodies.missing, strict=True)
        if reason is not None
    }
    fit = bodies.fit
    result.write(
        REFITTING,
        arrays={
            "betas": fit.betas[kept],
            "betas_covariance": fit.betas_covariance[kept],
            "global_orient": fit.parameters.global_orient[:, kept],
            "body_pose": fit.parameters.body_pose[:, kept],
            "transl": fit.parameters.transl[:, kept],
            "joints": fit.joints[:, kept],
            "covariance": fit.covariance[:, kept],
            "filled": fit.filled[:, kept],
            "guided": fit.guided[:, kept],
            "joint_offsets": fit.offsets,
            "recognised": np.asarray(bodies.views[:, kept].any(axis=-1)),
            "pooled": np.zeros(int(kept.sum()), dtype=np.bool_),
            "views": bodies.views[:, kept].astype(np.int16),
        },
        coordinates={"frame": tracked["frame"].values, "person": persons[kept]},
        attributes={"body_model": model.name, "without_body": without},
    )
    result.figures["without_body"] = float(len(without))
    _report(result, fit, evidence, kept, persons)
    if without:
        told = "; ".join(f"person {person}: {reason}" for person, reason in without.items())
        result.warnings.append(
            f"{work.recipe.name}: {len(without)} of {len(persons)} people have a place on the "
            f"pitch and no body. {told}. Check {sources['estimates']} there: its frame numbers "
            "count the images of the clip's own video, and boxes are pixels of its images."
        )


def _observe_people(filmed: BroadcastInputs, tracked: xr.Dataset, work: Work) -> PlaneEvidence:
    """Return the keypoints of tracked people, and their places with covariance."""
    sources: dict[str, Any] = work.recipe.sources
    seen = KeypointDetections.from_arrays(filmed.detections)
    index = tracked["detection_index"].values
    rows = np.arange(len(index))[:, None]
    found = index >= 0
    if seen.score.shape[1]:
        keypoints = np.where(found[..., None, None], seen.keypoints[rows, index], np.nan)
        confidence = np.where(found[..., None], seen.confidence[rows, index], np.nan)
    else:
        keypoints = np.full((*index.shape, 17, 2), np.nan)
        confidence = np.full((*index.shape, 17), np.nan)
    moving, uncertainty = moving_from_arrays(
        {str(name): array.values for name, array in filmed.camera.data_vars.items()}
    )
    place = tracked["ground"].values.astype(np.float64)
    return PlaneEvidence(
        camera=moving.camera,
        number=tracked["frame"].values + sources["offset_frames"],
        keypoints=keypoints.astype(np.float64),
        confidence=confidence.astype(np.float64),
        place=place,
        place_covariance=tracked["ground_covariance"].values.astype(np.float64),
        calibration=_calibration_covariance(
            moving.camera, static_covariance(moving, uncertainty), filmed.pitch, place
        ),
        fps=float(sources["fps"]),
    )


def _calibration_covariance(
    cameras: Camera, covariance: Floats, pitch: PitchTemplate, place: Floats
) -> Floats:
    """Return the covariance (frames, persons, 2, 2) [m^2] of places by the calibration alone.

    Args:
        cameras: batch (frames,).
        covariance: (frames, 12, 12) of each frame's camera.
        pitch: surface.
        place: (frames, persons, 2) [m].
    """
    out = np.zeros((*place.shape, 2))
    points = np.concatenate([place, pitch.height(place[..., 0], place[..., 1])[..., None]], axis=-1)
    for frame in range(len(place)):
        known = np.isfinite(place[frame, :, 0])
        if known.any() and np.isfinite(cameras.focal[frame]).all():
            motion = surface_motion(cameras[frame], pitch, points[frame, known])
            out[frame, known] = np.nan_to_num(motion @ covariance[frame] @ motion.swapaxes(1, 2))
    return out


def _report(
    result: ResultWriter,
    fit: BodyFit,
    evidence: PlaneEvidence,
    kept: Flags,
    persons: Integers,
) -> None:
    """Write the metrics of the bodies, named as those of triangulated people."""
    frames, count = evidence.place.shape[:2]
    own = np.broadcast_to(np.arange(count), (frames, 1, count))
    seen = KeypointDetections.from_keypoints(
        evidence.keypoints[:, None], evidence.confidence[:, None], own
    )
    report = report_fit(
        fit, np.full(fit.joints.shape, np.nan), evidence.fps, (evidence.camera[:, None], seen)
    )
    names = [f"person{person}" for person in persons]
    figures = figures_of(report, names)
    gone = {name for name, there in zip(names, kept, strict=True) if not there}
    result.figures |= {
        name: value for name, value in figures.items() if name.partition(".")[2] not in gone
    }
