"""Whether people are of human size and speed and stand on a pitch, and cameras are cameras."""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np
from numpy.typing import NDArray

from worldpose.release.check_faults import Fault, point_faults
from worldpose.release.check_settings import CheckSettings
from worldpose.release.shipped import Finding, PointSource, View

Floats = NDArray[np.float64]

FEET = ("left_big_toe", "right_big_toe", "left_heel", "right_heel", "left_ankle", "right_ankle")
ANKLE = 0.09
"""Height of an ankle above the ground where a skeleton has no sole [m]."""
BONES = {
    "upper arms": ("shoulder", "elbow"),
    "forearms": ("elbow", "wrist"),
    "thighs": ("hip", "knee"),
    "shins": ("knee", "ankle"),
}


def plausible_share(source: PointSource, settings: CheckSettings) -> float:
    """Return which part of all bodies is near the ground, head up, within the bounds.

    A body counts from 0.3 to 2.3 m of height from its lowest foot to its nose, so that one who
    kneels counts and one in other units or axes does not; who lies does not either.
    """
    feet, nose = _feet(source), source.points[:, :, source.skeleton.index("nose")]
    here = np.isfinite(feet) & np.isfinite(nose).all(-1)
    if not here.any():
        return 0.0
    height, middle = (nose[..., 2] - feet)[here], nose[here]
    good = (height > 0.3) & (height < 2.3) & (np.abs(feet[here]) < 1.5)
    good &= (np.abs(middle[:, 0]) <= settings.bounds[0]) & (
        np.abs(middle[:, 1]) <= settings.bounds[1]
    )
    return float(good.mean())


def world_fault(source: PointSource, settings: CheckSettings) -> tuple[Fault | None, float, float]:
    """Return what would make people stand on a pitch, and the plausible share before and after."""
    before = plausible_share(source, settings)
    if before >= settings.plausible_share:
        return None, before, before
    best, most = None, before
    for fault in point_faults():
        points = None if fault.points is None else fault.points(source)
        if points is None:
            continue
        share = plausible_share(source.moved(points), settings)
        if share > most + 1e-9:
            best, most = fault, share
    return (best, before, most) if most >= settings.plausible_share else (None, before, before)


def ground_findings(source: PointSource, settings: CheckSettings) -> Iterator[Finding]:
    """Feet above or below the pitch, and for poses whether their pivot explains it."""
    feet = _feet(source)
    if not np.isfinite(feet).any():
        return
    height = float(np.nanmedian(feet))
    if settings.ground_low <= height <= settings.ground_high:
        return
    says = f"people's lower foot is {height:.2f} m from the ground in half of all frames"
    fault, left = "feet_off_the_ground", height
    if source.pivot is not None:
        moved = source.moved(source.points + source.pivot[:, :, None])
        left = float(np.nanmedian(_feet(moved)))
        if settings.ground_low <= left <= settings.ground_high and abs(left) < 0.5 * abs(height):
            fault = "root_about_origin"
            says += "; on the ground if global_orient turned about the model's origin"
    yield Finding(
        fault=fault,
        kind="plausibility" if fault == "feet_off_the_ground" else "convention",
        where=(source.name,),
        says=says,
        figures={"foot_height_m": height, "explained_height_m": left},
    )


def body_findings(source: PointSource, fps: float, settings: CheckSettings) -> Iterator[Finding]:
    """Limbs of no human length, people faster than people are, people off the pitch."""
    for name, (upper, lower) in BONES.items():
        ends = [
            [source.skeleton.index(f"{side}_{end}") for side in ("left", "right")]
            for end in (upper, lower)
        ]
        bone = np.linalg.norm(source.points[:, :, ends[0]] - source.points[:, :, ends[1]], axis=-1)
        seen = np.flatnonzero(np.isfinite(bone).any((0, 2)))
        lengths = np.array([np.nanmedian(bone[:, person]) for person in seen])
        low, high = settings.bones
        if (wrong := (lengths < low) | (lengths > high)).any():
            yield Finding(
                fault="limb_length",
                kind="plausibility",
                where=(source.name,),
                says=f"{name} of {int(wrong.sum())} people are not of human length",
                figures={"least_m": float(lengths.min()), "greatest_m": float(lengths.max())},
            )
    hips = source.points[:, :, [source.skeleton.index(f"{s}_hip") for s in ("left", "right")]]
    middle = hips.mean(2)
    speed = np.linalg.norm(np.diff(middle, axis=0), axis=-1) * fps
    speed = speed[np.isfinite(speed)]
    if len(speed) and (share := float((speed > settings.top_speed).mean())) > settings.fast_share:
        yield Finding(
            fault="speed",
            kind="plausibility",
            where=(source.name,),
            says=f"people move faster than {settings.top_speed:g} m/s",
            figures={"share_of_steps": share, "fastest_m_per_s": float(speed.max())},
        )
    here = np.isfinite(middle).all(-1)
    away = np.abs(middle[here][:, :2]) > np.array(settings.bounds)
    if len(away) and (share := float(away.any(-1).mean())) > 1.0 - settings.plausible_share:
        yield Finding(
            fault="off_the_pitch",
            kind="plausibility",
            where=(source.name,),
            says="people are far off the pitch",
            figures={"share_of_bodies": share},
        )


def camera_findings(view: View, settings: CheckSettings) -> Iterator[Finding]:
    """Rotations that are none, and a moving camera's centre that travels."""
    rotation, translation = view.rows.rotation, view.rows.translation
    known = np.isfinite(rotation).all((-1, -2)) & np.isfinite(translation).all(-1)
    rotation, translation = rotation[known], translation[known]
    if not len(rotation):
        return
    where = (f"cameras/{view.name}",)
    residual = float(np.abs(np.swapaxes(rotation, -1, -2) @ rotation - np.eye(3)).max())
    if residual > settings.orthonormal:
        yield Finding(
            fault="rotation_not_orthonormal",
            kind="damage",
            where=where,
            says="R is no rotation matrix",
            figures={"residual": residual},
        )
        return
    if (np.linalg.det(rotation) < 0.0).any():
        yield Finding(
            fault="mirrored_rotation",
            kind="convention",
            where=where,
            says="R mirrors: its determinant is -1",
        )
    center = -(np.swapaxes(rotation, -1, -2) @ translation[..., None])[..., 0]
    drift = float(np.linalg.norm(center - np.median(center, axis=0), axis=-1).max())
    if drift > settings.center_drift:
        yield Finding(
            fault="moving_center",
            kind="plausibility",
            where=where,
            says="the camera's centre -R't is not in one place",
            figures={"drift_m": drift},
        )


def _feet(source: PointSource) -> Floats:
    """Height (frames, persons) [m] of every body's lowest foot above z = 0."""
    soles = [name for name in FEET if name in source.skeleton]
    lift = 0.0
    if soles and all("ankle" in name for name in soles):
        lift = ANKLE
    elif any("heel" in name for name in soles):
        soles = [name for name in soles if "ankle" not in name]
    z = source.points[:, :, [source.skeleton.index(name) for name in soles], 2]
    lowest: Floats = np.where(np.isnan(z), np.inf, z).min(-1) - lift
    return np.where(np.isinf(lowest), np.nan, lowest)
