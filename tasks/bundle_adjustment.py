"""Task of stage `bundle_adjustment`: joint adjustment of a match's static cameras."""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np
import xarray as xr
from numpy.typing import NDArray

from data_contracts.arrays import Floats
from data_contracts.bundle_adjustment import BUNDLE_ADJUSTMENT
from tasks.clip_inputs import open_frames, open_venue, select_frames, triangulation_settings
from tasks.unit import UnitInputs, unit_task
from worldpose.bundle_adjustment.clip import Clicks, Clip
from worldpose.bundle_adjustment.estimate import adjust_cameras
from worldpose.bundle_adjustment.report import BundleAdjustment, adjustment_arrays
from worldpose.bundle_adjustment.settings import BundleAdjustmentSettings
from worldpose.errors import UsageError
from worldpose.pitch.template import PitchTemplate
from worldpose.review.identities import select_triangulated
from worldpose.static_calibration.settings import StaticCalibrationSettings
from worldpose.store.writer import ResultWriter


@unit_task
def bundle_adjustment(inputs: UnitInputs, result: ResultWriter) -> None:
    """Write the adjusted cameras and their outliers."""
    settings, spans = inputs.settings(BundleAdjustmentSettings), inputs.sources["clips"]
    clips = sorted(spans, key=lambda clip: spans[clip][0])
    placed = {clip: inputs.open(f"triangulation/{clip}") for clip in clips}
    frames = {clip: found["frame"].values for clip, found in placed.items()}
    triangulation = triangulation_settings(inputs, clips[0])
    stride = triangulation.stride(sum(count for _, count in spans.values()))
    _require_computed(settings, spans, frames, stride)
    opened = open_frames(inputs, frames)
    pitch = opened.raise_pitch(inputs.pitch)
    covariance = open_venue(inputs, opened.camera_ids).covariance
    known = [inputs.open(f"static_calibration/{camera}") for camera in opened.camera_ids]
    person, index, joints, views = _read_people(inputs, placed)
    clip = Clip(
        cameras=opened.cameras,
        covariance=np.where(np.isfinite(covariance), covariance, 0.0),  # 0 = a given camera
        clicks=tuple(_clicks(inputs, camera, pitch) for camera in opened.camera_ids),
        fps=float(inputs.sources["fps"]),
        detections=opened.detections[:].assign_people(index),
        joints=joints,
        views=views,
        triangulation=triangulation,
        pitch=pitch,
        on_lines=np.array([camera.attrs["origin"] == "lines" for camera in known]),
        names=tuple(opened.camera_ids),
    )
    adjusted = adjust_cameras(clip, settings)
    arrays, attributes = adjustment_arrays(adjusted, settings, person)
    attributes |= {"camera": inputs.sources["cameras"]}
    attributes["surface"] = None if opened.surface is None else opened.surface.tolist()
    result.write(BUNDLE_ADJUSTMENT, arrays=arrays, attributes=attributes)
    result.figures.update(_figures(adjusted, attributes["camera"]))


def _require_computed(
    settings: BundleAdjustmentSettings,
    spans: Mapping[str, tuple[int, int]],
    frames: Mapping[str, NDArray[np.int64]],
    stride: int,
) -> None:
    """Refuse chosen frames of clips that the first triangulation did not compute."""
    for clip, known in frames.items():
        start, count = spans[clip]
        inside = [frame for frame in settings.chosen_frames if 0 <= frame - start < count]
        between = np.setdiff1d(inside, known)
        if len(between):
            total = sum(count for _, count in spans.values())
            raise UsageError(
                "bundle_adjustment.chosen_frames",
                expected=f"frames of clip {clip} that the first triangulation computed: "
                f"{start}, {start + stride}, {start + 2 * stride} ...",
                found=f"{between[0]:.0f}",
                todo=f"Choose from these, or set triangulation.max_frames={total}.",
            )


def _read_people(
    inputs: UnitInputs, placed: Mapping[str, xr.Dataset]
) -> tuple[NDArray[np.int64], NDArray[np.int16], Floats, NDArray[np.int64]]:
    """Read tracks and joints in the frames of all clips that were triangulated first.

    Return ids (persons,), of which the same in two clips can be two people, and no code here
    identifies them; detections (frames, cameras, persons); joints (frames, persons, 17, 3) [m],
    world; and views (frames, persons, 17).
    """
    tracked = [
        select_triangulated(select_frames(inputs.open(f"tracking/{clip}"), found["frame"].values))
        for clip, found in placed.items()
    ]
    person = np.unique(np.concatenate([tracks["person"].values for tracks in tracked]))
    number = sum(found.sizes["frame"] for found in placed.values())
    index = np.full((number, len(inputs.sources["cameras"]), len(person)), -1, dtype=np.int16)
    joints = np.full((number, len(person), 17, 3), np.nan)
    views = np.zeros((number, len(person), 17), dtype=np.int64)
    last = 0
    for tracks, found in zip(tracked, placed.values(), strict=True):
        rows = np.arange(last, last := last + tracks.sizes["frame"])[:, None]
        columns = np.searchsorted(person, tracks["person"].values)
        index[rows, :, columns] = (
            tracks["detection_index"].transpose("frame", "person", "camera").values
        )
        joints[rows, columns] = found["joints"].values
        views[rows, columns] = found["views"].values
    return person, index, joints, views


def _clicks(inputs: UnitInputs, camera: str, pitch: PitchTemplate | None) -> Clicks:
    """Return the clicked points of a camera; none for a given one."""
    unit = f"static_calibration/{camera}"
    known = inputs.open(unit)
    if pitch is None or "point_pixel" not in known:
        return Clicks.none()
    names = tuple(str(name) for name in known["point"].values)
    places, pixels = pitch.positions(names), known["point_pixel"].values
    surprise = known["point_surprise"].fillna(np.inf).values
    noise = inputs.made_from(unit).settings(StaticCalibrationSettings).click_noise_px
    noise *= known.attrs["noise_scale"]
    return Clicks(names, places, pixels, known["point_inlier"].values, surprise, noise)


def _figures(adjusted: BundleAdjustment, camera_ids: list[str]) -> dict[str, float]:
    """Return metrics of the adjustment."""
    figures = {
        "cameras_changed": float(adjusted.accepted.sum()),
        "cameras_refused": float((~adjusted.accepted).sum()),
    }
    if adjusted.verdict.judges.any():
        figures |= {f"noise_{name}": value for name, value in vars(adjusted.noise).items()}
        figures["held_out_gain"] = adjusted.evidence.gain
        figures["held_out_significance"] = adjusted.evidence.significance
        figures["people_shift_m"] = adjusted.evidence.shift
    variance = np.diagonal(adjusted.clip.covariance, axis1=1, axis2=2)[:, :6]
    stated = np.sqrt(variance.reshape(-1, 2, 3).sum(axis=2))[:, ::-1]  # of center and axes
    for c in np.flatnonzero(adjusted.accepted):
        center, rotation, _ = adjusted.motion[c].tolist()
        figures[f"moved_center_m.{camera_ids[c]}"] = center
        figures[f"moved_rotation_deg.{camera_ids[c]}"] = float(np.degrees(rotation))
        if (stated[c] > 0.0).all():  # a given camera states none
            away = float((adjusted.motion[c, :2] / stated[c]).max())
            figures[f"moved_deviations.{camera_ids[c]}"] = away
    error = adjusted.verdict.error
    if np.isfinite(error).any():
        figures["held_out_error_before_px"] = float(np.nanmedian(error[:, 0]))
        figures["held_out_error_after_px"] = float(np.nanmedian(error[:, 1]))
        size = adjusted.clip.distance / adjusted.clip.cameras.focal.mean(axis=-1)  # of a pixel [m]
        figures["held_out_error_after_m"] = float(np.nanmedian(error[:, 1] * size))
    return figures
