"""Epipolar curves of a keypoint, and its prediction from the other cameras (D4, D6).

They check a correction in one image against all: the curve contains the possible pixels of the
point in another camera, the prediction is its pixel if the other keypoints are correct.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Final

import numpy as np
from numpy.typing import ArrayLike, NDArray

from data_contracts.arrays import Floats
from worldpose.geometry import Camera, Rays, intersect_rays

HEIGHTS: Final = (-0.3, 3.2)
"""Range of joint heights above the ground [m]: the ground may be lower at its edges, and arms are
raised in a jump."""
DISTANCES: Final = (0.5, 300.0)
"""Range of distances of people from a camera [m]: across the largest stadium."""
BEGIN: Final = 33
"""Initial samples along a ray."""
APART: Final = 12.0
"""Maximum spacing of a curve's points [px]: arc and chord differ by less than a hundredth of a
pixel in a lens that bends a line by 10 px over 400."""
HALVINGS: Final = 8
"""Maximum number of subdivisions."""


@dataclass(frozen=True, eq=False)
class ViewCheck:
    """Multi-view consistency of one person's keypoints.

    Attributes:
        joints: (joints, 3) [m], world: triangulated from all views; NaN with fewer than two.
        expected: (cameras, joints, 2) [px]: prediction in each camera of the joint triangulated
            from the others; NaN with fewer than two others.
        error: (cameras, joints) [px]: from each keypoint to the joint from all views.
    """

    joints: Floats
    expected: Floats
    error: Floats


def epipolar_curves(source: Camera, target: Camera, pixel: ArrayLike) -> list[Floats]:
    """Return the epipolar curves in `target` of a pixel in `source`.

    The function projects the part of the pixel's ray where joints can be into the other image, with
    lens distortion, and clips it to the image.

    Args:
        source: one camera.
        target: another camera.
        pixel: (2,) in the image of `source` [px].

    Returns:
        Polylines (n, 2) [px] within the image of `target`; none if the ray is not visible.
    """
    rays = source.unproject(np.asarray(pixel, dtype=np.float64)[None])
    span = _span(rays)
    if span is None:
        return []
    origin, direction = rays.origins[0], rays.directions[0]

    def shown(along: Floats) -> Floats:
        return target.project(origin + along[:, None] * direction)

    along = np.linspace(*span, BEGIN)
    places = shown(along)
    for _ in range(HALVINGS):
        gap = np.linalg.norm(np.diff(places, axis=0), axis=1)
        inside = _inside(places, target)
        wide = np.flatnonzero((gap > APART) & (inside[1:] | inside[:-1]))
        # One end may be behind the camera, or outside the valid range of its lens model.
        cut = np.flatnonzero(np.isfinite(places[1:, 0]) != np.isfinite(places[:-1, 0]))
        halved = np.union1d(wide, cut)
        if not len(halved):
            break
        middle = (along[halved] + along[halved + 1]) / 2
        along = np.insert(along, halved + 1, middle)
        places = np.insert(places, halved + 1, shown(middle), axis=0)
    inside = _inside(places, target)
    bounds = np.flatnonzero(np.diff(np.concatenate([[False], inside, [False]]).astype(np.int8)))
    runs = [places[begin:end] for begin, end in zip(bounds[::2], bounds[1::2], strict=True)]
    return [run for run in runs if len(run) > 1]


def check_views(cameras: Camera, keypoints: ArrayLike) -> ViewCheck:
    """Return the multi-view consistency of one person in one frame.

    A joint is the nearest point to its rays, with weights from the size of a pixel at its distance.

    Args:
        cameras: a batch (cameras,).
        keypoints: (cameras, joints, 2) [px]; NaN where not seen.
    """
    places = np.asarray(keypoints, dtype=np.float64)
    rays = cameras.unproject(places)
    count = len(places)
    joints = _joints(cameras, rays, np.ones((1, count)))[0]
    without = _joints(cameras, rays, 1.0 - np.eye(count))
    expected = cameras.project(without)
    error = np.linalg.norm(cameras.project(np.broadcast_to(joints, without.shape)) - places, axis=2)
    return ViewCheck(joints, expected, error)


def _joints(cameras: Camera, rays: Rays, chosen: Floats) -> Floats:
    """Return joints (choices, joints, 3) [m] from the cameras of each choice (choices, cameras)."""
    bundles = Rays(
        origins=np.broadcast_to(rays.origins, rays.directions.shape).swapaxes(0, 1),
        directions=rays.directions.swapaxes(0, 1),
        status=rays.status.swapaxes(0, 1),
    )
    share = np.broadcast_to(chosen[:, None, :], (len(chosen), *bundles.status.shape))
    many = Rays(
        origins=np.broadcast_to(bundles.origins, (*share.shape, 3)),
        directions=np.broadcast_to(bundles.directions, (*share.shape, 3)),
        status=np.broadcast_to(bundles.status, share.shape),
    )
    near, _ = intersect_rays(many, share)
    distance = np.linalg.norm(near[..., None, :] - cameras.center, axis=-1)
    with np.errstate(divide="ignore", invalid="ignore"):
        weight = share * (cameras.focal.mean(axis=-1) / distance) ** 2
    return intersect_rays(many, np.nan_to_num(weight, posinf=0.0))[0]


def _span(rays: Rays) -> tuple[float, float] | None:
    """Return the interval of possible joints along the ray [m]; None if empty."""
    if not rays.valid[0]:
        return None
    height, slope = float(rays.origins[0, 2]), float(rays.directions[0, 2])
    low, high = HEIGHTS
    if abs(slope) < 1e-9:
        return DISTANCES if low <= height <= high else None
    ends = sorted(((low - height) / slope, (high - height) / slope))
    span = max(ends[0], DISTANCES[0]), min(ends[1], DISTANCES[1])
    return span if span[0] < span[1] else None


def _inside(places: Floats, camera: Camera) -> NDArray[np.bool_]:
    with np.errstate(invalid="ignore"):
        inside = (places >= -0.5) & (places <= camera.image_size - 0.5)
    return np.asarray(inside.all(axis=1), dtype=np.bool_)
