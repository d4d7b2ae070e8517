"""Rasterizer for bodies over an image, with shading, depth test and opacity."""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Final

import cv2
import numpy as np
import scipy.sparse
from numpy.typing import NDArray

from data_contracts.arrays import Floats, Image, Singles
from worldpose.body import BodyModel, BodyParameters
from worldpose.geometry import Camera
from worldpose.geometry.outlines import outline_surfaces
from worldpose.geometry.rasters import NOBODY, Samples, draw_triangles, resolve

_SUN: Final = np.array([0.35, -0.45, 0.82], dtype=np.float32)
"""Direction to the light, world: high, from the main camera's side."""
_AMBIENT: Final = 0.45
_SUNLIT: Final = 0.3
_FACING: Final = 0.25
"""Shares of ambient light, sunlight and light from the camera."""


@dataclass(frozen=True, eq=False)
class BodyTracks:
    """Bodies of all people in the frames of a clip."""

    frames: NDArray[np.int64]
    """(frames,) match frames."""
    person_ids: NDArray[np.int64]
    """(persons,)."""
    poses: BodyParameters
    """A batch (frames, persons); NaN where a person is missing."""
    model: BodyModel
    """Body model of `poses`."""


def zoomed(camera: Camera, corner: Floats, scale: float, size: tuple[int, int]) -> Camera:
    """Return the camera of an enlarged part of another camera's image.

    Args:
        camera: the other camera, single.
        corner: top left of the part [px]; (-0.5, -0.5) is that of the image.
        scale: enlargement [1].
        size: width and height of the new image [px].
    """
    return replace(
        camera,
        focal=camera.focal * scale,
        principal_point=(camera.principal_point - corner) * scale - 0.5,
        image_size=np.array(size),
    )


def paint_bodies(
    canvas: Image,
    camera: Camera,
    bodies: Floats,
    faces: NDArray[np.int64],
    colors: Floats,
    *,
    opacity: float = 1.0,
) -> None:
    """Draw bodies over an image with a depth test.

    Args:
        canvas: (height, width, 3), RGB, modified in place.
        camera: the image's camera, single.
        bodies: (persons, vertices, 3) [m], world, finite.
        faces: (triangles, 3), counter-clockwise seen from outside.
        colors: (persons, 3) in 0..1.
        opacity: of the bodies; 1 is opaque. Below 1, each body has an opaque rim.
    """
    height, width = canvas.shape[:2]
    surfaces = bodies.astype(np.float32)
    outlines = outline_surfaces(camera, surfaces)
    inside = [n for n in range(len(bodies)) if outlines.box(n, 1, width, height) is not None]
    if not inside:
        return
    samples = Samples.empty(0, 0, width, height)
    triangles = faces.astype(np.int32)
    corners = _corners(triangles, bodies.shape[1])
    plain = np.zeros(len(faces), dtype=np.bool_), np.zeros((*bodies.shape[1:-1], 2), np.float32)
    for number in inside:
        shade = np.rint(255.0 * colors[number]).astype(np.uint8)
        draw_triangles(
            outlines.pixels[number],
            outlines.pixels[number],
            triangles,
            plain[0],
            plain[1],
            np.broadcast_to(shade, (2, 1, 1, 3)).copy(),
            _light(surfaces[number], triangles, corners, camera.center.astype(np.float32)),
            np.zeros(4, dtype=np.float32),
            number,
            samples.left,
            samples.top,
            samples.depth,
            samples.who,
            samples.color,
            samples.last,
        )
    painted = canvas.copy()
    owner = np.full((height, width), NOBODY, dtype=np.int16)
    resolve(samples.who, samples.color, painted, owner, np.zeros(len(bodies), dtype=np.int64))
    cv2.addWeighted(painted, opacity, canvas, 1.0 - opacity, 0.0, dst=canvas)
    if opacity < 1.0:
        rim = _rim(owner)
        canvas[rim] = np.rint(255.0 * colors[owner[rim]]).astype(np.uint8)


def _rim(owner: NDArray[np.int16]) -> NDArray[np.bool_]:
    """Return the mask (height, width) of body pixels next to background or another body."""
    around = np.pad(owner, 1, mode="edge")
    inner = around[1:-1, 1:-1]
    beside = (around[:-2, 1:-1], around[2:, 1:-1], around[1:-1, :-2], around[1:-1, 2:])
    differs = np.any([inner != other for other in beside], axis=0)
    return np.asarray(differs & (inner != NOBODY))


def _corners(faces: NDArray[np.int32], vertices: int) -> scipy.sparse.csr_array:
    """Return the vertex-triangle incidence matrix (vertices, triangles)."""
    number = np.repeat(np.arange(len(faces)), 3)
    ones = np.ones(faces.size, dtype=np.float32)
    return scipy.sparse.csr_array((ones, (faces.ravel(), number)), (vertices, len(faces)))


def _light(
    surface: Singles, faces: NDArray[np.int32], corners: scipy.sparse.csr_array, eye: Singles
) -> Singles:
    """Return the light at each vertex (vertices,); 1 = unchanged colour."""
    a, b, c = (surface[faces[:, k]] for k in range(3))
    normals = _unit(corners @ np.cross(b - a, c - a))
    facing = np.einsum("vc,vc->v", normals, _unit(eye - surface))
    sun = normals @ _unit(_SUN)
    light = _AMBIENT + _SUNLIT * np.maximum(sun, 0.0) + _FACING * np.maximum(facing, 0.0)
    return np.asarray(light, dtype=np.float32)


def _unit(vectors: Singles) -> Singles:
    """Return vectors (..., 3) normalized to length 1."""
    lengths = np.linalg.norm(vectors, axis=-1, keepdims=True)
    return np.asarray(vectors / np.maximum(lengths, np.float32(1e-12)), dtype=np.float32)
