"""Agreement of two cameras on their people, independent of the unit of length.

In two correctly calibrated cameras, two detections of one person lie on each other's epipolar
lines. The residual is an angle relative to the person's apparent size, so it needs no unit of
length, no smallest angle between rays, and no gate.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Final

import numpy as np

from data_contracts.arrays import Floats
from worldpose.geometry import Camera
from worldpose.tracking.limbs import size_ratios

SAMPLES: Final = 24
"""Most frames in which detections are compared."""
TOLERANCE: Final = 0.15
"""Largest mean epipolar angle of two detections of one person, in spreads of a body's joints [1]:
7 cm on an adult, whose joints have a spread of 0.5 m."""
MIN_SHARE: Final = 0.5
"""Share of detections with a partner from which two cameras agree [1]."""
MIN_MATCHES: Final = 4
"""Least number of matches for a conclusion."""


@dataclass(frozen=True)
class PairMatches:
    """Matches of the detections of two cameras.

    Attributes:
        cameras: indices of the two.
        possible: largest possible number of matches.
        angle: (matches,) angle between the lines of the rays of one joint, up to a right one [rad].
        distance: (matches,) distance between those rays [m].
        size: (matches,) limb lengths relative to an adult's [1]; NaN where unknown.
        height: (matches,) mean height of the joints over z = 0 [m].
        depth: (matches,) distance from the first camera [m].
    """

    cameras: tuple[int, int]
    possible: int
    angle: Floats
    distance: Floats
    size: Floats
    height: Floats
    depth: Floats

    @property
    def share(self) -> float:
        """Share of matches among the possible ones [1]."""
        return len(self.angle) / max(self.possible, 1)

    @property
    def agrees(self) -> bool:
        """Whether most detections have a partner."""
        return len(self.angle) >= MIN_MATCHES and self.share >= MIN_SHARE


def match_pair(
    cameras: Camera, rays: Floats, pair: tuple[int, int], shift: int, least: int
) -> PairMatches:
    """Return the matches of two cameras' detections, the second's `shift` frames later.

    Args:
        cameras: batch (cameras,).
        rays: (frames, cameras, detections, 17, 3) unit rays [world]; NaN where not seen.
        pair: indices of the two cameras.
        shift: frames by which the second camera's detections are later.
        least: least number of joints in both detections.
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
    table = np.concatenate(rows) if rows else np.empty((0, 5))
    angle, distance, size, height, depth = table.T
    return PairMatches(pair, possible, angle, distance, size, height, depth)


def _match_detections(
    origin: Floats,
    p: Floats,
    other: Floats,
    q: Floats,
    least: int,
) -> Floats:
    """Return angle, distance, size, height and depth (matches, 5) of detections that are partners.

    Args:
        origin: (3,) [m], of the first camera.
        p: (n, 17, 3) unit rays of its detections.
        other: (3,) [m], of the second camera.
        q: (m, 17, 3) unit rays of its detections.
        least: least number of joints in both.
    """
    baseline = other - origin
    length = float(np.linalg.norm(baseline))
    if not length > 0.0:
        return np.empty((0, 5))
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
    for n, m in zip(*np.nonzero(mean <= TOLERANCE), strict=True):
        if mean[n, m] <= mean[n].min() and mean[n, m] <= mean[:, m].min():
            row = _locate_match(origin, p[n], baseline, q[m])
            if row is not None:
                found.append(row)
    return np.array(found).reshape(-1, 5)


def _epipolar_angles(axis: Floats, p: Floats, q: Floats) -> Floats:
    """Return the angles (n, m, 17) [rad] of rays q from the planes of rays p and the baseline."""
    normals = np.cross(axis, p)
    with np.errstate(invalid="ignore", divide="ignore"):
        normals /= np.linalg.norm(normals, axis=-1, keepdims=True)
    return np.asarray(np.abs((normals[:, None] * q[None]).sum(axis=-1)))


def _joint_spreads(rays: Floats) -> Floats:
    """Return root mean square angles (n,) of each detection's joints from their mean [rad]."""
    middle = np.nanmean(rays, axis=1, keepdims=True)
    return np.asarray(np.sqrt(np.nanmean(((rays - middle) ** 2).sum(axis=-1), axis=1)))


def _locate_match(
    origin: Floats,
    p: Floats,
    baseline: Floats,
    q: Floats,
) -> tuple[float, float, float, float, float] | None:
    """Return angle, distance, size, height and depth of one match; None behind a camera."""
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
    return (
        float(np.nanmedian(np.arctan2(sine, np.abs(cosine)))),
        float(np.nanmean(np.linalg.norm(near - far, axis=-1))),
        size,
        float(np.nanmean(joints[:, 2])),
        float(np.nanmedian(s)),
    )
