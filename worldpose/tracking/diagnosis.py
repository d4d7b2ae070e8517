"""Diagnosis of a clip without tracked people, from its detections and cameras.

In two correctly calibrated cameras, two detections of one person lie on each other's epipolar
lines. The residual is an angle relative to the person's apparent size, so it needs no unit of
length, no smallest angle between rays, and no gate.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from itertools import combinations
from typing import Final

import numpy as np
from numpy.typing import NDArray

from data_contracts.arrays import ClipArray, Flags, Floats, Integers
from data_contracts.conventions import OTHER_UNITS
from data_contracts.keypoints import KeypointDetections
from worldpose.geometry.cameras import Camera
from worldpose.ingest.clock import offset_change
from worldpose.tracking.epipolar import size_ratios
from worldpose.tracking.pair_births import CameraGates, CameraVisibility, judge_pairs
from worldpose.tracking.settings import TrackingSettings
from worldpose.tracking.vertical import find_vertical, name_axis

SAMPLES: Final = 24
"""Most frames in which detections are compared."""
WINDOW: Final = 400
"""Most frames that the diagnosis uses."""
MATCH: Final = np.dtype(
    [
        # Between the lines of the rays of one joint, up to a right one [rad].
        ("angle", np.float64),
        # Between those rays [m].
        ("distance", np.float64),
        # Limb lengths relative to an adult's [1]; NaN where unknown.
        ("size", np.float64),
        # The joints [m].
        ("joints", np.float64, (17, 3)),
        # Distance from the first camera [m].
        ("depth", np.float64),
    ]
)
"""Two detections that may show one person; medians over joints."""


@dataclass(frozen=True)
class NoPeople:
    """Cause of an empty result in one word; and in sentences the reason and what to do."""

    cause: str
    message: str


@dataclass(frozen=True)
class PairMatches:
    """Matches (matches,) of `MATCH` of two cameras' detections, of which so many are possible."""

    cameras: tuple[int, int]
    possible: int
    matches: NDArray[np.void]

    @property
    def count(self) -> int:
        """Number of matches."""
        return len(self.matches)

    @property
    def share(self) -> float:
        """Share of matches among the possible ones [1]."""
        return self.count / max(self.possible, 1)

    @property
    def agrees(self) -> bool:
        """Whether most detections have a partner, and enough of them."""
        return self.count >= 4 and self.share >= 0.5

    @property
    def angle(self) -> float:
        """Median angle between rays [rad]."""
        return float(np.median(self.matches["angle"]))


def match_pair(
    cameras: Camera, rays: Floats, pair: tuple[int, int], shift: int, least: int
) -> PairMatches:
    """Return the matches of two cameras' detections, the second's `shift` frames later.

    Rays (frames, cameras, detections, 17, 3) are unit vectors [world], NaN where not seen; both
    detections have `least` joints or more.
    """
    a, b = pair
    seen = np.asarray(np.isfinite(rays[..., 0]).any(axis=(-1, -2)))
    first = np.arange(max(0, -shift), min(len(rays), len(rays) - shift))
    first = first[seen[first, a] & seen[first + shift, b]]
    first = first[np.unique(np.linspace(0, len(first) - 1, SAMPLES).astype(int))[: len(first)]]
    origins, rows, possible = cameras.center, [], 0
    for frame in first.tolist():
        p, q = rays[frame, a], rays[frame + shift, b]
        p, q = p[np.isfinite(p[..., 0]).any(-1)], q[np.isfinite(q[..., 0]).any(-1)]
        possible += min(len(p), len(q))
        rows.append(_match_detections(origins[a], p, origins[b], q, least))
    return PairMatches(pair, possible, np.concatenate([np.empty(0, MATCH), *rows]))


def _match_detections(
    origin: Floats, p: Floats, other: Floats, q: Floats, least: int
) -> NDArray[np.void]:
    """Return the partners, by unit rays (n, 17, 3) and (m, 17, 3) of two cameras."""
    baseline = other - origin
    length = float(np.linalg.norm(baseline))
    if not length > 0.0:
        return np.empty(0, MATCH)
    axis = baseline / length
    off = np.maximum(
        _epipolar_angles(axis, p, q) / _joint_spreads(q)[None, :, None],
        _epipolar_angles(axis, q, p).swapaxes(0, 1) / _joint_spreads(p)[:, None, None],
    )
    known = np.isfinite(off)
    count = known.sum(axis=-1)
    mean = np.where(known, off, 0.0).sum(axis=-1) / np.maximum(count, 1)
    mean = np.where(count >= least, mean, np.inf)
    found = []
    # In spreads of a body's joints: 7 cm on an adult, whose joints have a spread of 0.5 m.
    for n, m in zip(*np.nonzero(mean <= 0.15), strict=True):
        if mean[n, m] <= mean[n].min() and mean[n, m] <= mean[:, m].min():
            row = _locate_match(origin, p[n], baseline, q[m])
            if row is not None:
                found.append(row)
    return np.array(found, MATCH)


def _epipolar_angles(axis: Floats, p: Floats, q: Floats) -> Floats:
    """Return the angles (n, m, 17) [rad] of rays q from the planes of rays p and the baseline."""
    normals = np.cross(axis, p)
    with np.errstate(invalid="ignore", divide="ignore"):
        normals /= np.linalg.norm(normals, axis=-1, keepdims=True)
    return np.asarray(np.abs((normals[:, None] * q[None]).sum(axis=-1)))


def _joint_spreads(rays: Floats) -> Floats:
    """Return root mean square angles (n,) of each detection's joints from their mean [rad].

    They are positive, also of joints that are all in one pixel.
    """
    middle = np.nanmean(rays, axis=1, keepdims=True)
    spread = np.sqrt(np.nanmean(((rays - middle) ** 2).sum(axis=-1), axis=1))
    return np.asarray(np.maximum(spread, 1e-9))


def _locate_match(
    origin: Floats, p: Floats, baseline: Floats, q: Floats
) -> tuple[float | Floats, ...] | None:
    """Return one match; None behind a camera."""
    cosine = (p * q).sum(axis=-1)
    sine = np.linalg.norm(np.cross(p, q), axis=-1)
    with np.errstate(invalid="ignore", divide="ignore"):
        along_p, along_q = p @ baseline, q @ baseline
        s = (along_p - cosine * along_q) / sine**2
        u = (cosine * along_p - along_q) / sine**2
    near, far = s[:, None] * p, baseline + u[:, None] * q
    joints = origin + 0.5 * (near + far)
    if not (np.nanmedian(s) > 0.0 and np.nanmedian(u) > 0.0):
        return None
    limbs = size_ratios(joints)
    size = float(np.nanmedian(limbs)) if np.isfinite(limbs).any() else math.nan
    angle = float(np.nanmedian(np.arctan2(sine, np.abs(cosine))))
    distance = float(np.nanmean(np.linalg.norm(near - far, axis=-1)))
    return angle, distance, size, joints, float(np.nanmedian(s))


def diagnose_no_people(
    cameras: Camera,
    camera_ids: Sequence[str],
    detections: KeypointDetections[ClipArray],
    fps: float,
    settings: TrackingSettings,
    *,
    pitch_size: tuple[float, float] | None = None,
    births: int = 0,
    rates: Floats | float = 1.0,
) -> NoPeople:
    """Return the reason why tracking found no person in the clip.

    Detections are (frames, cameras, detections), with a confidence of 0, less or NaN where not
    found. `pitch_size` is the length and width of the pitch around the origin [m], on which people
    stand at z = 0; None = they may be anywhere. `births` counts tracks that began and were dropped
    again; `rates` (cameras,) are frames of a camera's video per match frame.
    """
    ground = pitch_size is not None
    joints = _count_joints(detections)
    usable = joints >= settings.min_joints
    present = np.asarray(usable.any(axis=-1))
    counts = usable.sum(axis=(0, 2))
    detected = dict(zip(camera_ids, counts.tolist(), strict=True))
    if (empty := _explain_missing_detections(present, detected, joints, settings)) is not None:
        return empty
    frames = _common_window(present)
    rays = usable_rays(cameras, detections[frames], settings.min_joints)
    if (extent := float(np.ptp(cameras.center[counts > 0], axis=0).max())) < 1e-3:  # [m]
        together = " and ".join(name for name, count in detected.items() if count > 0)
        return NoPeople(
            "same_place",
            f"{together} are at the same place ({extent:.3g} m apart). Two cameras must stand "
            "apart; is one of them given twice?",
        )
    matches = [
        match_pair(cameras, rays, pair, 0, settings.min_joints)
        for pair in combinations(range(len(camera_ids)), 2)
        if present[:, pair].all(axis=1).any()
    ]
    matches.sort(key=lambda each: (each.agrees, each.count * each.share), reverse=True)
    best = matches[0]
    a, b = (camera_ids[n] for n in best.cameras)
    if best.agrees and not births and _all_pairs_have_rivals(cameras, rays, ground, settings):
        return NoPeople(
            "ambiguous_pairs",
            f"in no frame it is clear which person of {a} is which of {b}: two cameras at the "
            "height of people see all of them on one line. Add a camera, or mount one higher.",
        )
    # Cameras at nearly one position share few people if they look in different directions.
    some = [each for each in matches if (each.agrees if best.agrees else each.count)]
    if best.agrees or (some and max(each.angle for each in some) < settings.min_angle_rad):
        return _explain_limit(cameras, camera_ids, some, settings, pitch_size, births)
    if found := _explain_clock_offset(cameras, camera_ids, rates, rays, matches, fps, settings):
        return found
    if not _views_overlap(cameras, rays, ground, settings):
        return NoPeople(
            "one_camera_each",
            "no place where the people of one camera may be is in the image of another: every "
            "person is seen by one camera. Two cameras must show the same people.",
        )
    return NoPeople(
        "cameras_contradict",
        f"no two cameras agree on their people: of the best pair, {a} and {b}, {best.count} of "
        f"{best.possible} people in the images can be the same person. The calibration or the lens "
        "of a camera is wrong, files belong to other cameras, or the cameras show other people: "
        "compare each camera's projection of the scene with its image.",
    )


def _all_pairs_have_rivals(
    cameras: Camera, rays: Floats, ground: bool, settings: TrackingSettings
) -> bool:
    """Return whether two cameras' detections form people, but always in several likely ways."""
    visibility, gates, some = CameraVisibility(cameras), CameraGates(len(cameras.focal)), False
    for frame in np.unique(np.linspace(0, len(rays) - 1, SAMPLES).astype(int)):
        weights = np.isfinite(rays[frame, ..., 0]).astype(np.float64)
        pairs = judge_pairs(
            rays[frame], weights, visibility, gates, ground, settings, everything=weights
        )
        if pairs.unique.any():
            return False
        some |= len(pairs.unique) > 0
    return some


def _count_joints(detections: KeypointDetections[ClipArray]) -> Integers:
    """Return the number of joints of each detection (frames, cameras, detections)."""
    keypoints, confidence = detections.keypoints, detections.confidence
    rows = [
        np.count_nonzero((confidence[part] > 0.0) & np.isfinite(keypoints[part][..., 0]), axis=-1)
        for start in range(0, confidence.shape[0], WINDOW)
        for part in [slice(start, start + WINDOW)]
    ]
    return np.concatenate(rows) if rows else np.zeros(confidence.shape[:3], dtype=np.int64)


def _explain_missing_detections(
    present: Flags, detected: dict[str, int], joints: Integers, settings: TrackingSettings
) -> NoPeople | None:
    """Return the reason if detections cannot be compared at all, else None."""
    seeing = [name for name, count in detected.items() if count > 0]
    if not seeing and joints.any():
        return NoPeople(
            "too_few_keypoints",
            f"the most complete of {np.count_nonzero(joints)} people in the images shows "
            f"{joints.max()} joints, and {settings.min_joints} are needed (setting "
            "tracking.min_joints).",
        )
    if not seeing:
        return NoPeople(
            "no_detections",
            "no camera shows a person in this clip. Look at the videos, at the frames of the clip, "
            "and at who stands too far off the pitch.",
        )
    if len(seeing) == 1:
        counts = ", ".join(f"{name} {count}" for name, count in detected.items())
        return NoPeople(
            "one_camera", f"one camera alone shows people ({counts}). A person needs two."
        )
    if (np.count_nonzero(present, axis=1) >= 2).any():
        return None
    spans = ", ".join(
        f"{name} {frames[0]} to {frames[-1]}"
        for name, column in zip(detected, present.T, strict=True)
        if len(frames := np.flatnonzero(column))
    )
    return NoPeople(
        "never_together",
        "no two cameras show people in the same frame; frames of the clip with people: "
        f"{spans}. Look at the clock offsets of the cameras and at the frames of the clip.",
    )


def _common_window(present: Flags) -> slice:
    """Return up to `WINDOW` frames around the middle of those in which two cameras see people."""
    both = np.flatnonzero(np.count_nonzero(present, axis=1) >= 2)
    start = max(0, int(both[len(both) // 2]) - WINDOW // 2)
    return slice(start, min(len(present), start + WINDOW))


def usable_rays(cameras: Camera, detections: KeypointDetections, least: int) -> Floats:
    """Return unit rays (frames, cameras, detections, 17, 3) [world]; NaN where not usable."""
    image = np.asarray(detections.keypoints, dtype=np.float64)
    rays = cameras.unproject(image.reshape(*image.shape[:2], -1, 2)).directions
    rays = rays.reshape(*image.shape[:-1], 3).copy()
    rays[~(detections.confidence > 0.0)] = np.nan
    rays[np.count_nonzero(np.isfinite(rays[..., 0]), axis=-1) < least] = np.nan
    return rays


def _explain_limit(
    cameras: Camera,
    names: Sequence[str],
    agreeing: list[PairMatches],
    settings: TrackingSettings,
    pitch_size: tuple[float, float] | None,
    births: int,
) -> NoPeople:
    """Return the limit that rejects people seen by two cameras."""
    best = agreeing[0]
    a, b = (names[n] for n in best.cameras)
    apart = float(np.linalg.norm(np.subtract(*cameras.center[list(best.cameras)])))
    angle, distance, depth = (
        float(np.median(best.matches[name])) for name in ("angle", "distance", "depth")
    )
    middle = np.nanmean(best.matches["joints"], axis=1)
    x, y, height = np.median(middle, axis=0).tolist()
    outside = np.abs(middle[:, :2]) - 0.5 * np.array(pitch_size or (np.inf, np.inf))
    vertical = find_vertical(best.matches["joints"])
    known = best.matches["size"][np.isfinite(best.matches["size"])]
    size = float(np.median(known)) if len(known) else math.nan
    seen = f"{best.count} of {best.possible} people in the images of {a} and {b} match"
    if best.agrees:
        seen = f"{a} and {b} agree on their people ({best.count} of {best.possible})"
    widest, least = max(each.angle for each in agreeing), settings.min_angle_rad
    (small, large), (low, high) = settings.size_range, settings.body_heights_m
    limits = (
        (
            widest < least,
            "narrow_angle",
            f"both see them from nearly the same side, {math.degrees(angle):.2g} degrees apart, "
            f"and {math.degrees(least):.2g} are needed (setting tracking.min_angle_rad, {least:g} "
            f"rad): the cameras are {apart:.2f} m apart and people {depth:.0f} m away, so one "
            f"centimetre of error sideways is {0.01 / max(angle, 1e-9):.1f} m in depth. Add a "
            "camera that sees them from another side.",
        ),
        (
            math.isfinite(size) and not small <= size <= large,
            "wrong_size",
            f"these are {size:.3g} times as large as adults ({small:g} to {large:g} pass, setting "
            f"tracking.size_range): {_guess_unit(size)}. Positions of cameras are read as metres; "
            f"{a} and {b} are {apart:.4g} apart.",
        ),
        (
            vertical is not None and vertical.is_clear and not vertical.is_z,
            "not_upright",
            f"{'' if vertical is None else vertical.describe()}. Import the calibration again with "
            f"worldpose import --up {'' if vertical is None else name_axis(vertical.axis)}, which "
            "turns it to z up.",
        ),
        (
            pitch_size is not None and outside.max(axis=1).min() > settings.pitch_margin_m,
            "outside_pitch",
            f"they are {math.hypot(x, y):.0f} m from the centre spot, at x = {x:.0f}, y = {y:.0f}, "
            f"outside the pitch ({' x '.join(f'{side:g}' for side in pitch_size or ())} m). The "
            "world's origin is the centre spot: move it there, or write pitch: none.",
        ),
        (
            pitch_size is not None and not low <= height <= high,
            "wrong_height",
            f"the middle of their bodies is at a height of {height:.2f} m ({low:g} to {high:g} m "
            "pass, setting tracking.body_heights_m). On a pitch people stand at z = 0 and z points "
            "up: look at the calibration of the cameras, or write pitch: none.",
        ),
        (
            distance > settings.epipolar_gate_m,
            "rays_miss",
            f"the cameras disagree by {distance:.2f} m about where a joint is, and "
            f"{settings.epipolar_gate_m:g} m pass (setting tracking.epipolar_gate_m): their "
            "calibration is not exact enough.",
        ),
    )
    for exceeded, cause, reason in limits:
        if exceeded:
            return NoPeople(cause, f"{seen}, but {reason}")
    if births:
        return NoPeople(
            "too_short",
            f"{seen}, but nobody was seen for long enough: {births} people were followed for "
            f"moments only, and {settings.min_track_s:g} s are needed (setting "
            f"tracking.min_track_s). Frames in which fewer than {settings.birth_views} cameras see "
            "a person count less where it can be another one.",
        )
    return NoPeople(
        "limits_together",
        f"{seen}, and no limit alone refuses them ({math.degrees(widest):.2g} degrees between the "
        f"views, {distance:.2f} m of disagreement, {size:.2g} times an adult's size), but nobody "
        "passes all of them. Loosen the settings tracking.min_angle_rad, epipolar_gate_m or "
        "size_range.",
    )


def _guess_unit(size: float) -> str:
    """Return what translations that make people `size` times as large may be in."""
    off, unit = min((abs(math.log(size * m)), name) for name, m in OTHER_UNITS.items())
    return f"positions seem to be in {unit}" if off < 0.3 else "is the unit the metre?"


def _explain_clock_offset(
    cameras: Camera,
    names: Sequence[str],
    rates: Floats | float,
    rays: Floats,
    matched_pairs: list[PairMatches],
    fps: float,
    settings: TrackingSettings,
) -> NoPeople | None:
    """Return the clock offset at which two cameras agree that otherwise do not, or None."""
    reach = min(len(rays) // 2, round(4.0 * fps))
    found: list[tuple[float, int, PairMatches]] = []
    for now in sorted(matched_pairs, key=lambda each: each.possible, reverse=True)[:3]:
        for shift in range(-reach, reach + 1):
            then = match_pair(cameras, rays, now.cameras, shift, settings.min_joints)
            if then.agrees and then.share >= 2.0 * now.share:
                found.append((then.share, shift, then))
    if not found:
        return None
    # A person who stands still agrees at many offsets: report the middle of the best ones.
    near = sorted(n for share, n, _ in found if share >= 0.95 * max(each[0] for each in found))
    shift = near[len(near) // 2]
    share, _, then = next(each for each in found if each[1] == shift)
    a, b = (names[n] for n in then.cameras)
    now = next(each for each in matched_pairs if each.cameras == then.cameras)
    rate = np.broadcast_to(rates, len(names))[[*then.cameras]]
    to_a, to_b = offset_change(np.array([shift, -shift]), rate)
    return NoPeople(
        "clock",
        f"{a} and {b} agree on {100 * share:.0f} % of their people when {b} is taken {abs(shift)} "
        f"frames {'later' if shift > 0 else 'earlier'}, and on {100 * now.share:.0f} % as stated: "
        f"add {to_b:+.0f} to offset_frames of {b}, or {to_a:+.0f} to those of {a}.",
    )


def _views_overlap(cameras: Camera, rays: Floats, ground: bool, settings: TrackingSettings) -> bool:
    """Return whether people seen by one camera may be in the image of another."""
    centers, size = cameras.center, cameras.image_size
    middle = 0.5 * sum(settings.body_heights_m)
    for a in range(len(centers)):
        seen = rays[:, a][np.isfinite(rays[:, a, :, :, 0]).any(axis=-1)]
        if not len(seen):
            continue
        ray = np.nanmean(seen[:: max(1, len(seen) // 50)], axis=1)
        ranges = np.geomspace(1.0, 200.0, 30)[:, None]
        if ground:
            with np.errstate(divide="ignore", invalid="ignore"):
                ranges = ((middle - centers[a, 2]) / ray[:, 2])[None]
            ranges = np.where(ranges > 0.0, ranges, np.nan)
        places = centers[a] + ranges[..., None] * ray
        image = cameras.project(places.reshape(1, -1, 3))
        inside = np.asarray(((image >= 0.0) & (image <= size[:, None])).all(axis=-1))
        inside[a] = False
        if inside.any():
            return True
    return False
