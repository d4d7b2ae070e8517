"""Rigs of two to forty cameras: halls and stadiums, mixed resolutions, lenses and mountings."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Final, Literal

import numpy as np
from numpy.typing import NDArray

from data_contracts.arrays import Floats
from worldpose.geometry import Camera, Rigid
from worldpose.geometry.distortion import fold_radius

Layout = Literal["bowl", "one-side", "low", "goals", "mixed", "hall"]

SIZES: Final = (
    *((1280, 720), (1920, 1080), (1920, 1080), (2704, 1520), (3840, 2160), (1440, 1080)),
    *((1080, 1920),),
)
"""Width and height [px]; phones film in portrait format."""
LENSES: Final = {
    "rectilinear": 0.37,
    "barrel": 0.27,
    "pincushion": 0.09,
    "fisheye": 0.135,
    "beyond": 0.135,
}
"""Share of each kind [1]. `fisheye`: nearly equidistant; `beyond`: barrel distortion with a swirl
that the five coefficients of the lens model cannot represent."""
_BEYOND: Final = 0.9
"""Maximum displacement by that swirl, at the corner of an image 1920 px wide [px]."""


@dataclass(frozen=True, eq=False)
class RigCamera:
    """A static camera.

    Attributes:
        camera: with OpenCV's five coefficients.
        lens: its kind.
        mounting: its position, in words.
        beyond: amplitude [px], order and phase [rad] of the distortion beyond the five
            coefficients; zero amplitude for most.
    """

    camera: Camera
    lens: str
    mounting: str
    beyond: tuple[float, int, float] = (0.0, 3, 0.0)

    def project(self, points: Floats) -> Floats:
        """Return the pixels (..., 2) of world points (..., 3) [m]; NaN where undefined."""
        pixels = self.camera.project(points.reshape(-1, 3)).reshape(*points.shape[:-1], 2)
        size, order, phase = self.beyond
        if size == 0.0:
            return pixels
        middle = self.camera.principal_point
        radius = 0.5 * float(np.linalg.norm(self.camera.image_size))
        away = (pixels - middle) / radius
        far = np.linalg.norm(away, axis=-1)
        angle = np.arctan2(away[..., 1], away[..., 0])
        swirl = size * np.minimum(far, 1.2) ** 3
        towards = np.stack([np.cos(order * angle + phase), np.sin(order * angle - phase)], axis=-1)
        return np.asarray(pixels + swirl[..., None] * towards)

    def sees(self, pixels: Floats) -> NDArray[np.bool_]:
        """Return which pixels (..., 2) lie in the image."""
        with np.errstate(invalid="ignore"):
            inside = (pixels >= -0.5) & (pixels <= self.camera.image_size - 0.5)
        return np.asarray(inside.all(axis=-1))


def draw_rig(
    count: int, layout: Layout, field: tuple[float, float], action: Floats, rng: np.random.Generator
) -> list[RigCamera]:
    """Return cameras that look at the action.

    Args:
        count: number of cameras.
        layout: their arrangement.
        field: length and width of the pitch, or of the space that a lab's people move in [m].
        action: (places, 3) [m], positions of heads, hips and feet; cameras aim among them.
        rng: draws everything.
    """
    rig: list[RigCamera] = []
    start = float(rng.uniform(0.0, 2.0 * np.pi))
    for index in range(count):
        for _ in range(60):
            drawn = _draw_camera(index, count, start, layout, field, action, rng)
            inside = drawn.sees(drawn.project(action))
            if inside.mean() > (0.5 if layout == "hall" else 0.25):
                break
        rig.append(drawn)
    return rig


def _draw_camera(
    index: int,
    count: int,
    start: float,
    layout: Layout,
    field: tuple[float, float],
    action: Floats,
    rng: np.random.Generator,
) -> RigCamera:
    place, mounting = _draw_place(index, count, start, layout, field, rng)
    aim = action[rng.integers(len(action))] * [1.0, 1.0, 0.0] + [0.0, 0.0, 1.0]
    share = rng.uniform(0.3, 0.9)
    aim = share * action.mean(axis=0) + (1.0 - share) * aim
    size = SIZES[rng.integers(len(SIZES))]
    lens = str(rng.choice(list(LENSES), p=list(LENSES.values())))
    # Choose the zoom for a share of the action, as a camera operator does.
    forward = (aim - place) / np.linalg.norm(aim - place)
    towards = action - place
    towards = towards / np.linalg.norm(towards, axis=-1, keepdims=True)
    off_axis = np.arccos(np.clip(towards @ forward, -1.0, 1.0))
    half = float(np.quantile(off_axis, rng.uniform(0.6, 1.0))) + np.radians(3.0)
    low, high = {"fisheye": (38.0, 55.0)}.get(lens, (9.0, 40.0))
    half = float(np.clip(half, np.radians(low), np.radians(high)))
    distortion = _draw_distortion(lens, half, rng)
    edge = np.tan(half)
    powers = edge ** np.array([2, 4, 6])
    focal = 0.5 * size[0] / (edge * (1.0 + powers @ distortion[[0, 1, 4]]))
    aspect = 1.0 + 0.001 * rng.standard_normal()
    middle = 0.5 * (np.array(size) - 1.0) + 0.01 * min(size) * rng.standard_normal(2)
    camera = Camera(
        focal=np.array([focal, focal * aspect]),
        principal_point=middle,
        distortion=distortion,
        cam_from_world=_look_at(place, aim, np.radians(2.0) * rng.standard_normal()),
        image_size=np.array(size),
    )
    beyond = (0.0, 3, 0.0)
    if lens == "beyond":
        size_px = rng.uniform(0.3, 1.0) * _BEYOND * size[0] / 1920.0
        beyond = (float(size_px), int(rng.integers(2, 5)), float(rng.uniform(0.0, 2.0 * np.pi)))
    return RigCamera(camera, lens, mounting, beyond)


def _draw_place(
    index: int,
    count: int,
    start: float,
    layout: Layout,
    field: tuple[float, float],
    rng: np.random.Generator,
) -> tuple[Floats, str]:
    """Return a camera's centre (3,) [m] and its position in words."""
    half = 0.5 * np.array(field)
    share = (index + rng.uniform(0.2, 0.8)) / count
    if layout == "hall":
        angle = start + 2.0 * np.pi * share
        radius = half * rng.uniform(1.2, 1.6) + 1.0
        height = rng.choice([rng.uniform(0.6, 1.6), rng.uniform(2.2, 3.6)])
        return np.array([*radius * [np.cos(angle), np.sin(angle)], height]), "on a wall or tripod"
    kind = {
        "bowl": "roof",
        "one-side": "stand",
        "low": "eye level",
        "goals": ("goal", "roof")[int(rng.random() < 0.4)],
    }.get(layout) or str(rng.choice(["roof", "stand", "eye level", "goal", "around"]))
    if kind == "stand":
        back = rng.uniform(10.0, 45.0)
        x = half[0] * (2.2 * share - 1.1)
        return np.array(
            [x, -half[1] - back, 4.0 + 0.5 * back * rng.uniform(0.6, 1.1)]
        ), "main stand"
    if kind == "goal":
        side = 1.0 if index % 2 else -1.0
        across = half[1] * rng.uniform(-0.7, 0.7)
        away = rng.uniform(4.0, 30.0)
        return np.array([side * (half[0] + away), across, rng.uniform(3.0, 12.0)]), "behind a goal"
    angle = start + 2.0 * np.pi * share
    outward = np.array([np.cos(angle), np.sin(angle)])
    edge = 1.0 / np.max(np.abs(outward) / half)
    if kind == "eye level":
        away, height = rng.uniform(2.0, 8.0), rng.uniform(1.4, 2.4)
    elif kind == "around":
        away, height = rng.uniform(5.0, 30.0), rng.uniform(4.0, 16.0)
    else:
        away, height = rng.uniform(8.0, 40.0), rng.uniform(18.0, 42.0)
    return np.array([*(edge + away) * outward, height]), kind


def _draw_distortion(lens: str, half: float, rng: np.random.Generator) -> Floats:
    """Return k1 k2 p1 p2 k3 of a lens of this kind that sees `half` [rad] to either side."""
    # The corner of a 16:9 image is 15 % farther out than its side.
    reach = np.tan(min(1.2 * half, np.radians(62.0)))
    tangential = 2e-4 * rng.standard_normal(2)
    if lens == "rectilinear":
        radial = np.array([rng.normal(0.0, 0.008), 0.0, 0.0])
    elif lens == "pincushion":
        radial = np.array([rng.uniform(0.01, 0.06), rng.uniform(-0.01, 0.01), 0.0])
    elif lens == "fisheye":
        radius = np.linspace(0.02, 1.15 * reach, 200)
        goal = np.arctan(radius) / radius - 1.0
        powers = np.stack([radius**2, radius**4, radius**6], axis=-1)
        radial = np.linalg.lstsq(powers, goal, rcond=None)[0]
    else:
        radial = np.array([rng.uniform(-0.28, -0.08), 0.0, 0.0])
        radial[0] = max(radial[0], -0.22 / reach**2)
        radial[1] = rng.uniform(0.15, 0.45) * radial[0] ** 2
    distortion = np.array([radial[0], radial[1], *tangential, radial[2]])
    while fold_radius(distortion) < 1.1 * reach:
        distortion *= 0.8
    return distortion


def _look_at(center: Floats, aim: Floats, roll: float) -> Rigid:
    """Return the pose of a camera with a point in the middle of its image."""
    z = (aim - center) / np.linalg.norm(aim - center)
    x = np.cross(z, [0.0, 0.0, 1.0])
    x /= np.linalg.norm(x)
    y = np.cross(z, x)
    c, s = np.cos(roll), np.sin(roll)
    rotation = np.stack([c * x + s * y, c * y - s * x, z])
    return Rigid(rotation, -rotation @ center)
