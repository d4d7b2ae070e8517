"""Projection of surfaces into an image, and a triangle rasterizer.

The z-buffer has four samples per pixel, spread over the exposure time.

Each sample has its own position within the pixel and its own moment while the shutter is open, so
one pass antialiases edges and blurs motion. Vertices are projected through the lens one by one;
between them edges are straight, over some centimetres.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from data_contracts.arrays import Flags, Floats, Image, Integers, Singles
from worldpose.compiled import compile_kernel
from worldpose.geometry.camera_model import project_point
from worldpose.geometry.cameras import Camera
from worldpose.geometry.lens_models import load_camera
from worldpose.geometry.rays import RayStatus

Box = tuple[int, int, int, int]
"""Left, top, right, bottom [px]; right and bottom lie outside."""

SAMPLES = 4
_DOWN = (-0.375, -0.125, 0.125, 0.375)
"""Positions of samples in a pixel [px]: on a rotated square, no two share a row or column."""
NOBODY = -1


class Samples(NamedTuple):
    """Samples of a part of an image.

    Attributes:
        left: column of the image that is the first one here [px].
        top: row of the image that is the first one here [px].
        depth: (height, width, 4) [m] along the camera's axis; infinite without a hit.
        who: (height, width, 4) number of the object hit; -1 without a hit.
        color: (height, width, 4, 3) RGB.
        last: (height, width, 4) number of the object drawn there last, visible or not.
    """

    left: int
    top: int
    depth: Singles
    who: NDArray[np.int16]
    color: Image
    last: NDArray[np.int16]

    @classmethod
    def empty(cls, left: int, top: int, right: int, bottom: int) -> Samples:
        """Return empty samples of pixels from left and top to before right and bottom."""
        shape = (bottom - top, right - left, SAMPLES)
        return cls(
            left,
            top,
            np.full(shape, np.inf, dtype=np.float32),
            np.full(shape, NOBODY, dtype=np.int16),
            np.empty((*shape, 3), dtype=np.uint8),
            np.full(shape, NOBODY, dtype=np.int16),
        )


class Surface(NamedTuple):
    """One object in an image while the shutter is open.

    Attributes:
        faces: (triangles, 3), counter-clockwise seen from outside.
        backs: (triangles,) which of the two textures has their colours.
        texels: (vertices, 2) column and row in the texture.
        textures: (2, rows, columns, 3) RGB.
        opened: (vertices, 3) pixel [px] and depth [m] when the shutter opens.
        closed: (vertices, 3) pixel [px] and depth [m] when the shutter closes.
        light: (vertices,) brightness of each vertex, 1 = as in the texture.
    """

    faces: NDArray[np.int32]
    backs: Flags
    texels: Singles
    textures: Image
    opened: Singles
    closed: Singles
    light: Singles


@compile_kernel
def draw_triangles(surface: Surface, haze: Singles, which: int, samples: Samples) -> int:
    """Draw one object into the z-buffer, and return the number of samples it would cover alone.

    Triangles that face away or have a vertex without an image are skipped. The haze (4,) is its
    share in front of the object, and its colour [levels of 255]; `which` is the object's number,
    from 0.
    """
    # Moments of samples, as a share of the time that the shutter is open.
    when = (0.125, 0.625, 0.375, 0.875)
    across = (-0.125, 0.375, -0.375, 0.125)
    opened, closed, faces, light = surface.opened, surface.closed, surface.faces, surface.light
    backs, texels = surface.backs, surface.texels
    left, top, depth, who = samples.left, samples.top, samples.depth, samples.who
    color, last = samples.color, samples.last
    height, width = depth.shape[0], depth.shape[1]
    count = 0
    clear = np.float32(1.0) - haze[0]
    for f in range(len(faces)):
        a, b, c = faces[f, 0], faces[f, 1], faces[f, 2]
        picture = surface.textures[1 if backs[f] else 0]
        for s in range(SAMPLES):
            share, right, down = when[s], left + across[s], top + _DOWN[s]
            ax = opened[a, 0] + share * (closed[a, 0] - opened[a, 0]) - right
            ay = opened[a, 1] + share * (closed[a, 1] - opened[a, 1]) - down
            bx = opened[b, 0] + share * (closed[b, 0] - opened[b, 0]) - right
            by = opened[b, 1] + share * (closed[b, 1] - opened[b, 1]) - down
            cx = opened[c, 0] + share * (closed[c, 0] - opened[c, 0]) - right
            cy = opened[c, 1] + share * (closed[c, 1] - opened[c, 1]) - down
            area = (cx - ax) * (by - ay) - (bx - ax) * (cy - ay)
            # Also false if a vertex has no image.
            if not area > 1e-9:
                continue
            u0 = max(int(np.ceil(min(ax, bx, cx))), 0)
            u1 = min(int(np.floor(max(ax, bx, cx))), width - 1)
            v0 = max(int(np.ceil(min(ay, by, cy))), 0)
            v1 = min(int(np.floor(max(ay, by, cy))), height - 1)
            if u0 > u1 or v0 > v1:
                continue
            for v in range(v0, v1 + 1):
                for u in range(u0, u1 + 1):
                    wa = ((cx - u) * (by - v) - (bx - u) * (cy - v)) / area
                    wb = ((ax - u) * (cy - v) - (cx - u) * (ay - v)) / area
                    wc = 1.0 - wa - wb
                    if wa < 0.0 or wb < 0.0 or wc < 0.0:
                        continue
                    if last[v, u, s] != which:
                        last[v, u, s] = which
                        count += 1
                    z = wa * opened[a, 2] + wb * opened[b, 2] + wc * opened[c, 2]
                    if not z < depth[v, u, s]:
                        continue
                    depth[v, u, s] = z
                    who[v, u, s] = which
                    column = int(wa * texels[a, 0] + wb * texels[b, 0] + wc * texels[c, 0])
                    row = int(wa * texels[a, 1] + wb * texels[b, 1] + wc * texels[c, 1])
                    lit = clear * (wa * light[a] + wb * light[b] + wc * light[c])
                    for k in range(3):
                        value = lit * picture[row, column, k] + haze[0] * haze[1 + k]
                        color[v, u, s, k] = int(min(value + 0.5, 255.0))
    return count


@compile_kernel
def cover_triangles(pixels: Singles, faces: NDArray[np.int32], bit: int, mask: Image) -> None:
    """Set a bit, a power of 2, in pixels whose centres lie within triangles of either orientation.

    Of pixels (vertices, 2) [px], faces (triangles, 3) with a NaN are skipped; the mask (height,
    width) is written.
    """
    for f in range(len(faces)):
        a, b, c = faces[f, 0], faces[f, 1], faces[f, 2]
        ax, ay = float(pixels[a, 0]), float(pixels[a, 1])
        bx, by = float(pixels[b, 0]), float(pixels[b, 1])
        cx, cy = float(pixels[c, 0]), float(pixels[c, 1])
        area = (cx - ax) * (by - ay) - (bx - ax) * (cy - ay)
        if not abs(area) > 1e-9:
            continue
        u0 = max(int(np.ceil(min(ax, bx, cx))), 0)
        u1 = min(int(np.floor(max(ax, bx, cx))), mask.shape[1] - 1)
        v0 = max(int(np.ceil(min(ay, by, cy))), 0)
        v1 = min(int(np.floor(max(ay, by, cy))), mask.shape[0] - 1)
        for v in range(v0, v1 + 1):
            for u in range(u0, u1 + 1):
                wa = ((cx - u) * (by - v) - (bx - u) * (cy - v)) / area
                wb = ((ax - u) * (cy - v) - (cx - u) * (ay - v)) / area
                if wa >= 0.0 and wb >= 0.0 and wa + wb <= 1.0:
                    mask[v, u] |= bit


@compile_kernel
def resolve(
    who: NDArray[np.int16], color: Image, picture: Image, persons: NDArray[np.int16], seen: Integers
) -> None:
    """Blend samples into a part of an image, and write the person in at least half of each pixel.

    `who` (height, width, 4) and `color` (height, width, 4, 3) are of `Samples`; the picture
    (height, width, 3) RGB changes in place. `persons` (height, width) is written where half of the
    samples show one of the len(seen) people, whose numbers of samples are added to `seen`
    (persons,).
    """
    for v in range(who.shape[0]):
        for u in range(who.shape[1]):
            hits, best, most = 0, NOBODY, 0
            red, green, blue = 0, 0, 0
            for s in range(SAMPLES):
                w = who[v, u, s]
                if w == NOBODY:
                    continue
                hits += 1
                red += color[v, u, s, 0]
                green += color[v, u, s, 1]
                blue += color[v, u, s, 2]
                if w < len(seen):
                    seen[w] += 1
                    same = 0
                    for t in range(SAMPLES):
                        if who[v, u, t] == w:
                            same += 1
                    if same > most:
                        best, most = w, same
            if hits == 0:
                continue
            rest = SAMPLES - hits
            picture[v, u, 0] = (red + rest * picture[v, u, 0] + 2) // SAMPLES
            picture[v, u, 1] = (green + rest * picture[v, u, 1] + 2) // SAMPLES
            picture[v, u, 2] = (blue + rest * picture[v, u, 2] + 2) // SAMPLES
            if 2 * most >= SAMPLES:
                persons[v, u] = best


@dataclass(frozen=True, eq=False)
class Outlines:
    """Image positions of surfaces.

    Attributes:
        pixels: (surfaces, vertices, 3) pixel [px] and depth [m]; NaN without an image.
        boxes: (surfaces, 4) left, top, right, bottom of all vertices with an image [px].
    """

    pixels: Singles
    boxes: Floats

    def box(self, number: int, margin: int, width: int, height: int) -> Box | None:
        """Return the part of the image that shows a surface: left, top, right, bottom."""
        if not np.isfinite(self.boxes[number]).all():
            return None
        left, top, right, bottom = self.boxes[number]
        part = (
            max(int(np.floor(left)) - margin, 0),
            max(int(np.floor(top)) - margin, 0),
            min(int(np.ceil(right)) + margin + 1, width),
            min(int(np.ceil(bottom)) + margin + 1, height),
        )
        return part if part[0] < part[2] and part[1] < part[3] else None


def outline_surfaces(camera: Camera, vertices: Singles) -> Outlines:
    """Return outlines in a single camera's image of (surfaces, vertices, 3) [m], world."""
    pixels, boxes = np.empty_like(vertices), np.empty((len(vertices), 4))
    _project(camera.numbers[None], vertices, pixels, boxes)
    return Outlines(pixels, boxes)


@compile_kernel
def _project(cameras: Floats, vertices: Singles, pixels: Singles, boxes: Floats) -> None:
    """Write pixels and depth (surfaces, vertices, 3), and the box (4,) around each surface."""
    camera = load_camera(cameras, 0)
    for p in range(vertices.shape[0]):
        left, top, right, bottom = np.inf, np.inf, -np.inf, -np.inf
        for v in range(vertices.shape[1]):
            at = vertices[p, v]
            status, x, y, depth = project_point(camera, float(at[0]), float(at[1]), float(at[2]))
            if status != RayStatus.OK.value:
                pixels[p, v] = np.nan
                continue
            pixels[p, v, 0], pixels[p, v, 1], pixels[p, v, 2] = x, y, depth
            left, right = min(left, x), max(right, x)
            top, bottom = min(top, y), max(bottom, y)
        boxes[p, 0], boxes[p, 1], boxes[p, 2], boxes[p, 3] = left, top, right, bottom
        if not left < np.inf:
            boxes[p] = np.nan
