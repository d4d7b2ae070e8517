"""The world frame of calibrated cameras by the people in their views: unit, up axis and ground."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace
from functools import partial
from itertools import combinations
from pathlib import Path
from typing import Final, NamedTuple, TypeAlias

import numpy as np
from numpy.typing import NDArray

from data_contracts.arrays import Floats, Integers
from data_contracts.cameras import CameraCalibration
from data_contracts.conventions import UNITS
from data_contracts.keypoints import KeypointDetections
from worldpose.camera_consistency.consistency import select_busiest_frames
from worldpose.errors import InputError, UsageError
from worldpose.formats.calibration_forms import form_unit_m
from worldpose.geometry.cameras import Camera
from worldpose.geometry.rigid import Rigid, Similarity
from worldpose.tracking.diagnosis import match_pair, usable_rays
from worldpose.tracking.settings import TrackingSettings
from worldpose.tracking.tracker import track_people
from worldpose.tracking.vertical import (
    ALIGNED,
    Vertical,
    describe_turn,
    find_vertical,
    name_axis,
    snap_to_axis,
    turn_to_z,
)
from worldpose.triangulation.noise_model import PERSONAL, PROPORTIONS, STATURE
from worldpose.triangulation.reinterpretation import reinterpret_calibration

Found: TypeAlias = "tuple[People | None, bool]"
Placed: TypeAlias = tuple[dict[str, CameraCalibration], list[str]]
LEVEL: Final = float(np.cos(np.radians(10.0)))
"""Cosine of the steepest ground, and of the largest mean lean of people who walk [1]."""


def _mean_direction(vectors: Floats) -> Floats:
    """Return the unit vector (3,) of vectors (frames, persons, 3), the median of each axis."""
    known = vectors[np.isfinite(vectors).all(axis=-1)]
    middle = np.median(known / np.linalg.norm(known, axis=1, keepdims=True), axis=0)
    return np.asarray(middle / np.linalg.norm(middle))


class Walkers(NamedTuple):
    """People who stand and walk.

    Attributes:
        joints: (frames, persons, 17, 3) in any unit; NaN where missing.
        frames: (frames,) rows of the clip.
    """

    joints: Floats
    frames: Integers
    fps: float

    def statures(self) -> Floats:
        """Return the stature of each person (persons,) by limbs and trunk; NaN where unknown."""
        return np.array([self._stature(p) for p in range(self.joints.shape[1])])

    def _stature(self, person: int) -> float:
        found, weight = [], []
        for each in PROPORTIONS:
            # Detectors place hips and shoulders at various breadths.
            if each.spread > 0.06:
                continue
            lengths = []
            for ends in each.ends:
                first, second = (self.joints[:, person, list(end)].mean(axis=1) for end in ends)
                lengths.append(np.linalg.norm(first - second, axis=1))
            known = np.concatenate(lengths)
            known = known[np.isfinite(known)]
            if len(known):
                found.append(float(np.median(known)) / each.share)
                # A detector's label is not the joint's centre.
                offset = (0.024 / (each.share * STATURE[0])) ** 2 * each.offsets
                weight.append(1.0 / (each.spread**2 + PERSONAL**2 + offset))
        return float(np.average(found, weights=weight)) if found else np.nan

    def nose_ahead(self, up: Floats) -> float:
        """Return the share of poses with the nose ahead of the ears; NaN if too few have both.

        Ahead is right of the line from the right to the left shoulder and hip, seen from above.
        """
        fewest = 20  # poses
        j = self.joints
        ahead = np.cross(j[:, :, 5] - j[:, :, 6] + j[:, :, 11] - j[:, :, 12], up)
        nose = ((j[:, :, 0] - 0.5 * (j[:, :, 3] + j[:, :, 4])) * ahead).sum(axis=-1)
        known = nose[np.isfinite(nose)]
        return float((known > 0.0).mean()) if len(known) >= fewest else np.nan

    def orient(self, scale: float) -> tuple[Similarity, float, bool]:
        """Return the transform to the world on whose ground people walk.

        The second result is the deviation of its vertical [rad], the third whether standing feet
        determine it; else people are assumed upright.
        """
        joints = scale * self.joints
        shoulders, hips = joints[:, :, [5, 6]].mean(axis=2), joints[:, :, [11, 12]].mean(axis=2)
        ankles = joints[:, :, [15, 16]]
        trunk, legs = _mean_direction(shoulders - hips), _mean_direction(hips - ankles.mean(axis=2))
        lean = (trunk + legs) / np.linalg.norm(trunk + legs)
        # A person bent at the hips is not upright: trunk and legs then disagree.
        bent = float(np.arccos(np.clip(trunk @ legs, -1.0, 1.0)))
        # Mean lean of people who walk [rad].
        lean_std = float(np.hypot(0.07, 0.5 * bent))
        up = lean
        feet = self._standing_feet(ankles)
        for _ in range(5):
            spread = feet - (feet.mean(axis=0) if len(feet) else 0.0)
            off = spread @ up
            # 3 cm: a foot that rolls off lifts its ankle.
            weight = 1.0 / (0.03**2 + (off / 3.0) ** 2)
            level = np.eye(3) - np.outer(up, up)
            information = level @ (weight * spread.T) @ spread @ level + level / lean_std**2
            slope = level @ (spread.T @ (weight * off) + (up - lean) / lean_std**2)
            up = up - np.linalg.lstsq(information, slope, rcond=1e-9)[0]
            up = up / np.linalg.norm(up)
        values = np.linalg.eigvalsh(information)[1:]
        places = hips.reshape(-1, 3)[np.isfinite(hips.reshape(-1, 3)).all(axis=1)]
        middle = np.median(places, axis=0)
        lowest = ankles.reshape(-1, 3) @ up
        ground = np.median(feet @ up) if len(feet) else np.nanquantile(lowest, 0.05)
        # Height of a standing foot's ankle, by the stature.
        height = 0.045 * scale * float(np.nanmedian(self.statures()))
        origin = middle + (ground - height - middle @ up) * up
        level = (places - middle) @ (np.eye(3) - np.outer(up, up))
        x = np.linalg.svd(level, full_matrices=False)[2][0]
        x = x - (x @ up) * up
        x = x / np.linalg.norm(x)
        rotation = np.stack([x, np.cross(up, x), up])
        return (
            Similarity(np.array(scale), rotation, -rotation @ origin),
            float(1.0 / np.sqrt(values.min())),
            bool(values.min() > 2.0 / lean_std**2),
        )

    def _standing_feet(self, ankles: Floats) -> Floats:
        """Return the mean ankle (n, 3) [m] of each time that a foot stands."""
        time = self.frames / self.fps
        # The speed of an ankle is measured over 0.2 s.
        half = max(1, round(0.5 * 0.2 / float(np.median(np.diff(time)))))
        if len(time) <= 2 * half:
            return np.empty((0, 3))
        gap = (time[2 * half :] - time[: -2 * half])[:, None, None]
        moved = np.linalg.norm(ankles[2 * half :] - ankles[: -2 * half], axis=-1)
        # A foot with a slower ankle stands.
        still = np.nan_to_num(moved / gap, nan=np.inf) < 0.4
        found = []
        for person, side in np.ndindex(still.shape[1:]):
            rows = np.flatnonzero(still[:, person, side]) + half
            for part in np.split(rows, np.flatnonzero(np.diff(rows) > half) + 1):
                there = ankles[part, person, side]
                there = there[np.isfinite(there[:, 0])]
                if len(there):
                    found.append(there.mean(axis=0))
        return np.array(found).reshape(-1, 3)


class People(NamedTuple):
    """What people tell of the world of calibrated cameras.

    Attributes:
        statures: (persons,) stature of each [unit of the world].
        vertical: the axis along which they stand.
        up: (3,) unit vector that points up from the ground on which they walk.
        ground: a point (3,) of that ground [unit of the world]; NaN if unknown.
        on_feet: whether standing feet determine `up`.
        ahead: share of poses whose nose is ahead, by the sides of shoulders and hips; NaN if too
            few tell.
    """

    statures: Floats
    vertical: Vertical
    up: Floats
    ground: Floats
    on_feet: bool
    ahead: float

    @property
    def stature(self) -> float:
        """Median stature [unit of the world]."""
        return float(np.median(self.statures))

    def stand_along(self, axis: Floats, cameras: Camera) -> bool:
        """Return whether people stand along an axis (3,), and do not lie in a world with z up.

        People who lie do so in the images of cameras that stand; and they do not walk.
        """
        up = -cameras.cam_from_world.rotation[:, 1].mean(axis=0)
        return bool(up @ axis > up[2] or (self.on_feet and up[2] < 0.5))

    @classmethod
    def of(cls, joints: NDArray[np.floating], fps: float) -> People | None:
        """Return what joints (frames, persons, 17, 3) tell; None if no stature or axis is known."""
        seen = np.isfinite(joints[..., 0]).any(axis=-1).sum(axis=0)
        walkers = Walkers(
            joints[:, seen >= max(2, 0.2 * seen.max(initial=0))].astype(np.float64),
            np.arange(len(joints)),
            fps,
        )
        statures = walkers.statures()
        vertical = find_vertical(walkers.joints)
        statures = statures[np.isfinite(statures) & (statures > 0.0)]
        if vertical is None or not len(statures):
            return None
        scale = STATURE[0] / float(np.median(statures))
        legs = np.isfinite(walkers.joints[:, :, [11, 12, 15, 16], 0]).all(axis=-1)
        if not legs.any() or len(joints) < 2:
            nowhere = np.full(3, np.nan)
            return cls(statures, vertical, vertical.axis, nowhere, on_feet=False, ahead=np.nan)
        motion, _, on_feet = walkers.orient(scale)
        ground, up = -motion.rotation.T @ motion.translation / scale, motion.rotation[2]
        # Feet of people who lie are on no ground.
        on_feet = on_feet and bool(up @ vertical.axis > LEVEL)
        up = up if on_feet else vertical.axis
        return cls(statures, vertical, up, ground, on_feet, walkers.nose_ahead(up))


def find_people(cameras: Camera, detections: KeypointDetections, fps: float) -> Found:
    """Return what the people in the cameras' images tell of their world, whatever its unit.

    Detections are (frames, cameras, detections) in memory. `people` are None if they tell nothing,
    and `agree` is whether two cameras agree on their people.
    """
    longest, settings = 250, TrackingSettings()
    detections = detections[select_busiest_frames(detections.confidence, longest)]
    rays = usable_rays(cameras, detections, settings.min_joints)
    pairs = list(combinations(range(len(cameras.focal)), 2))
    some = pairs[:: -(-len(pairs) // 15)]
    matched = [match_pair(cameras, rays, pair, 0, settings.min_joints) for pair in some]
    agreeing = [m for m in matched if m.agrees]
    # Rays that are nearly parallel tell no size.
    wide = [m.matches["size"] for m in agreeing if m.angle >= settings.min_angle_rad]
    sizes = np.concatenate([np.empty(0), *wide])
    sizes = sizes[np.isfinite(sizes) & (sizes > 0.0)]
    if not len(sizes):
        return None, bool(agreeing)
    size = float(np.median(sizes))
    motion = Similarity(np.array(1.0 / size), np.eye(3), np.zeros(3))
    tracks = track_people(move_cameras(motion, cameras), detections, fps, settings)
    return People.of(size * tracks.joints, fps) if len(tracks.person) else None, True


def doubt_statures(statures: Floats) -> str:
    """Return a sentence if people's mean stature (persons,) [m] is no adults'; else an empty one.

    Means of adults are 1.55 to 1.85 m, within 6 cm over the root of their number; limbs tell
    stature within 2.5 cm.
    """
    mean, count = float(np.mean(statures)), len(statures)
    reach = 2.0 * float(np.hypot(0.025, 0.06 / np.sqrt(count)))
    if 1.55 - reach <= mean <= 1.85 + reach:
        return ""
    yards = UNITS["yd"][0] * mean
    said = f"if they are adults, lengths are {mean / STATURE[0]:.2f} times the true ones: check "
    said += "the unit of the calibration, or state its metres with --unit"
    if mean > 1.85 and yards < 1.85 + reach:
        said = f"it is {yards:.2f} m if the calibration is in yards: import it with --unit yd"
    return f"the mean stature of {count} people is {mean:.2f} m; {said}"


def doubt_sides(people: People) -> str:
    """Return a sentence if people's left and right are exchanged; else an empty one."""
    if not people.ahead < 0.1:  # also NaN
        return ""
    return (
        f"left and right are exchanged in all 2D poses, or all images are mirrored: in "
        f"{1.0 - people.ahead:.0%} of the poses the nose points backwards"
    )


def doubt_world(cameras: Camera, people: People, *, sizes: bool = True) -> list[str]:
    """Return sentences about a world in which people do not stand along z, or are no adults.

    Tracked people are in metres; `sizes` is whether lengths can be judged.
    """
    vertical, size = people.vertical, doubt_statures(people.statures) if sizes else ""
    said = [each for each in (size, doubt_sides(people)) if each]
    if vertical.is_clear and not vertical.is_z and people.stand_along(vertical.axis, cameras):
        said.insert(
            0,
            f"{vertical.describe()}. All 3D results lie or stand on their heads; import the "
            f"calibration again with worldpose import --up {name_axis(people.up)}",
        )
    return said


class StatedWorld(NamedTuple):
    """Unit [m] and unit vector (3,) up of a calibration's world by the user; None = unknown."""

    unit_m: float | None = None
    up: Floats | None = None


def read_stated_world(unit: str | None, up: str | None) -> StatedWorld:
    """Return what the options `--unit` and `--up` state; UsageError if that is no unit or axis."""
    axes = {f"{sign}{'xyz'[n]}": f"{sign}1" for sign in ("", "-") for n in range(3)}
    unit_m, axis = None, None
    try:
        if unit is not None:
            unit_m = UNITS[unit][0] if unit in UNITS else float(unit)
        if up in axes:
            axis = float(axes[up]) * np.eye(3)["xyz".index(up[-1])]
        elif up is not None:
            axis = np.array([float(word) for word in up.split(",")])
        length = 1.0 if axis is None else float(np.linalg.norm(axis))
        fits = (unit_m is None or 1e-6 <= unit_m <= 1e6) and 0.0 < length < np.inf
        if not fits or (axis is not None and len(axis) != 3):
            raise ValueError
    except ValueError:
        raise UsageError(
            "--unit and --up",
            expected=f"{', '.join(UNITS)}, or the metres of the unit, such as 0.08; and x, -x, y, "
            "-y, z, -z, or three numbers such as 0.1,-0.9,-0.4",
            found=f"{unit} and {up}",
            todo="State the unit of the calibration's positions, and the axis that points up.",
        ) from None
    return StatedWorld(unit_m, None if axis is None else axis / length)


def place_as_stated(unit: str | None, up: str | None) -> partial[Placed]:
    """Return `place_cameras` with what the options `--unit` and `--up` state (UsageError)."""
    return partial(place_cameras, stated=read_stated_world(unit, up))


def place_cameras(
    calibration: Path,
    cameras: Mapping[str, CameraCalibration],
    detections: Mapping[str, KeypointDetections],
    fps: float,
    stated: StatedWorld,
) -> Placed:
    """Return cameras in a world in metres with z up, and sentences about what was changed.

    What the user states holds. The rest follows from the people: their stature tells the unit, and
    the axis along which they stand, with the ground on which they walk, the vertical. A world that
    is turned has its ground at z = 0, and keeps its heading.

    The form of the calibration tells its unit. 2D poses are on a common clock; none = unknown.
    UsageError if no camera has the stated world; InputError if people have no size of people in any
    unit, or cameras without people are too far apart for metres.
    """
    if not cameras:
        if stated.unit_m is not None or stated.up is not None:
            of_what, todo = "a calibration, whose world they describe", "Add --calibration."
            raise UsageError("--unit and --up", expected=of_what, found="none", todo=todo)
        return {}, []
    batch = Camera.stack(
        [Camera.from_calibration(each, f"{calibration}: {name}") for name, each in cameras.items()]
    )
    people = None
    told = [f"warning: {it}" for n, c in enumerate(cameras) if (it := batch[n].describe_fold(c))]
    if len(cameras) > 1 and detections.keys() >= cameras.keys():
        stacked = KeypointDetections.stack([detections[name] for name in cameras])
        find = partial(find_people, detections=stacked, fps=fps)
        people, agree = find(batch)
        if people is None:
            cameras, said = reinterpret_calibration(
                calibration,
                cameras,
                stacked,
                lambda other: bool((p := find(other)[0]) and p.vertical.is_clear),
            )
            told += said
            batch = Camera.stack([Camera.from_calibration(each) for each in cameras.values()])
            people, agree = find(batch) if said else (None, agree)
        if not agree and np.isfinite(stacked.confidence).any():
            told.append(
                "warning: no person is consistent between two cameras; check that the calibration "
                "belongs to these cameras and that they did not move since"
            )
    scale, unit = _find_scale(calibration, batch, people, stated.unit_m)
    up, turned, doubt = _find_up(batch, people, stated.up)
    notes = [*told, doubt] if doubt else told
    if people is not None:
        doubts = doubt_statures(scale * people.statures), doubt_sides(people)
        notes += [f"warning: {each}" for each in doubts if each]
    if scale == 1.0 and not turned:
        return dict(cameras), [*([f"{calibration}: {unit}"] if unit else []), *notes]
    height = float(scale * people.ground @ up) if turned and people is not None else 0.0
    # The board of a calibration may lie on the ground, and tells it better than ankles.
    height = height if abs(height) > 0.15 else 0.0  # also of NaN
    turned += f"; people walk at {height:+.2f} m, which is z = 0 now" if height else ""
    done = "; ".join(each for each in (unit, turned) if each)
    motion = Similarity(np.array(scale), turn_to_z(up), np.array([0.0, 0.0, -height]))
    pose = move_cameras(motion, batch).cam_from_world
    poses = zip(pose.rotation.tolist(), pose.translation.tolist(), strict=True)
    placed = {
        name: camera.model_copy(
            update={"rotation": tuple(map(tuple, rotation)), "translation": tuple(translation)}
        )
        for (name, camera), (rotation, translation) in zip(cameras.items(), poses, strict=True)
    }
    return placed, [f"{calibration} is brought to metres with z up: {done}", *notes]


def move_cameras(motion: Similarity, cameras: Camera) -> Camera:
    """Return the cameras (cameras,) that see transformed points in the same pixels."""
    pose = cameras.cam_from_world
    rotation = pose.rotation @ motion.rotation.T
    translation = motion.scale * pose.translation - rotation @ motion.translation
    return replace(cameras, cam_from_world=Rigid(rotation, translation))


def _find_scale(
    calibration: Path, cameras: Camera, people: People | None, unit_m: float | None
) -> tuple[float, str]:
    """Return the metres per unit that cameras were read in, and what tells them."""
    # Of a camera from the middle of all: 200 m around a stadium, and half of a stereo pair.
    nearest_m, farthest_m = 0.02, 300.0
    names, read_as_m = dict(UNITS.values()), form_unit_m(calibration)
    tall, count = (0.0, 0) if people is None else (people.stature, len(people.statures))
    seen, stated = f"{count} people of {tall / read_as_m:.4g} units", unit_m is not None
    distance = float(np.linalg.norm(cameras.center - cameras.center.mean(axis=0), axis=1).max())
    low, high = 0.9, 2.6  # children, and measured badly
    if unit_m is not None:
        metres, fits = unit_m, not tall or 0.3 <= unit_m / read_as_m * tall <= 4.0
    elif low <= tall <= high:
        yards = UNITS["yd"][0] * tall
        # Nothing but their stature tells a camera's metres from its yards.
        other = f"; in yards (--unit yd) they have {yards:.2f} m" if 1.62 < yards < 1.75 else ""
        said = f"its unit is {names[read_as_m]}, by {count} people of {tall:.2f} m"
        return 1.0, said + (other if read_as_m == 1.0 else "")
    elif not tall and (len(cameras.center) == 1 or nearest_m <= distance <= farthest_m):
        return 1.0, (
            f"its unit is taken as {names[read_as_m]}, which no people confirm: cameras stand up "
            f"to {distance:.3g} m from their middle; --unit states another"
        )
    else:
        metres = min(names, key=lambda m: abs(np.log(m / read_as_m * (tall or 1e6) / STATURE[0])))
        fits = low <= metres / read_as_m * tall <= high
    name = names.get(metres, f"{metres:g} m")
    if not fits:
        far = f"a camera {distance / read_as_m:.3g} units from the middle of all, and no people"
        makes = f" People of {STATURE[0]} m make it {read_as_m * STATURE[0] / (tall or 1.0):.3g}."
        raise InputError(
            f"{calibration}: translation",
            expected=f"positions in {name if stated else names[read_as_m]}, and people of "
            f"{low:g} to {high:g} m",
            found=seen if tall else far,
            todo=f"Give the unit: --unit {' or '.join(UNITS)}, or its metres, as --unit 0.08."
            + (makes if tall else ""),
        )
    scale, by = metres / read_as_m, ", as stated" if stated else ""
    by += f", by {seen}, {metres / read_as_m * tall:.2f} m" if tall else ""
    return scale, f"its unit is {name}{by}" if tall or scale != 1.0 else ""


def _find_up(
    cameras: Camera, people: People | None, stated: Floats | None
) -> tuple[Floats, str, str]:
    """Return the unit vector that points up, what tells it (empty for z), and doubts about it."""
    z, doubt = np.array([0.0, 0.0, 1.0]), ""
    vertical = None if people is None or not people.vertical.is_clear else people.vertical
    if stated is not None:
        if vertical is not None and vertical.axis @ stated < ALIGNED:
            doubt = f"warning: {vertical.describe(f'{name_axis(stated)} as stated')}"
        same = stated @ z > 1.0 - 1e-12
        return stated, "" if same else f"up is {describe_turn(stated)}, as stated", doubt
    # Bodies lean, and ground slopes: both must tell that z is not up.
    if people is None or vertical is None or max(vertical.axis[2], people.up[2]) > LEVEL:
        return z, "", ""
    if not people.stand_along(vertical.axis, cameras) or (vertical.is_z and not people.on_feet):
        if not vertical.is_z:
            doubt = f"warning: {vertical.describe()}, but the cameras stand along z: if these "
            doubt += f"people do not lie, --up {name_axis(people.up)} turns the world"
        return z, "", doubt
    up = snap_to_axis(people.up)
    told = f"{vertical.share:.0%} of {vertical.poses} poses stand along it"
    return up, f"up is {describe_turn(up)}, by people: {told}", ""
