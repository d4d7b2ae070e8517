"""Rigs in halls and stadiums, visibility of people, and what users state of cameras and pitch."""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Final, Literal

import numpy as np
from numpy.typing import NDArray

from data_contracts.arrays import Flags, Floats
from data_contracts.conventions import COCO17_TORSO
from data_contracts.pitch import PitchSpec
from data_contracts.static_calibration import ClickedMarkings, ClickedPoint, DrawnMarking
from worldpose.body.occlusions import CAPSULES, facing_axes, find_hiders, is_covered
from worldpose.geometry.cameras import Camera
from worldpose.geometry.lens_models import fold_radius
from worldpose.geometry.rigid import Rigid
from worldpose.pitch.template import PitchTemplate

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


@dataclass(frozen=True, eq=False)
class RigCamera:
    """A static camera.

    Attributes:
        camera: camera with OpenCV's five coefficients.
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

    def sees(self, pixels: Floats) -> Flags:
        """Return which pixels (..., 2) lie in the image."""
        with np.errstate(invalid="ignore"):
            inside = (pixels >= -0.5) & (pixels <= self.camera.image_size - 0.5)
        return np.asarray(inside.all(axis=-1))


def draw_rig(
    count: int, layout: Layout, field: tuple[float, float], action: Floats, rng: np.random.Generator
) -> list[RigCamera]:
    """Return cameras that look at the action.

    `field` is the length and width of the pitch, or of the space that a lab's people move in [m].
    Cameras aim among `action` (places, 3) [m], positions of heads, hips and feet.
    """
    rig: list[RigCamera] = []
    half, start = 0.5 * np.array(field), float(rng.uniform(0.0, 2.0 * np.pi))
    for index in range(count):
        for _ in range(60):
            place, mounting = _draw_place(index, count, start, layout, half, rng)
            drawn = _draw_camera(place, mounting, action, rng)
            inside = drawn.sees(drawn.project(action))
            if inside.mean() > (0.5 if layout == "hall" else 0.25):
                break
        rig.append(drawn)
    return rig


def _draw_camera(
    place: Floats, mounting: str, action: Floats, rng: np.random.Generator
) -> RigCamera:
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
    max_swirl_px = 0.9  # at the corner of an image 1920 px wide
    if lens == "beyond":
        size_px = rng.uniform(0.3, 1.0) * max_swirl_px * size[0] / 1920.0
        beyond = (float(size_px), int(rng.integers(2, 5)), float(rng.uniform(0.0, 2.0 * np.pi)))
    return RigCamera(camera, lens, mounting, beyond)


def _draw_place(
    index: int, count: int, start: float, layout: Layout, half: Floats, rng: np.random.Generator
) -> tuple[Floats, str]:
    """Return a camera's centre (3,) [m] by half the field (2,) [m], and its position in words."""
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
        height = 4.0 + 0.5 * back * rng.uniform(0.6, 1.1)
        return np.array([x, -half[1] - back, height]), "main stand"
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


@dataclass(frozen=True, eq=False)
class ForeignView:
    """People in one camera's image.

    Attributes:
        inside: (frames, persons, 17) joints in the image and not behind a pillar.
        hider: (frames, persons, 17) int16, the person in front of a joint, -1 for none.
        behind_self: (frames, persons, 17) behind the person's own trunk.
        size: (frames, persons) height of a standing person there [px].
        azimuth, elevation: (frames, persons) direction of the camera, seen from the body [rad]: 0
            in front, growing to the left; 0 level, growing upwards.
    """

    inside: Flags
    hider: NDArray[np.int16]
    behind_self: Flags
    size: Floats
    azimuth: Floats
    elevation: Floats

    @property
    def seen(self) -> Flags:
        """Return the joints (frames, persons, 17) in the image that no other person occludes."""
        return np.asarray(self.inside & (self.hider < 0))


def view_people(
    camera: RigCamera, joints: Floats, statures: Floats, pillar: tuple[float, float] | None
) -> ForeignView:
    """Return positions of people in the image and their occlusions.

    `joints` (frames, persons, 17, 3) [m], world; `statures` (persons,) [m]; `pillar` is the left
    and right border of an occluded strip [px].
    """
    pixels = camera.project(joints)
    inside = camera.sees(pixels)
    if pillar is not None:
        with np.errstate(invalid="ignore"):
            inside &= (pixels[..., 0] < pillar[0]) | (pixels[..., 0] > pillar[1])
    trunk = joints[:, :, COCO17_TORSO].mean(axis=2)
    depth = camera.camera.cam_from_world.apply(trunk)[..., 2]
    size = float(camera.camera.focal.mean()) / np.where(depth > 0.1, depth, np.nan) * statures
    away = camera.camera.center - trunk
    forward, left = facing_axes(joints)
    level = np.linalg.norm(away[..., :2], axis=-1)
    return ForeignView(
        inside=inside,
        hider=find_hiders(pixels, depth, size),
        behind_self=_is_behind_trunk(camera, joints, pixels, depth, size),
        size=size,
        azimuth=np.arctan2((away * left).sum(-1), (away * forward).sum(-1)),
        elevation=np.arctan2(away[..., 2], level),
    )


def _is_behind_trunk(
    camera: RigCamera, joints: Floats, pixels: Floats, depth: Floats, size: Floats
) -> Flags:
    """Return joints (frames, persons, 17) over half a trunk's depth behind the own trunk."""
    own = camera.camera.cam_from_world.apply(joints.reshape(-1, 3))[:, 2].reshape(pixels.shape[:3])
    flat = pixels.reshape(-1, 17, 2)
    covered = is_covered(flat, flat, size.ravel(), CAPSULES[:4]).reshape(own.shape)
    return np.asarray(covered & (own > depth[..., None] + 0.09))


@dataclass(frozen=True, eq=False)
class Pitch:
    """True and stated positions of a pitch.

    Attributes:
        painted: pitch with the true position of every named point.
        stated: pitch.json.
        how: origin of the statement.
    """

    painted: PitchSpec
    stated: PitchSpec
    how: str


def draw_pitch(rng: np.random.Generator) -> Pitch:
    """Return a pitch of 90 to 120 by 45 to 90 m with a crown of up to 0.4 m."""
    tape = 0.02  # error of a length measured by tape [m]
    survey = 0.005  # error of a surveyed point, along each axis [m]
    painting = 0.015  # error of painted points against the Laws, along each axis [m]
    length, width = float(rng.uniform(90.0, 120.0)), float(rng.uniform(45.0, 90.0))
    if rng.random() < 0.4:
        length, width = 105.0, 68.0
    crown = float(rng.uniform(0.0, 0.4)) * float(rng.random() < 0.8)
    law = PitchTemplate.from_spec(PitchSpec(length=length, width=width, crown=crown)).points
    painted = {}
    for name, place in law.items():
        off = painting * rng.standard_normal(3) * [1.0, 1.0, 0.2]
        painted[name] = place + (0.0 if name == "center_mark" else off)
    for name in [name for name in painted if name.endswith("_top")]:
        foot = name.replace("_top", "_bottom")
        painted[name] = painted[foot] + np.array([0.0, 0.0, law[name][2] - law[foot][2]])
    true = PitchSpec(length=length, width=width, crown=crown, points=_to_tuples(painted))
    if rng.random() < 0.5:
        surveyed = {n: p + survey * rng.standard_normal(3) for n, p in painted.items()}
        stated = true.model_copy(update={"points": _to_tuples(surveyed)})
        return Pitch(true, stated, "survey of all points")
    taped = PitchSpec(
        length=round(length + tape * rng.standard_normal(), 2),
        width=round(width + tape * rng.standard_normal(), 2),
        crown=max(0.0, round(crown + 0.03 * rng.standard_normal(), 2)),
    )
    return Pitch(true, taped, "length, width and crown by tape")


def _to_tuples(places: dict[str, Floats]) -> dict[str, tuple[float, float, float]]:
    return {name: (float(x), float(y), float(z)) for name, (x, y, z) in places.items()}


def visible_points(camera: RigCamera, pitch: PitchTemplate) -> list[str]:
    """Return the named points of the pitch inside a camera's image."""
    names = list(pitch.points)
    inside = _is_inside(camera, camera.project(pitch.positions(names)))
    return [name for name, there in zip(names, inside, strict=True) if there]


def click_points(
    camera: RigCamera, pitch: PitchTemplate, rng: np.random.Generator
) -> tuple[ClickedMarkings, dict[str, str]]:
    """Return a person's clicks, and by wrong name the name of the point under it."""
    misnamed = 0.04  # share of cameras with a click under a wrong name [1]
    click_tail = 4.0  # degrees of freedom of clicks (Student's t) [1]
    click_spread = (0.3, 1.1)  # of one person's clicks in an image of 1920 px [px]
    spread = rng.uniform(*click_spread) * np.sqrt(camera.camera.image_size[0] / 1920.0)
    unit = np.sqrt(click_tail / (click_tail - 2.0))
    there = visible_points(camera, pitch)
    chosen = list(rng.permutation(there)[: int(rng.integers(8, 18))])
    pixels = camera.project(pitch.positions(chosen)).reshape(-1, 2)
    pixels = pixels + spread / unit * rng.standard_t(click_tail, pixels.shape)
    names = {name: name for name in chosen}
    confused = (("left", "right"), ("near", "far"), ("front", "back"))
    if chosen and rng.random() < misnamed:
        victim = str(rng.choice(chosen))
        pairs = [*confused, *((two, one) for one, two in confused)]
        other = [victim.replace(one, two) for one, two in pairs if one in victim]
        other = [name for name in other if name in pitch.points and name not in names]
        if other:
            names[victim] = str(rng.choice(other))
    points = tuple(
        ClickedPoint(name=names[name], xy=_round_click(camera, xy))
        for name, xy in zip(chosen, pixels, strict=True)
    )
    drawn: list[DrawnMarking] = []
    few_points = 9  # if an image shows fewer, lines and arcs are drawn, too [1]
    if len(there) < few_points:
        for name in pitch.marking_names:
            course = camera.project(pitch.marking_points(name, 0.3))
            course = course[_is_inside(camera, course)]
            if len(course) < 8 or np.ptp(course, axis=0).max() < 80.0:
                continue
            count = min(len(course), int(rng.integers(4, 11)))
            rows = np.sort(rng.choice(len(course), count, False))
            line = course[rows] + 1.3 * spread / unit * rng.standard_t(click_tail, (len(rows), 2))
            drawn.append(DrawnMarking(name=name, xy=tuple(_round_click(camera, xy) for xy in line)))
    markings = ClickedMarkings(points=points, drawn=tuple(drawn))
    return markings, {new: name for name, new in names.items() if new != name}


def _is_inside(camera: RigCamera, pixels: Floats) -> Flags:
    margin_px = 6.0
    with np.errstate(invalid="ignore"):
        inside = (pixels > margin_px) & (pixels < camera.camera.image_size - 1.0 - margin_px)
    return np.asarray(inside.all(axis=-1))


def _round_click(camera: RigCamera, xy: Floats) -> tuple[float, float]:
    x, y = np.clip(xy, 0.0, camera.camera.image_size - 1.0)
    return round(float(x), 1), round(float(y), 1)


def measure_camera(camera: Camera, accuracy: float, rng: np.random.Generator) -> Camera:
    """Return a camera with the errors of another calibration.

    Accuracy 1 is 0.3 mrad, 2 cm, 0.05 % and a thousandth of k1; others in proportion.
    """
    turn = accuracy * 3e-4 * rng.standard_normal(3)
    center = camera.center + accuracy * 0.02 * rng.standard_normal(3)
    cross = np.array([[0.0, -turn[2], turn[1]], [turn[2], 0.0, -turn[0]], [-turn[1], turn[0], 0.0]])
    u, _, vt = np.linalg.svd((np.eye(3) + cross) @ camera.cam_from_world.rotation)
    distortion = camera.distortion.copy()
    distortion[0] += accuracy * 1e-3 * rng.standard_normal()
    focal = camera.focal * (1.0 + accuracy * 5e-4 * rng.standard_normal())
    pose = Rigid(u @ vt, -(u @ vt) @ center)
    return replace(camera, focal=focal, distortion=distortion, cam_from_world=pose)
