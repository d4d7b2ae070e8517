"""Rendered scenes with labels of surface landmarks: their pixels, and which of them are visible.

A landmark is a vertex of the body under the clothes, as in `worldpose.body.keypoints`. It is
visible if the clothed surface next to it faces the camera, no nearer part of the person covers it,
and the person fills its pixel.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path
from typing import Final

import numpy as np
from numba import njit
from numpy.typing import NDArray
from scenes import SIZE, SceneKind, Shot, find_visible, label, render_scene, save
from scipy.spatial import cKDTree

from data_contracts.arrays import Floats
from worldpose.body.keypoints import VERTEX_OF_POINT, fold_keypoints
from worldpose.detection.landmark_net import POINTS
from worldpose.simulation.mannequins import Mannequin, open_mannequin
from worldpose.training.labels import LabelledPicture, read_labels, write_labels

CLEAR_M: Final = 0.02
"""A part of the body covers a landmark if it is nearer to the camera by more than this [m]."""
MIN_COSINE: Final = 0.15
"""Smallest cosine between the surface's normal and the direction to the camera at which the surface
is visible [1]: below it a pixel covers several centimetres of the surface."""


def render_landmarks(
    folder: Path, kind: SceneKind, scenes: int, *, views: int, frames: int
) -> Iterator[str]:
    """Write scenes as `scenes.render_set` does, each with landmarks.npz; yield a line for each.

    The file has `keypoints` (people, points, 2) [px] and `visible` (people, points) of the people
    of labels.json in order: 2 visible, 1 not, 0 behind the camera.
    """
    for seed in range(kind.first_seed, kind.first_seed + scenes):
        labels = folder / str(seed) / "labels.json"
        if not labels.exists():
            labels.parent.mkdir(parents=True, exist_ok=True)
            pictures, found = [], []
            for shot in render_scene(kind, seed, views=views, frames=frames):
                pictures.append(save(labels.parent, shot))
                found.append(label_landmarks(shot))
            np.savez_compressed(
                labels.with_name("landmarks.npz"),
                keypoints=np.concatenate([each.keypoints for each in found]).astype(np.float32),
                visible=np.concatenate([each.visible for each in found]),
            )
            write_labels(labels, pictures, SIZE)
        yield f"{folder.name}: scene {seed - kind.first_seed + 1} of {scenes}"


def read_landmarks(folder: Path) -> list[LabelledPicture]:
    """Return the images of all scenes of a folder with landmarks in place of joints."""
    pictures = []
    for labels in sorted(folder.glob("*/labels.json")):
        with np.load(labels.with_name("landmarks.npz")) as stored:
            keypoints, visible = stored["keypoints"].astype(np.float64), stored["visible"]
        first = 0
        for picture in read_labels(labels):
            own = slice(first, first + len(picture.boxes))
            pictures.append(replace(picture, keypoints=keypoints[own], visible=visible[own]))
            first = own.stop
    return pictures


def label_landmarks(shot: Shot) -> LabelledPicture:
    """Return the labels of a shot with landmarks in place of joints, without a path."""
    mannequin = open_mannequin()
    points = fold_keypoints(mannequin.body, POINTS)(shot.poses)
    persons = len(points)
    pixels = shot.camera.project(points.reshape(-1, 3)).reshape(persons, len(POINTS), 2)
    shown = find_visible(shot.rendered.person_ids, pixels) & _find_uncovered(shot, mannequin)
    visible = np.where(shown, 2, 1)
    visible[~np.isfinite(pixels).all(axis=-1)] = 0
    return label(Path(), shot.rendered, pixels, visible)


def _find_uncovered(shot: Shot, mannequin: Mannequin) -> NDArray[np.bool_]:
    """Return whether the clothed surface at a landmark is the person's nearest (persons, points).

    A landmark stands for the nearest drawn vertex of the clothed surface in the T-pose.
    """
    body = mannequin.body
    own = body.template[[VERTEX_OF_POINT[point] for point in POINTS]]
    _, place = cKDTree(body.template[mannequin.kept]).query(own)
    vertices = shot.surfaces.vertices.astype(np.float64)
    away = shot.camera.center - vertices[:, place]
    toward = away / np.linalg.norm(away, axis=-1, keepdims=True)
    facing = (toward * shot.surfaces.normals[:, place]).sum(axis=-1) > MIN_COSINE
    depth = shot.camera.cam_from_world.apply(vertices)[..., 2]
    pixels = shot.camera.project(vertices.reshape(-1, 3)).reshape(*vertices.shape[:2], 2)
    uncovered = np.zeros(facing.shape, dtype=np.bool_)
    for person in range(len(vertices)):
        if not np.isfinite(pixels[person]).all():
            continue
        tested = np.flatnonzero(facing[person])
        nearest = _nearest_depth(
            pixels[person, place[tested]], pixels[person], depth[person], mannequin.faces
        )
        uncovered[person, tested] = depth[person, place[tested]] < nearest + CLEAR_M
    return uncovered


@njit(nogil=True, error_model="numpy")
def _nearest_depth(at: Floats, pixels: Floats, depth: Floats, faces: NDArray[np.int32]) -> Floats:
    """Return the least depth of triangles over pixels (points,) [m]; infinite without any.

    Args:
        at: (points, 2) [px].
        pixels: (vertices, 2) [px].
        depth: (vertices,) [m].
        faces: (triangles, 3).
    """
    nearest = np.full(len(at), np.inf)
    for face in range(len(faces)):
        a, b, c = faces[face]
        ax, ay, bx, by = pixels[a, 0], pixels[a, 1], pixels[b, 0], pixels[b, 1]
        cx, cy = pixels[c, 0], pixels[c, 1]
        area = (bx - ax) * (cy - ay) - (by - ay) * (cx - ax)
        if abs(area) < 1e-9:
            continue
        for point in range(len(at)):
            x, y = at[point, 0], at[point, 1]
            # The share of a corner is that of the triangle of the point and the opposite edge.
            one = ((cx - bx) * (y - by) - (cy - by) * (x - bx)) / area
            two = ((ax - cx) * (y - cy) - (ay - cy) * (x - cx)) / area
            if one >= 0.0 and two >= 0.0 and one + two <= 1.0:
                here = one * depth[a] + two * depth[b] + (1.0 - one - two) * depth[c]
                nearest[point] = min(nearest[point], here)
    return nearest
