"""People and goals in an image: shaded capsules along their limbs, and their shadows."""

from __future__ import annotations

from typing import Final

import numpy as np
from numpy.typing import NDArray

from data_contracts.arrays import Floats, Singles
from worldpose.compiled import compile_kernel
from worldpose.geometry.cameras import Camera
from worldpose.pitch.template import PitchTemplate

_SHIRT, _SHORTS, _SKIN, _SOCKS, _BOOTS, _HAIR = range(6)
_GOAL_RADIUS = 0.06
_TEAM = 11
_KITS: Final = np.array(
    [
        # Shirt, shorts, socks of two teams, officials and goalkeepers.
        [[0.80, 0.08, 0.10], [0.85, 0.85, 0.87], [0.80, 0.08, 0.10]],
        [[0.88, 0.89, 0.92], [0.08, 0.12, 0.35], [0.88, 0.89, 0.92]],
        [[0.08, 0.08, 0.09], [0.08, 0.08, 0.09], [0.08, 0.08, 0.09]],
        [[0.85, 0.75, 0.10], [0.10, 0.10, 0.12], [0.85, 0.75, 0.10]],
    ]
)
_LIMBS: Final = (
    # From and to (COCO-17 joints, or shares of two), radii [m], part.
    ((5, 5), (6, 6), 0.075, 0.075, _SHIRT),
    ((11, 11), (5, 5), 0.095, 0.08, _SHIRT),
    ((12, 12), (6, 6), 0.095, 0.08, _SHIRT),
    ((11, 12), (5, 6), 0.13, 0.15, _SHIRT),
    ((11, 11), (12, 12), 0.105, 0.105, _SHORTS),
    ((5, 5), (7, 7), 0.058, 0.048, _SHIRT),
    ((6, 6), (8, 8), 0.058, 0.048, _SHIRT),
    ((7, 7), (9, 9), 0.042, 0.034, _SKIN),
    ((8, 8), (10, 10), 0.042, 0.034, _SKIN),
    ((11, 13), (13, 13), 0.07, 0.058, _SKIN),
    ((12, 14), (14, 14), 0.07, 0.058, _SKIN),
    ((11, 11), (11, 13), 0.095, 0.09, _SHORTS),
    ((12, 12), (12, 14), 0.095, 0.09, _SHORTS),
    ((13, 13), (15, 15), 0.056, 0.042, _SOCKS),
    ((14, 14), (16, 16), 0.056, 0.042, _SOCKS),
    ((5, 6), (3, 4), 0.055, 0.05, _SKIN),
    ((3, 4), (3, 4), 0.105, 0.105, _SKIN),
)


def person_capsules(joints: Floats, look: np.random.Generator) -> tuple[Floats, Floats]:
    """Return the limbs (persons, limbs, 8) [m] and their colours (persons, limbs, 3).

    A limb is x y z of both ends and both radii. The first 11 people are one team, the next 11 the
    other, the rest officials; the last of each team wears a goalkeeper's colours.

    Args:
        joints: (persons, 17, 3) joints of COCO-17 [m], world; a limb with a missing joint is
            missing.
        look: draws skin and hair.
    """
    persons = len(joints)
    limbs = np.empty((persons, len(_LIMBS) + 3, 8))
    part = np.empty(len(_LIMBS) + 3, dtype=np.int64)
    for index, (start, end, first, last, kind) in enumerate(_LIMBS):
        limbs[:, index, :3] = joints[:, start].mean(1)
        limbs[:, index, 3:6] = joints[:, end].mean(1)
        limbs[:, index, 6:] = first, last
        part[index] = kind
    across = joints[:, 11] - joints[:, 12]
    ahead = np.stack([across[:, 1], -across[:, 0], 0.0 * across[:, 0]], axis=1)
    ahead *= 1.0 / np.maximum(np.linalg.norm(ahead, axis=1, keepdims=True), 1e-6)
    for index, ankle in enumerate((15, 16), start=len(_LIMBS)):
        limbs[:, index, :3] = joints[:, ankle] - [0.0, 0.0, 0.03]
        limbs[:, index, 3:6] = joints[:, ankle] + 0.17 * ahead - [0.0, 0.0, 0.05]
        limbs[:, index, 6:] = 0.045, 0.035
        part[index] = _BOOTS
    top = joints[:, [3, 4]].mean(1) - 0.03 * ahead + [0.0, 0.0, 0.045]
    limbs[:, -1, :3], limbs[:, -1, 3:6], limbs[:, -1, 6:] = top, top, 0.095
    part[-1] = _HAIR

    team = np.minimum(np.arange(persons) // _TEAM, 2)
    team[(np.arange(persons) % _TEAM == _TEAM - 1) & (team < 2)] = 3
    palette = np.empty((persons, 6, 3))
    palette[:, [_SHIRT, _SHORTS, _SOCKS]] = _KITS[team]
    tone = look.uniform(0.25, 0.85, (persons, 1))
    palette[:, _SKIN] = tone * np.array([0.95, 0.72, 0.58])
    palette[:, _BOOTS] = look.choice([0.06, 0.9], (persons, 1)) * np.array([1.0, 0.95, 0.85])
    palette[:, _HAIR] = look.uniform(0.03, 0.3, (persons, 1)) * np.array([1.0, 0.8, 0.6])
    return limbs, palette[:, part]


def goal_capsules(pitch: PitchTemplate) -> tuple[Floats, Floats]:
    """Return posts and bar (goals, 3, 8) [m] of both goals, and their colours (goals, 3, 3)."""
    goals = np.empty((2, 3, 8))
    for goal, side in zip(goals, ("left", "right"), strict=True):
        near, far = f"goal_post_{side}_near", f"goal_post_{side}_far"
        for bar, ends in zip(
            goal,
            ((f"{near}_bottom", f"{near}_top"), (f"{far}_bottom", f"{far}_top"),
             (f"{near}_top", f"{far}_top")),
            strict=True,
        ):  # fmt: skip
            bar[:6] = pitch.positions(ends).ravel()
            bar[6:] = _GOAL_RADIUS
    return goals, np.full((2, 3, 3), 0.93)


def draw_shadows(
    shade: Singles, ground: Singles, camera: Camera, limbs: Floats, light: Floats, bend: Floats
) -> None:
    """Darken the ground where limbs block a light.

    Args:
        shade: (height, width) share of the light that arrives, multiplied in place.
        ground: (height, width, 2) x y of each pixel's place on the surface [m]; NaN off it.
        camera: a single camera.
        limbs: (things, limbs, 8) [m], world.
        light: (4,) direction down from the light, (x, y, z) with z = -1, and the share of all
            light that it gives.
        bend: (2,) bend of the surface, whose height is -bend[0] x^2 - bend[1] y^2.
    """
    for thing in limbs:
        known = thing[np.isfinite(thing).all(-1)]
        if not len(known):
            continue
        ends = known[:, :6].reshape(-1, 2, 3)
        up = ends[..., 2] + ends[..., :2] ** 2 @ bend
        fallen = ends[..., :2] + np.maximum(up, 0.0)[..., None] * light[:2]
        flat = np.concatenate([fallen, -(fallen**2 @ bend)[..., None]], axis=-1)
        pixels = camera.project(flat.reshape(-1, 3))
        box = _box(pixels, 0.35 * _scale(camera, flat.reshape(-1, 3)), shade.shape)
        if box is not None:
            rows = np.concatenate([fallen.reshape(-1, 4), known[:, 6:]], axis=1)
            _shadow(shade, ground, rows, box, float(light[3]))


def draw_things(
    image: Singles,
    camera: Camera,
    limbs: list[Floats],
    colors: list[Floats],
    brightness: list[float],
) -> None:
    """Draw things over the image, the far ones first.

    Args:
        image: (height, width, 3), changed in place.
        camera: a single camera.
        limbs: (limbs, 8) per thing [m], world.
        colors: (limbs, 3) per thing.
        brightness: brightness of the light on each thing.
    """
    middles = np.array([_middle(thing) for thing in limbs]).reshape(-1, 3)
    distance = np.linalg.norm(middles - camera.center, axis=-1)
    for index in np.argsort(-np.where(np.isnan(distance), np.inf, distance), kind="stable"):
        thing = limbs[index]
        ends = thing[:, :6].reshape(-1, 3)
        pixels = camera.project(ends).reshape(-1, 4)
        radii = thing[:, 6:] * _scale(camera, ends).reshape(-1, 2)
        depth = camera.cam_from_world.apply(ends)[:, 2].reshape(-1, 2).mean(1)
        rows = np.concatenate([pixels, radii], axis=1)
        seen = np.isfinite(rows).all(1)
        box = _box(rows[seen, :4].reshape(-1, 2), radii[seen].ravel() + 2.0, image.shape)
        if box is not None:
            order = np.flatnonzero(seen)[np.argsort(-depth[seen], kind="stable")]
            _capsules(image, rows[order], brightness[index] * colors[index][order])


def _middle(thing: Floats) -> Floats:
    known = thing[np.isfinite(thing).all(-1)]
    return known[:, :3].mean(0) if len(known) else np.full(3, np.nan)


def _scale(camera: Camera, points: Floats) -> Floats:
    """Return pixels per metre at points (n, 3)."""
    depth = camera.cam_from_world.apply(points)[:, 2]
    return np.asarray(camera.focal[0] / np.maximum(depth, 0.1))


def _box(pixels: Floats, margin: Floats, shape: tuple[int, ...]) -> NDArray[np.int64] | None:
    """Return left, top, right, bottom (exclusive) of a thing's pixels; None if outside."""
    known = np.isfinite(pixels).all(-1)
    if not known.any():
        return None
    limit = np.array([shape[1], shape[0]])
    low = np.floor((pixels[known] - margin[known, None]).min(0))
    high = np.ceil((pixels[known] + margin[known, None]).max(0)) + 1.0
    low, high = np.clip(low, 0, limit), np.clip(high, 0, limit)
    return np.array([*low, *high], dtype=np.int64) if (high > low).all() else None


@compile_kernel
def _shadow(
    shade: Singles, ground: Singles, rows: Floats, box: NDArray[np.int64], share: float
) -> None:
    """Subtract the light's share from pixels in a box within capsules (n, 6) on the ground."""
    for v in range(box[1], box[3]):
        for u in range(box[0], box[2]):
            gx, gy = float(ground[v, u, 0]), float(ground[v, u, 1])
            if np.isnan(gx):
                continue
            most = 0.0
            for i in range(len(rows)):
                r = rows[i]
                ex, ey = r[2] - r[0], r[3] - r[1]
                length2 = ex * ex + ey * ey
                along = 0.0
                if length2 > 0.0:
                    along = min(max(((gx - r[0]) * ex + (gy - r[1]) * ey) / length2, 0.0), 1.0)
                px, py = gx - r[0] - along * ex, gy - r[1] - along * ey
                radius = (1.0 - along) * r[4] + along * r[5]
                # Rim of 8 cm.
                cover = (radius + 0.04 - np.sqrt(px * px + py * py)) / 0.08
                most = max(most, min(cover, 1.0))
            shade[v, u] *= 1.0 - share * most


@compile_kernel
def _capsules(picture: Singles, rows: Floats, colors: Floats) -> None:
    """Draw capsules (n, 6) of ends and radii [px] in order, with rounded shading."""
    height, width = picture.shape[0], picture.shape[1]
    for i in range(len(rows)):
        r = rows[i]
        widest = max(r[4], r[5]) + 1.0
        left = max(int(np.floor(min(r[0], r[2]) - widest)), 0)
        right = min(int(np.ceil(max(r[0], r[2]) + widest)) + 1, width)
        top = max(int(np.floor(min(r[1], r[3]) - widest)), 0)
        bottom = min(int(np.ceil(max(r[1], r[3]) + widest)) + 1, height)
        ex, ey = r[2] - r[0], r[3] - r[1]
        length2 = ex * ex + ey * ey
        for v in range(top, bottom):
            for u in range(left, right):
                along = 0.0
                if length2 > 1e-12:
                    along = min(max(((u - r[0]) * ex + (v - r[1]) * ey) / length2, 0.0), 1.0)
                px, py = u - r[0] - along * ex, v - r[1] - along * ey
                radius = max((1.0 - along) * r[4] + along * r[5], 0.3)
                distance = np.sqrt(px * px + py * py)
                cover = min(max(radius + 0.5 - distance, 0.0), 1.0)
                if cover == 0.0:
                    continue
                rim = min(distance / radius, 1.0)
                # Light falls from above and a little from the left.
                lit = 0.6 + 0.4 * np.sqrt(1.0 - rim * rim) - 0.12 * (px + 1.5 * py) / radius
                for channel in range(3):
                    old = picture[v, u, channel]
                    new = min(max(lit, 0.3), 1.15) * colors[i, channel]
                    picture[v, u, channel] = (1.0 - cover) * old + cover * new
