"""Evidence about one person: joints with their information, lines of sight, standing ankles."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Final

import numpy as np
from numpy.typing import NDArray

from data_contracts.arrays import Floats
from data_contracts.conventions import COCO17, COCO17_SPREAD
from worldpose.body.model import BodyModel
from worldpose.body_fitting.point_equations import invert_symmetric
from worldpose.body_fitting.settings import BodyFittingSettings
from worldpose.geometry.rigid import cross

JOINT_SPREAD: Final = np.array(COCO17_SPREAD)

MIN_INFORMATION: Final = 1e-6
"""Added to singular information [1/m^2]: one line leaves a direction undetermined."""


def _basis() -> Floats:
    """Return offsets (17, 3, unknowns) by unknowns: forward, left and up of each joint or pair."""
    columns = []
    for joint, name in enumerate(COCO17):
        if name.startswith("right"):
            continue
        mirrored = COCO17.index(name.replace("left", "right"))
        # A joint that is its own mirror image lies in the middle plane.
        for axis in (0, 1, 2) if mirrored != joint else (0, 2):
            column = np.zeros((len(COCO17), 3))
            column[joint, axis] = 1.0
            column[mirrored, axis] = -1.0 if axis == 1 else 1.0
            columns.append(column)
    return np.stack(columns, axis=-1)


MIRRORED_OFFSETS: Final = _basis()
"""(17, 3, 26)"""


def body_axes(joints: Floats) -> Floats:
    """Return columns forward, left and up (..., 3, 3) of bodies whose joints are (..., 17, 3).

    Left follows hips and shoulders, up follows the trunk.
    """
    left = joints[..., 5, :] + joints[..., 11, :] - joints[..., 6, :] - joints[..., 12, :]
    up = joints[..., 5, :] + joints[..., 6, :] - joints[..., 11, :] - joints[..., 12, :]
    left = left / np.linalg.norm(left, axis=-1, keepdims=True)
    front = cross(left, up)
    front /= np.linalg.norm(front, axis=-1, keepdims=True)
    axes: Floats = np.stack([front, left, cross(front, left)], axis=-1)
    return axes


def perceived_joints(joints: Floats, offsets: Floats) -> Floats:
    """Return the detector's joints (frames, persons, 17, 3) of bodies' ones [m], world.

    Offsets (17, 3) [m] are from a body's joint to the detector's: forward, left, up.
    """
    moved: Floats = joints + np.einsum("fpab,jb->fpja", body_axes(joints), offsets)
    return moved


def random_covariance(covariance: Floats, common_bias: Floats) -> Floats:
    """Return the covariance of joints without most of the bias that the shared offsets model.

    It is (..., 17, 3, 3) [m^2], of triangulated joints or of bodies, and includes `common_bias`
    (17,) per axis [m].
    """
    random = covariance.astype(np.float64)
    for axis in range(3):
        random[..., axis, axis] -= modelled_variance(common_bias)
    return random


def modelled_variance(common_bias: Floats) -> Floats:
    """Return the variance per axis [m^2] that the shared offsets model, of a bias [m]."""
    return np.asarray(np.maximum(common_bias**2 - 0.01**2, 0.0))  # 1 cm per axis stays


@dataclass(frozen=True, eq=False)
class PersonEvidence:
    """Joints of one person with their information."""

    joints: Floats
    """(frames, 17, 3) [m]; NaN where unknown."""
    information: Floats
    """(frames, 17, 3, 3) [1/m^2], inverse covariance; 0 where unknown."""

    def add_points(
        self, joints: Floats, covariance: Floats, fps: float, settings: BodyFittingSettings
    ) -> PersonEvidence:
        """Return the evidence with points besides COCO-17 after it; arguments as of `of`.

        Joints are (frames, points, 3) [m], NaN where missing, covariance (frames, points, 3, 3).
        """
        own = self.of(joints, covariance, fps, settings)
        return PersonEvidence(
            np.concatenate([self.joints, own.joints], axis=1),
            np.concatenate([self.information, own.information], axis=1),
        )

    @property
    def known(self) -> NDArray[np.bool_]:
        """(frames, 17), joints with any information."""
        return np.asarray(self.information.any(axis=(-1, -2)))

    @classmethod
    def of(
        cls, joints: Floats, covariance: Floats, fps: float, settings: BodyFittingSettings
    ) -> PersonEvidence:
        """Return the evidence of joints whose errors last for `noise_time_s`.

        Joints are (frames, 17, 3) [m], world, or other points; their covariance (frames, 17, 3, 3)
        [m^2] is as triangulation states it.
        """
        seen = np.asarray(np.isfinite(joints).all(-1) & np.isfinite(covariance).all((-1, -2)))
        stated = np.where(seen[..., None, None], covariance, np.eye(3))
        spread = stated + settings.min_joint_std_m**2 * np.eye(3)
        # Correlated frames count as one observation.
        spread *= settings.repeated(fps)
        information = invert_symmetric(spread) * seen[..., None, None]
        return cls(np.where(seen[..., None], joints, np.nan), information)

    def add_rays(
        self, points: Floats, across: Floats, fps: float, settings: BodyFittingSettings
    ) -> PersonEvidence:
        """Return the evidence with lines of sight added.

        Points (frames, 17, 3) [m], world, are on the lines, NaN without; `across` (frames, 17, 3,
        3) [1] are projections across them, 0 without.
        """
        rows = np.flatnonzero(np.isfinite(points).all(-1).any(-1))
        if not len(rows):
            return self
        points, across = points[rows], across[rows]
        joints, information = self.joints.copy(), self.information.copy()
        seen = np.asarray(np.isfinite(points).all(-1))
        spread = (settings.ray_std_m * JOINT_SPREAD) ** 2 + settings.min_joint_std_m**2
        spread *= settings.repeated(fps)
        information[rows] += np.where(seen[..., None, None], across / spread[:, None, None], 0.0)
        # From the point on the line towards the known joint; a lone line has no force along
        # itself.
        away = np.where(np.isfinite(joints[rows]), joints[rows], points) - points
        weighted = self.information[rows] @ np.nan_to_num(away)[..., None]
        moved = np.linalg.solve(information[rows] + MIN_INFORMATION * np.eye(3), weighted)[..., 0]
        joints[rows] = np.where(seen[..., None], points + moved, joints[rows])
        return PersonEvidence(joints, information)


Ground = Callable[[Floats, Floats], Floats]
"""Height of the ground [m] at x and y [m], world."""

ANKLES: Final = (15, 16)
"""Ankles in COCO-17."""


@dataclass(frozen=True, eq=False)
class Contacts:
    """Standing feet of one person, and the height of a standing ankle."""

    standing: Floats
    """(frames, 2) 1 where an ankle stands, else 0."""
    slipping: Floats
    """(frames - 1, 2) 1 where it stands in this and the next frame."""
    height: Floats
    """(frames, 2) [m], world: a flat foot's ankle there, the minimum of any ankle."""

    def of(self, seen: NDArray[np.bool_]) -> Contacts:
        """Return the contacts of seen ankles (frames, 17); unseen ankles may stand or not."""
        ankles = seen[:, ANKLES]
        both = ankles[1:] & ankles[:-1]
        return Contacts(self.standing * ankles, self.slipping * both, self.height)


def find_contacts(
    joints: Floats,
    ankle_height: float,
    ground: Ground,
    fps: float,
    settings: BodyFittingSettings,
    starts: Sequence[int] = (),
) -> Contacts:
    """Return contacts of ankles that are low and slow for at least two frames.

    Joints (frames, 17, 3) [m], world, are of a fit, the ankle's height above the sole [m] of this
    person. `starts` are the first frames of the track's further intervals.
    """
    ankles = joints[:, ANKLES]
    height = ground(ankles[..., 0], ankles[..., 1]) + ankle_height
    if len(joints) < 2:
        return Contacts(np.zeros(height.shape), np.zeros((0, 2)), height)
    speed = np.linalg.norm(np.diff(ankles, axis=0), axis=-1) * fps
    low = ankles[..., 2] - height < settings.contact_height_m
    slipping = (speed < settings.contact_speed_m_s) & low[1:] & low[:-1]
    slipping[np.array(starts, dtype=np.int64) - 1] = False
    standing = np.zeros(low.shape, dtype=bool)
    standing[1:] |= slipping
    standing[:-1] |= slipping
    return Contacts(standing.astype(np.float64), slipping.astype(np.float64), height)


def ankle_height(model: BodyModel, betas: Floats) -> float:
    """Return the height of the ankles of an upright body above its soles [m]."""
    lowest = int(model.template[:, 1].argmin())
    sole = model.template[lowest, 1] + model.shape_directions[lowest, 1] @ betas
    joints = model.joint_template + model.joint_directions @ betas
    return float(joints[7:9, 1].mean() - sole)
