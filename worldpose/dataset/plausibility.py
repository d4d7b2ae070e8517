"""Plausibility of body sizes, speeds, positions on the pitch, and cameras."""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np

from data_contracts.arrays import Floats
from data_contracts.release import Finding
from worldpose.dataset.contents import PointSource, View
from worldpose.dataset.faults import Fault, point_faults
from worldpose.dataset.settings import CheckSettings
from worldpose.formats.camera_file import CameraRows

FEET = ("left_big_toe", "right_big_toe", "left_heel", "right_heel", "left_ankle", "right_ankle")
ANKLE = 0.09
"""Height of an ankle above the ground if a skeleton has no sole [m]."""
BONES = {
    "upper arms": ("shoulder", "elbow"),
    "forearms": ("elbow", "wrist"),
    "thighs": ("hip", "knee"),
    "shins": ("knee", "ankle"),
}


def plausible_share(source: PointSource, settings: CheckSettings) -> float:
    """Return the share of bodies near the ground, head up, within the bounds.

    A body counts if its nose is 0.3 to 2.3 m above its lowest foot: this includes a kneeling person
    and excludes other units or axes, and also a lying person. If most bodies have a left-right
    swap, the share is zero.
    """
    feet, nose = _feet(source), _point(source, "nose")
    here = np.isfinite(feet) & np.isfinite(nose).all(-1)
    if not here.any() or _handedness(source) < 0.0:
        return 0.0
    height, middle = (nose[..., 2] - feet)[here], nose[here]
    good = (height > 0.3) & (height < 2.3) & (np.abs(feet[here]) < 1.5)
    good &= (np.abs(middle[:, :2]) <= np.array(settings.bounds)).all(-1)
    return float(good.mean())


def world_fault(source: PointSource, settings: CheckSettings) -> tuple[Fault | None, float, float]:
    """Return the fault whose repair places people on the pitch; plausible share before and after.

    Among equally good faults the one with feet nearest to the ground is returned, and among these
    the first.
    """
    before = plausible_share(source, settings)
    if before >= settings.plausible_share:
        return None, before, before
    best, most, nearest = None, before, np.inf
    for fault in point_faults():
        points = None if fault.points is None else fault.points(source)
        if points is None:
            continue
        moved = source.moved(points)
        share = plausible_share(moved, settings)
        height = abs(foot_height(moved))
        if share > most + 0.01 or (share >= most - 0.01 and height < nearest - 0.02):
            best, most, nearest = fault, share, height
    return (best, before, most) if most >= settings.plausible_share else (None, before, before)


def foot_height(source: PointSource) -> float:
    """Return the median height of people's lower foot above z = 0 [m]; NaN without people."""
    feet = _feet(source)
    return float(np.median(feet[np.isfinite(feet)])) if np.isfinite(feet).any() else np.nan


def ground_findings(source: PointSource, settings: CheckSettings) -> Iterator[Finding]:
    """Yield feet above or below the pitch, and for poses whether their pivot explains it."""
    height = foot_height(source)
    if np.isnan(height) or settings.ground_low <= height <= settings.ground_high:
        return
    says = f"people's lower foot is {height:.2f} m from the ground in half of all frames"
    fault, left = "feet_off_the_ground", height
    if source.pivot is not None:
        moved = source.moved(source.points + source.pivot[:, :, None])
        left = foot_height(moved)
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
    """Yield implausible limb lengths and speeds."""
    for name, (upper, lower) in BONES.items():
        bone = np.stack(
            [
                np.linalg.norm(
                    _point(source, f"{side}_{upper}") - _point(source, f"{side}_{lower}"), axis=-1
                )
                for side in ("left", "right")
            ],
            axis=-1,
        )
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
    middle = _hips(source)
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


def pitch_findings(source: PointSource, settings: CheckSettings) -> Iterator[Finding]:
    """Yield people off the pitch."""
    middle = _hips(source)
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
    """Yield invalid rotations, and a moving camera's centre that is not constant."""
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
    drift = float(np.linalg.norm(centers(view.rows) - center_of(view.rows), axis=-1).max())
    if drift > settings.center_drift:
        yield Finding(
            fault="moving_center",
            kind="plausibility",
            where=where,
            says="the camera's centre -R't is not in one place",
            figures={"drift_m": drift},
        )


def centers(rows: CameraRows) -> Floats:
    """Return the centres (n, 3) [m], world, of a camera's rows with a pose."""
    all_centers = -(np.swapaxes(rows.rotation, -1, -2) @ rows.translation[..., None])[..., 0]
    found: Floats = all_centers[np.isfinite(all_centers).all(-1)]
    return found


def center_of(rows: CameraRows) -> Floats:
    """Return the median centre (3,) [m], world; NaN for a camera without a pose."""
    found = centers(rows)
    return np.median(found, axis=0) if len(found) else np.full(3, np.nan)


def _point(source: PointSource, name: str) -> Floats:
    """Return one point of all people (frames, persons, 3) [m]."""
    return source.points[:, :, source.skeleton.index(name)]


def _hips(source: PointSource) -> Floats:
    """Return the mid-hip of all people (frames, persons, 3) [m]."""
    return 0.5 * (_point(source, "left_hip") + _point(source, "right_hip"))


def _handedness(source: PointSource) -> float:
    """Return 1 if most noses or toes point ahead, according to left and up; -1 if behind."""

    def middle(name: str) -> Floats:
        return 0.5 * (_point(source, f"left_{name}") + _point(source, f"right_{name}"))

    if "left_ear" in source.skeleton:
        left = _point(source, "left_ear") - _point(source, "right_ear")
        forward = _point(source, "nose") - middle("ear")
    else:
        left = _point(source, "left_hip") - _point(source, "right_hip")
        forward = middle("big_toe") - middle("ankle")
    ahead = (np.cross(left, middle("shoulder") - middle("hip")) * forward).sum(-1)
    ahead = ahead[np.isfinite(ahead)]
    return float(np.median(np.sign(ahead))) if len(ahead) else 0.0


def _feet(source: PointSource) -> Floats:
    """Return the height (frames, persons) [m] of every body's lowest foot above z = 0."""
    soles = [name for name in FEET if name in source.skeleton]
    lift = 0.0
    if soles and all("ankle" in name for name in soles):
        lift = ANKLE
    elif any("heel" in name for name in soles):
        soles = [name for name in soles if "ankle" not in name]
    z = source.points[:, :, [source.skeleton.index(name) for name in soles], 2]
    lowest: Floats = np.where(np.isnan(z), np.inf, z).min(-1) - lift
    return np.where(np.isinf(lowest), np.nan, lowest)
