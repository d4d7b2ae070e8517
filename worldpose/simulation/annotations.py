"""Inputs that people supply: clicks, key frames, the surveyed pitch, given cameras."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Final

import numpy as np

from data_contracts.arrays import Flags, Floats, Integers
from data_contracts.broadcast_calibration import KeyFrame, KeyFrames
from data_contracts.pitch import PitchSpec
from data_contracts.static_calibration import ClickedMarkings, ClickedPoint, DrawnMarking
from worldpose.geometry.cameras import Camera
from worldpose.geometry.rigid import Rigid
from worldpose.pitch.template import PitchTemplate
from worldpose.simulation.settings import CalibrationErrors, ClickSettings

BORDER: Final = 4.0
"""Minimum distance of clicks from the image border [px]."""
CONFUSED: Final = (
    ("near", "far"),
    ("front", "back"),
    ("penalty_area", "goal_area"),
    ("bottom", "top"),
)
"""Parts of names that people confuse."""


@dataclass(frozen=True, eq=False)
class Clicks:
    """Clicks of a person in one camera's image.

    Attributes:
        markings: annotations/static_calibration/<camera>.json.
        wrong: maps the name of every wrong click to the name of the point under the click or, for
            the same name, of the intended point.
        clustered: all points come from one part of the image.
    """

    markings: ClickedMarkings
    wrong: Mapping[str, str]
    clustered: bool


def click(
    camera: Camera,
    pitch: PitchTemplate,
    people: Floats,
    settings: ClickSettings,
    *,
    clustered: bool,
    mistaken: bool,
    rng: np.random.Generator,
) -> Clicks:
    """Return a person's clicks on named points, and lines if points are few.

    `people` are joints (persons, 17, 3) [m], world, of possible occluders. All points come from one
    part of the image if `clustered`; one has a wrong name or a gross error if `mistaken`.
    """
    names = list(pitch.points)
    places = pitch.positions(names)
    pixels = camera.project(places)
    there = np.flatnonzero(_are_visible(camera, places, pixels, _person_boxes(camera, people)))
    chosen = _choose_points(
        there, pixels[:, 0], places, camera.image_size[0], settings, clustered, rng
    )
    noisy = pixels + settings.noise_px * rng.standard_normal(pixels.shape)
    clicked = {names[index]: noisy[index] for index in chosen}
    wrong: dict[str, str] = {}
    if mistaken and len(chosen):
        clicked, wrong = _make_mistake(clicked, names, camera, settings, rng)
    drawn: tuple[DrawnMarking, ...] = ()
    if len(there) < settings.enough:
        drawn = _draw_markings(camera, pitch, people, settings, rng)
    points = tuple(
        ClickedPoint(name=name, xy=_place_click(camera, xy)) for name, xy in clicked.items()
    )
    return Clicks(ClickedMarkings(points=points, drawn=drawn), wrong, clustered)


def every(share: float, index: int, start: float) -> bool:
    """Return whether item `index` is chosen if a `share` of all items is chosen at equal distances.

    `start` in [0, 1) shifts the choice.
    """
    return bool(np.floor((index + 1) * share + start) > np.floor(index * share + start))


def _person_boxes(camera: Camera, people: Floats) -> Floats:
    """Return left, top, right, bottom [px] and depth [m] of visible people (persons, 5)."""
    pixels = camera.project(people.reshape(-1, 3)).reshape(*people.shape[:2], 2)
    depth = camera.cam_from_world.apply(people.reshape(-1, 3))[:, 2].reshape(people.shape[:2])
    seen = np.isfinite(pixels).all(axis=(1, 2))
    low, high = pixels[seen].min(axis=1), pixels[seen].max(axis=1)
    # Heads, feet and arms extend beyond the joints by about a tenth of the height.
    more = 0.1 * (high[:, 1:] - low[:, 1:])
    return np.concatenate([low - more, high + more, depth[seen].mean(axis=1)[:, None]], axis=1)


def _are_visible(camera: Camera, places: Floats, pixels: Floats, boxes: Floats) -> Flags:
    """Return which points (n,) are in the image and not occluded by people."""
    depth = camera.cam_from_world.apply(places)[:, 2]
    inside = (pixels >= BORDER) & (pixels <= camera.image_size - 1.0 - BORDER)
    x, y = pixels[:, None, 0], pixels[:, None, 1]
    covered = (x >= boxes[:, 0]) & (x <= boxes[:, 2]) & (y >= boxes[:, 1]) & (y <= boxes[:, 3])
    hidden = covered & (boxes[:, 4] < depth[:, None])
    return np.asarray(inside.all(axis=-1) & ~hidden.any(axis=-1))


def _choose_points(
    there: Integers,
    x: Floats,
    places: Floats,
    width: float,
    settings: ClickSettings,
    clustered: bool,
    rng: np.random.Generator,
) -> Integers:
    """Return indices of the points to click, in random order."""
    tries = 50  # draws of points before collinear ones are accepted
    low, high = settings.clustered_points if clustered else settings.points
    count = int(rng.integers(low, high + 1))
    if clustered:
        inside = np.abs(x[there] - x[there][:, None] - 0.5 * settings.window * width)
        windows = [there[row] for row in inside <= 0.5 * settings.window * width]
        # Where no part of the image holds enough, people look farther.
        firm = [window for window in windows if _is_spread_out(places[window])]
        rich = [window for window in firm if len(window) >= count] or firm or [there]
        there = rich[rng.integers(len(rich))]
    count = min(count, len(there))
    chosen = rng.permutation(there)[:count]
    for _ in range(tries if _is_spread_out(places[there]) else 0):
        if _is_spread_out(places[chosen]):
            break
        chosen = rng.permutation(there)[:count]
    return chosen


def _is_spread_out(places: Floats) -> bool:
    """Return whether points (n, 3) [m] are not collinear in plan, with any one of them removed."""
    if len(places) < 4:
        return False
    rest = np.array([np.delete(places[:, :2], one, axis=0) for one in range(len(places))])
    across = np.linalg.svd(rest - rest.mean(axis=1, keepdims=True), compute_uv=False)[:, 1]
    min_spread_m = 2.0  # points across less than this are collinear [m]
    return bool(across.min() > min_spread_m)


def _make_mistake(
    clicked: Mapping[str, Floats],
    names: Sequence[str],
    camera: Camera,
    settings: ClickSettings,
    rng: np.random.Generator,
) -> tuple[dict[str, Floats], dict[str, str]]:
    """Return the clicks with one of them wrong, and its name."""
    taken = list(clicked)
    victim = taken[rng.integers(len(taken))]
    pairs = (*CONFUSED, *((other, one) for one, other in CONFUSED))
    near = [victim.replace(one, other) for one, other in pairs if one in victim]
    others = [name for name in near if name in names and name not in clicked]
    angle, far = 2.0 * np.pi * rng.random(), rng.uniform(20.0, 60.0)
    if rng.random() < 0.5 and others:
        named = others[rng.integers(len(others))]
        return {named if name == victim else name: xy for name, xy in clicked.items()}, {
            named: victim
        }
    off = far * np.array([np.cos(angle), np.sin(angle)])
    # Towards the inside: a slip does not leave the image.
    inward = np.where(clicked[victim] + off < BORDER, 1.0, np.sign(off))
    inward = np.where(clicked[victim] + off > camera.image_size - 1.0 - BORDER, -1.0, inward)
    return {**clicked, victim: clicked[victim] + inward * np.abs(off)}, {victim: victim}


def _draw_markings(
    camera: Camera,
    pitch: PitchTemplate,
    people: Floats,
    settings: ClickSettings,
    rng: np.random.Generator,
) -> tuple[DrawnMarking, ...]:
    """Return drawn markings: points along their visible parts, from one end to the other."""
    spacing = 0.25  # distance between samples along a marking [m]
    samples = pitch.sample_lines(spacing)
    pixels = camera.project(samples.points_world)
    visible = _are_visible(camera, samples.points_world, pixels, _person_boxes(camera, people))
    drawn = []
    min_length_px = 60.0  # shorter visible parts of markings are not drawn
    for marking, name in enumerate(samples.names):
        seen = pixels[visible & (samples.marking == marking)]
        if len(seen) < 2 or np.ptp(seen, axis=0).max() < min_length_px:
            continue
        # Clicks are at about even steps, wherever a sample is near.
        steps = np.linspace(0.0, len(seen) - 1.0, 8).round().astype(int)
        points = seen[np.unique(steps)]
        points = points + settings.noise_px * rng.standard_normal(points.shape)
        drawn.append(DrawnMarking(name=name, xy=tuple(_place_click(camera, xy) for xy in points)))
    return tuple(drawn)


def _place_click(camera: Camera, xy: Floats) -> tuple[float, float]:
    """Return a click in the image in annotation tools' precision, a hundredth of a pixel."""
    x, y = np.clip(xy, 0.0, camera.image_size - 1.0)
    return round(float(x), 2), round(float(y), 2)


def click_key_frames(
    cameras: Camera,
    pitch: PitchTemplate,
    people: Floats,
    settings: ClickSettings,
    count: int,
    rng: np.random.Generator,
) -> KeyFrames:
    """Return clicks in frames spread over the clip, each at a local maximum of clickable markings.

    `cameras` is a batch (frames,), `people` are joints (frames, persons, 17, 3) [m], world, of
    possible occluders. Lines and arcs are always drawn.
    """
    search_range = 0.1  # around a key frame's even place, as a share of the clip [1]
    frames = len(people)
    drawing = settings.model_copy(update={"enough": len(pitch.points) + 1})
    picked: dict[int, Clicks] = {}
    compared_frames = 5  # that a person compares for one key frame [1]
    for middle in np.linspace(0.0, frames - 1.0, count):
        around = middle + search_range * frames * np.linspace(-1.0, 1.0, compared_frames)
        looks = {
            int(frame): click(
                cameras[int(frame)],
                pitch,
                people[int(frame)],
                drawing,
                clustered=False,
                mistaken=False,
                rng=rng,
            )
            for frame in np.unique(np.clip(np.rint(around), 0, frames - 1))
        }
        best = max(looks, key=lambda frame: (_information(looks[frame]), -abs(frame - middle)))
        if _information(looks[best]):
            picked[best] = looks[best]
    return KeyFrames(
        key_frames=tuple(
            KeyFrame(frame=frame, markings=picked[frame].markings) for frame in sorted(picked)
        )
    )


def _information(clicks: Clicks) -> int:
    """Return a frame's information: points count twice, because they have two coordinates."""
    return 2 * len(clicks.markings.points) + len(clicks.markings.drawn)


def survey(painted: PitchSpec, error: float, rng: np.random.Generator) -> PitchSpec:
    """Return the pitch with all its points as measured, to a millimetre.

    `error` is the standard deviation of a point along each axis [m].
    """
    points = {}
    for name, place in PitchTemplate.from_spec(painted).points.items():
        x, y, z = (place + error * rng.standard_normal(3)).round(3) + 0.0
        points[name] = (float(x), float(y), float(z))
    return painted.model_copy(update={"points": points})


def add_calibration_errors(
    cameras: dict[str, Camera], errors: CalibrationErrors, rng: np.random.Generator
) -> dict[str, Camera]:
    """Return the true cameras with the errors of the settings."""
    if errors == CalibrationErrors():
        return cameras
    bad = rng.permutation(len(cameras))[: errors.bad_cameras]
    given = {}
    for index, (name, camera) in enumerate(cameras.items()):
        factor = errors.bad_factor if index in bad else 1.0
        turn = factor * errors.rotation_rad * rng.standard_normal(3)
        shift = factor * errors.center_m * rng.standard_normal(3)
        scale = 1.0 + factor * errors.focal * rng.standard_normal()
        given[name] = _move_camera(camera, turn, shift, scale)
    return given


def _move_camera(camera: Camera, turn: Floats, shift: Floats, scale: float) -> Camera:
    pivot = 60.0  # distance of the point that an error of the center leaves in its pixel [m]
    pose = camera.cam_from_world
    # Seen from the new center, the pivot straight ahead must again be straight ahead.
    seen = np.array([0.0, 0.0, pivot]) - pose.rotation @ shift
    axis = np.cross(seen, [0.0, 0.0, 1.0])
    length = float(np.linalg.norm(axis))
    keep = axis / max(length, 1e-12) * np.arctan2(length, seen[2])
    rotation = (
        Rigid.from_rotvec(turn, np.zeros(3)).rotation
        @ Rigid.from_rotvec(keep, np.zeros(3)).rotation
        @ pose.rotation
    )
    moved = Rigid(rotation, -rotation @ (camera.center + shift))
    return replace(camera, focal=camera.focal * scale, cam_from_world=moved)
