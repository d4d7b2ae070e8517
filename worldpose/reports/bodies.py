"""Rendering of fitted bodies over a camera's image."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import cv2
import numpy as np
import scipy.sparse
from matplotlib.colors import to_rgb
from numpy.typing import NDArray

from data_contracts.arrays import Flags, Floats, Image, Integers, Singles
from data_contracts.pitch import PitchSpec
from worldpose.body.model import BodyModel, BodyParameters
from worldpose.geometry.cameras import Camera
from worldpose.geometry.rasters import (
    NOBODY,
    Samples,
    Surface,
    draw_triangles,
    outline_surfaces,
    resolve,
)
from worldpose.geometry.rigid import unit
from worldpose.reports.drawing import WIDTH, draw_label, markings, person_color, picture_panels, png


@dataclass(frozen=True, eq=False)
class BodyTracks:
    """Bodies of all people in a clip's frames."""

    frames: Integers
    """(frames,) match frames."""
    person_ids: Integers
    """(persons,)."""
    poses: BodyParameters
    """A batch (frames, persons); NaN where a person is missing."""
    model: BodyModel
    """Body model of `poses`."""


def zoom_camera(camera: Camera, corner: Floats, scale: float, size: tuple[int, int]) -> Camera:
    """Return the camera of a part of a single camera's image, enlarged to a size [px].

    The corner is the top left of the part [px]; (-0.5, -0.5) is that of the image.
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
    faces: Integers,
    colors: Floats,
    *,
    opacity: float = 1.0,
) -> None:
    """Draw bodies over an image with a depth test.

    `canvas` (height, width, 3) RGB is changed in place. `bodies` (persons, vertices, 3) [m], world,
    are finite; `faces` (triangles, 3) are counter-clockwise seen from outside; `colors` (persons,
    3) are in 0..1. Below opacity 1, each body has an opaque rim.
    """
    height, width = canvas.shape[:2]
    surfaces = bodies.astype(np.float32)
    outlines = outline_surfaces(camera, surfaces)
    inside = [n for n in range(len(bodies)) if outlines.box(n, 1, width, height) is not None]
    if not inside:
        return
    samples = Samples.empty(0, 0, width, height)
    triangles = faces.astype(np.int32)
    ones = np.ones(faces.size, dtype=np.float32)
    vertices = (triangles.ravel(), np.repeat(np.arange(len(faces)), 3))
    corners = scipy.sparse.csr_array((ones, vertices), (bodies.shape[1], len(faces)))
    plain = np.zeros(len(faces), dtype=np.bool_), np.zeros((*bodies.shape[1:-1], 2), np.float32)
    for number in inside:
        shade = np.rint(255.0 * colors[number]).astype(np.uint8)
        surface = Surface(
            faces=triangles,
            backs=plain[0],
            texels=plain[1],
            textures=np.broadcast_to(shade, (2, 1, 1, 3)).copy(),
            opened=outlines.pixels[number],
            closed=outlines.pixels[number],
            light=_light(surfaces[number], triangles, corners, camera.center.astype(np.float32)),
        )
        draw_triangles(surface, np.zeros(4, dtype=np.float32), number, samples)
    painted = canvas.copy()
    owner = np.full((height, width), NOBODY, dtype=np.int16)
    resolve(samples.who, samples.color, painted, owner, np.zeros(len(bodies), dtype=np.int64))
    cv2.addWeighted(painted, opacity, canvas, 1.0 - opacity, 0.0, dst=canvas)
    if opacity < 1.0:
        rim = _rim(owner)
        canvas[rim] = np.rint(255.0 * colors[owner[rim]]).astype(np.uint8)


def _rim(owner: NDArray[np.int16]) -> Flags:
    """Return the mask (height, width) of body pixels next to background or another body."""
    around = np.pad(owner, 1, mode="edge")
    inner = around[1:-1, 1:-1]
    neighbours = (around[:-2, 1:-1], around[2:, 1:-1], around[1:-1, :-2], around[1:-1, 2:])
    differs = np.any([inner != other for other in neighbours], axis=0)
    return np.asarray(differs & (inner != NOBODY))


def _light(
    surface: Singles, faces: NDArray[np.int32], corners: scipy.sparse.csr_array, eye: Singles
) -> Singles:
    """Return the light at each vertex (vertices,); 1 = unchanged colour."""
    ambient, sunlit, from_camera = 0.45, 0.3, 0.25  # together 1, where a face meets both
    a, b, c = (surface[faces[:, k]] for k in range(3))
    normals = unit(corners @ np.cross(b - a, c - a))
    facing = np.einsum("vc,vc->v", normals, unit(eye - surface))
    # Direction to the light, world: high, from the main camera's side.
    to_sun = np.array([0.35, -0.45, 0.82], dtype=np.float32)
    sun = normals @ unit(to_sun)
    light = ambient + sunlit * np.maximum(sun, 0.0) + from_camera * np.maximum(facing, 0.0)
    return np.asarray(light, dtype=np.float32)


def plot_bodies(
    camera: Camera,
    title: str,
    surfaces: Floats,
    faces: Integers,
    person_ids: Sequence[int] | Integers,
    *,
    still: Image | None = None,
    pitch: PitchSpec | None = None,
) -> bytes:
    """Return a PNG of all bodies in one single camera: the part of the image with most people.

    Surfaces are (persons, vertices, 3) [m], world, NaN for missing people; faces (triangles, 3),
    counter-clockwise seen from outside. Without a still, RGB, the markings of the pitch are drawn.
    """
    pale = 0.35  # share of white in the colours of large bodies, to make shading visible [1]
    present = np.isfinite(surfaces[:, 0, 0])
    ids = np.asarray(person_ids)[present]
    bodies = surfaces[present]
    corner, side = crowded_part(camera, bodies)
    scale = WIDTH / side[0]
    near = zoom_camera(camera, corner, scale, (WIDTH, round(side[1] * scale)))
    canvas = _background(near, corner, scale, still, pitch)
    colors = np.array([to_rgb(person_color(int(person))) for person in ids]).reshape(-1, 3)
    paint_bodies(canvas, near, bodies, faces, pale + (1.0 - pale) * colors)

    height, width = canvas.shape[:2]
    figure, (axes,) = picture_panels([title], (-0.5, -0.5), (width, height), still=canvas)
    for person, body in zip(ids, bodies, strict=True):
        ((u, v),) = near.project(body[np.argmax(body[:, 2])][None]).tolist()
        if 0.0 <= u < width and 0.0 <= v < height:
            draw_label(axes, f"{person}", (u, v), (0, 8), person_color(int(person)))
    return png(figure)


def crowded_part(camera: Camera, bodies: Floats) -> tuple[Floats, Floats]:
    """Return corner and side lengths [px] of the part of an image that shows most people, whole.

    The camera is single; bodies are (persons, points, 3) [m], world.
    """
    image_share = 0.3  # least share of the image to show: players of 80 px are then 210 px tall
    size = np.asarray(camera.image_size, dtype=np.float64)
    middles = camera.project(bodies.mean(axis=1))
    inside: Flags = np.all((middles >= 0.0) & (middles < size), axis=-1)
    if not inside.any():
        return np.full(2, -0.5), size
    pixels, middles = camera.project(bodies[inside]), middles[inside]
    large = float(np.nanmax((np.nanmax(pixels, axis=1) - np.nanmin(pixels, axis=1)) / size))
    side = min(1.0, max(image_share, 1.2 * large)) * size
    apart = np.abs(middles[:, None] - middles)
    together: Flags = np.all(apart < 0.45 * side, axis=-1)
    around = middles[together[np.argmax(together.sum(axis=1))]].mean(axis=0)
    return np.clip(around - 0.5 * side, -0.5, size - 0.5 - side), side


def _background(
    camera: Camera, corner: Floats, scale: float, still: Image | None, pitch: PitchSpec | None
) -> Image:
    subpixel = 4  # fractional bits of pixel coordinates
    width, height = (int(n) for n in camera.image_size)
    if still is not None:
        # Pixel (x, y) of the part shows place (x + 0.5) / scale + corner of the still.
        offset = 0.5 / scale + corner
        part = np.array([[1.0 / scale, 0.0, offset[0]], [0.0, 1.0 / scale, offset[1]]])
        flags = cv2.INTER_CUBIC | cv2.WARP_INVERSE_MAP
        edge = cv2.BORDER_REPLICATE
        return np.asarray(
            cv2.warpAffine(still, part, (width, height), flags=flags, borderMode=edge), np.uint8
        )
    ground = (206, 217, 202)
    canvas: Image = np.full((height, width, 3), ground, dtype=np.uint8)
    for line in markings(pitch) if pitch is not None else ():
        pixels = camera.project(line)
        # Points far outside do not fit into 32 bits, and are not visible.
        near: Flags = np.all(np.abs(pixels) < 1e4, axis=-1)
        for start in np.flatnonzero(near[:-1] & near[1:]):
            a, b = np.rint(pixels[start : start + 2] * 2**subpixel).astype(int).tolist()
            cv2.line(canvas, a, b, (255, 255, 255), 3, cv2.LINE_AA, subpixel)
    return canvas
