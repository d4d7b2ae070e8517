"""Fitted bodies as the FIFA skeletal tracking challenge has players: boxes and skeletons."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Final

import numpy as np
from numpy.typing import NDArray

from worldpose.body import BODY25, CHALLENGE15, BodyModel, BodyParameters, fold_keypoints
from worldpose.cameras import Camera

Floats = NDArray[np.float64]

_FRAMES: Final = 8
"""Frames whose surfaces are held at a time; 33 MB for 25 people."""


@dataclass(frozen=True, eq=False)
class ChallengeClip:
    """Players of one clip in the moving camera's picture, as the challenge gives them."""

    boxes: Floats
    """(frames, persons, 4) x0, y0, x1, y1 [px]; NaN when absent."""
    skel_2d: Floats
    """(frames, persons, 15 or 25, 2) [px]; NaN when absent."""
    skel_3d: Floats
    """(frames, persons, 15 or 25, 3) [m], camera axes, about the mid-hip; NaN when absent."""


@dataclass(frozen=True, eq=False)
class ChallengeTruth:
    """A clip of the challenge, and what its participants are to find."""

    clip: ChallengeClip
    persons: NDArray[np.int64]
    """(persons,) places in the poses that it was made from: those ever in the picture."""
    submission: Floats
    """(persons, frames, 15, 3) [m], world; NaN where there is no body."""


def challenge_truth(model: BodyModel, poses: BodyParameters, camera: Camera) -> ChallengeTruth:
    """Return what the moving camera shows of fitted bodies.

    A box holds the part of a body that is in the picture; whoever is out of the picture has
    neither box nor skeleton in that frame. Skeletons are BODY25 and go on beyond the picture's
    edges. `skel_3d` is what a single-view estimator would give at best: the skeleton turned into
    the camera's axes, with the mid-hip as origin.

    Args:
        model: the body that the parameters belong to.
        poses: (persons, frames).
        camera: (frames,); a frame with a NaN is one without a camera.
    """
    persons, frames = poses.batch_shape
    points = fold_keypoints(model, BODY25)
    joints = np.empty((frames, persons, len(BODY25), 3))
    boxes = np.empty((frames, persons, 4))
    for start in range(0, frames, _FRAMES):
        part = slice(start, min(start + _FRAMES, frames))
        some = poses[:, part]
        joints[part] = points(some).swapaxes(0, 1)
        boxes[part] = _boxes(camera[part], model.vertices(some).swapaxes(0, 1))
    seen = np.all(np.isfinite(boxes), axis=-1)[..., None, None]
    pixels = _project(camera, joints)
    turned = np.einsum("fab,fpjb->fpja", camera.cam_from_world.rotation, joints)
    relative = turned - turned[:, :, BODY25.index("mid_hip"), None]
    clip = ChallengeClip(boxes, np.where(seen, pixels, np.nan), np.where(seen, relative, np.nan))
    kept = np.flatnonzero(seen.any((0, 2, 3)))
    places = [BODY25.index(name) for name in CHALLENGE15]
    return ChallengeTruth(
        ChallengeClip(clip.boxes[:, kept], clip.skel_2d[:, kept], clip.skel_3d[:, kept]),
        kept,
        joints[:, kept][:, :, places].swapaxes(0, 1),
    )


def _project(camera: Camera, points: Floats) -> Floats:
    """Pixels (frames, persons, n, 2) of points (frames, persons, n, 3)."""
    frames, persons, count = points.shape[:3]
    return camera.project(points.reshape(frames, -1, 3)).reshape(frames, persons, count, 2)


def _boxes(camera: Camera, surface: Floats) -> Floats:
    """Boxes (frames, persons, 4) of points (frames, persons, n, 3), cut at the picture's edges."""
    pixels = _project(camera, surface)
    edge = camera.image_size[:, None, None] - 0.5
    missing = np.isnan(pixels).any(-1, keepdims=True)
    low = np.where(missing, np.inf, pixels).min(2)
    high = np.where(missing, -np.inf, pixels).max(2)
    low, high = np.maximum(low, -0.5), np.minimum(high, edge[:, 0])
    boxes = np.concatenate([low, high], axis=-1)
    boxes[~(low < high).all(-1)] = np.nan
    return boxes
