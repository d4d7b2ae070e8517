"""Cameras that film otherwise, calibrations written otherwise, and the pitch."""

import math
from dataclasses import replace

import cv2
import numpy as np

from .kinds import FILM, kind, kinds
from .scene import Camera, law_points


def some(draft, rng):
    """Return a random camera id."""
    return str(rng.choice(list(draft.cameras)))


def target_of(draft):
    return draft.people.reshape(-1, 3).mean(axis=0)


def change(draft, rng, **values):
    name = some(draft, rng)
    draft.cameras[name] = replace(draft.cameras[name], **values)


def put(draft, name, camera):
    """Add a camera to the match."""
    draft.cameras[name] = camera
    draft.spec["cameras"].append({"id": name, "width": camera.width, "height": camera.height})


def remove(draft, name):
    del draft.cameras[name]
    draft.spec["cameras"] = [each for each in draft.spec["cameras"] if each["id"] != name]


# ---------------------------------------------------------------- cameras that film otherwise


def _scale(draft, rng, factors):
    for name, factor in zip(list(draft.cameras), np.broadcast_to(factors, 4), strict=False):
        camera = draft.cameras[name]
        draft.cameras[name] = replace(
            camera,
            width=max(1, round(camera.width * factor)),
            height=max(1, round(camera.height * factor)),
            focal=tuple(f * factor for f in camera.focal),
            principal=tuple((c + 0.5) * factor - 0.5 for c in camera.principal),
        )
    draft.pixel_noise *= min(1.0, float(np.min(factors)))
    draft.click_noise *= min(1.0, float(np.min(factors)))


kinds(
    "camera",
    {
        "one_smaller_image": (2 / 3, 1, 1, 1),
        "mixed_image_sizes": (2 / 3, 4 / 3, 1, 2),
        "image_of_8k": (4, 1, 1, 1),
    },
    _scale,
    phase=FILM,
    harmless=True,
)
kinds("camera", {"images_of_160_by_90": 1 / 12}, _scale, phase=FILM)


@kind("camera", phase=FILM, harmless=True)
def portrait(draft, rng):
    name = some(draft, rng)
    camera = draft.cameras[name]
    (fx, fy), (cx, cy) = camera.focal, camera.principal
    turned = Camera(
        *(camera.height, camera.width, (fy, fx), (camera.height - 1 - cy, cx)),
        *(camera.distortion, camera.rotation, camera.translation),
    )
    quarter = np.array([[0.0, -1.0, 0.0], [1.0, 0.0, 0.0], [0.0, 0.0, 1.0]])
    draft.cameras[name] = replace(
        turned, rotation=quarter @ camera.rotation, translation=quarter @ camera.translation
    )


def _roll(draft, rng, angle):
    name = some(draft, rng)
    camera = draft.cameras[name]
    draft.cameras[name] = camera.looking(camera.center, target_of(draft), roll=angle)


kinds(
    "camera",
    {"rolled_by_90": math.pi / 2, "upside_down": math.pi},
    _roll,
    phase=FILM,
    harmless=True,
)


def _lens(draft, rng, distortion):
    change(draft, rng, distortion=distortion)


LENSES = {
    "barrel_lens": (-0.15, 0.03, 0.0, 0.0, 0.0),
    "sixth_order_lens": (-0.2, 0.08, 0.0, 0.0, -0.02),
}
kinds("camera", LENSES, _lens, phase=FILM, base="given", harmless=True)
kinds(
    "camera",
    {
        **{f"clicked_{name}": lens for name, lens in LENSES.items()},
        "folding_lens": (-0.9, 0.0, 0.0, 0.0, 0.0),
    },
    _lens,
    phase=FILM,
)


def _focal(draft, rng, factor):
    name = some(draft, rng)
    camera = draft.cameras[name]
    draft.cameras[name] = replace(camera, focal=tuple(np.multiply(camera.focal, factor).tolist()))


kinds(
    "camera", {"wide_lens": 0.6, "long_lens": 1.4, "oblong_pixels": (1.0, 1.03)}, _focal, phase=FILM
)


def _place(draft, rng, place):
    name = some(draft, rng)
    middle = target_of(draft)
    camera = draft.cameras[name]
    way = (camera.center - middle)[:2] / np.linalg.norm((camera.center - middle)[:2])
    out, height, aim = place
    center = [*(middle[:2] + out * way), height]
    looked_at = middle + [*(aim * np.array([-way[1], way[0]])), 0.0]
    draft.cameras[name] = camera.looking(center, looked_at)


kinds(
    "camera",
    {
        "at_eye_level": (25.0, 1.6, 0.0),
        "among_the_people": (4.0, 1.7, 0.0),
        "far_away": (200.0, 30.0, 0.0),
        "looking_away": (25.0, 10.0, 500.0),
    },
    _place,
    phase=FILM,
)


def _count(draft, rng, count):
    names = list(draft.cameras)
    for name in names[count:]:
        remove(draft, name)
    middle = target_of(draft)
    while len(draft.cameras) < count:
        angle = rng.uniform(0, 2 * math.pi)
        place = middle + [28 * math.cos(angle), 28 * math.sin(angle), rng.uniform(8, 14)]
        put(draft, f"more{len(draft.cameras)}", draft.cameras[names[0]].looking(place, middle))


kinds("camera", {"three_cameras": 3}, _count, phase=FILM, harmless=True)
kinds("camera", {"one_camera": 1, "two_cameras": 2}, _count, phase=FILM)


@kind("camera", phase=FILM)
def two_cameras_at_one_place(draft, rng):
    put(draft, "twin", draft.cameras[some(draft, rng)])


@kind("camera", phase=FILM)
def all_cameras_on_one_side(draft, rng):
    middle = target_of(draft)
    for n, name in enumerate(list(draft.cameras)):
        place = middle + [0.5 * n - 1.0, -28.0, 10.0]
        draft.cameras[name] = draft.cameras[name].looking(place, middle)


@kind("camera", phase=FILM)
def mirrored_images(draft, rng):
    name = some(draft, rng)
    camera = draft.cameras[name]

    class FlipTest(Camera):
        def pixels(self, points):
            found = super().pixels(points)
            found[..., 0] = self.width - 1 - found[..., 0]
            return found

    draft.cameras[name] = FlipTest(**vars(camera))


# ------------------------------------------------------------------------- calibration.toml


def one_table(draft, rng):
    return draft.given[str(rng.choice(list(draft.given)))]


def tables(draft, rng, all_of_them):
    return list(draft.given.values()) if all_of_them else [one_table(draft, rng)]


def _lens_order(draft, rng, how):
    order, all_of_them = how
    for table in tables(draft, rng, all_of_them):
        table["distortions"] = [table["distortions"][i] for i in order]


kinds(
    "toml",
    {
        "one_lens_in_another_order": ((0, 1, 4, 2, 3), False),
        "all_lenses_in_another_order": ((0, 1, 4, 2, 3), True),
    },
    _lens_order,
    base="given",
)


IN_YARDS = 1.0936


def _scaled_entry(draft, rng, how):
    key, factor, all_of_them = how
    for table in tables(draft, rng, all_of_them):
        table[key] = np.multiply(table[key], factor).tolist()
    # In yards, short people are as tall as others in metres: the run states their stature.
    if factor == IN_YARDS and draft.people[..., 0, 2].mean() < 1.85 * 1.60 / 1.75:
        draft.truth = None


kinds(
    "toml",
    {
        "one_camera_in_millimetres": ("translation", 1000.0, False),
        "all_cameras_in_millimetres": ("translation", 1000.0, True),
        "all_cameras_in_yards": ("translation", IN_YARDS, True),
        "one_rotation_in_degrees": ("rotation", 57.29577951, False),
        "one_inverse_rotation": ("rotation", -1.0, False),
        "one_inverse_translation": ("translation", -1.0, False),
    },
    _scaled_entry,
    base="given",
)


def _focal_entry(draft, rng, how):
    factor, all_of_them = how
    for table in tables(draft, rng, all_of_them):
        for axis in (0, 1):
            table["matrix"][axis][axis] *= factor


kinds(
    "toml",
    {
        "one_focal_10_percent_long": (1.1, False),
        "one_focal_in_millimetres": (0.0055, False),
        "one_huge_focal": (1e5, False),
        "one_negative_focal": (-1.0, False),
        "one_infinite_focal": (math.inf, False),
    },
    _focal_entry,
    base="given",
)


def _entry(draft, rng, how):
    key, value = how
    table = one_table(draft, rng)
    table[key] = value(table[key]) if callable(value) else value


kinds(
    "toml",
    {
        "lens_of_four": ("distortions", lambda d: d[:4]),
        "translation_as_column": ("translation", lambda t: [[v] for v in t]),
        "rotation_as_matrix": ("rotation", lambda r: cv2.Rodrigues(np.array(r))[0].tolist()),
        "rounded_matrix": (
            "rotation",
            lambda r: np.round(cv2.Rodrigues(np.array(r))[0], 5).tolist(),
        ),
        "further_keys": ("error", 0.3),
    },
    _entry,
    base="given",
    harmless=True,
)


@kind("toml", base="given")
def rotation_transposed_as_matrix(draft, rng):
    table = one_table(draft, rng)
    table["rotation"] = cv2.Rodrigues(np.array(table["rotation"]))[0].T.tolist()


@kind("toml", base="given")
def axes_of_opengl(draft, rng):
    flip = np.diag([1.0, -1.0, -1.0])
    for table in draft.given.values():
        turned = flip @ cv2.Rodrigues(np.array(table["rotation"]))[0]
        table["rotation"] = turned.tolist()
        table["translation"] = (flip @ table["translation"]).tolist()


@kind("toml", base="given")
def two_cameras_exchanged(draft, rng):
    one, other = rng.choice(list(draft.given), 2, replace=False)
    draft.given[one]["name"], draft.given[other]["name"] = (
        draft.given[other]["name"],
        draft.given[one]["name"],
    )


@kind("toml", base="given", harmless=True)
def tables_in_another_order(draft, rng):
    names = list(draft.given)
    draft.given = {name: draft.given[name] for name in rng.permutation(names)}


def _move_world(draft, rotation, shift):
    """Every camera and truth in another world frame."""
    for table in draft.given.values():
        turned = cv2.Rodrigues(np.array(table["rotation"]))[0]
        table["translation"] = (table["translation"] - turned @ rotation.T @ shift).tolist()
        table["rotation"] = cv2.Rodrigues(turned @ rotation.T)[0].ravel().tolist()
    if draft.truth is not None:
        draft.truth = draft.truth @ rotation.T + shift


@kind("toml", base="given", harmless=True)
def world_100_km_off(draft, rng):
    _move_world(draft, np.eye(3), np.array([6e4, 8e4, 150.0]))


@kind("toml", base="given", harmless=True)
def world_turned(draft, rng):
    _move_world(draft, cv2.Rodrigues(np.array([0.0, 0.0, 1.1]))[0], np.array([3.0, -2.0, 0.0]))


@kind("toml", base="given")
def world_with_y_up(draft, rng):
    _move_world(draft, cv2.Rodrigues(np.array([-math.pi / 2, 0.0, 0.0]))[0], np.zeros(3))


@kind("toml", base="given")
def calibration_of_one_camera_missing(draft, rng):
    del draft.given[str(rng.choice(list(draft.given)))]


@kind("toml", base="given")
def calibration_of_a_further_camera(draft, rng):
    draft.given["more"] = {**one_table(draft, rng), "name": "more"}


@kind("toml", base="given")
def calibration_without_a_key(draft, rng):
    table = one_table(draft, rng)
    del table[str(rng.choice(["size", "matrix", "distortions", "rotation", "translation"]))]


# ------------------------------------------------------------------------------------ pitch


def _pitch(draft, rng, content):
    draft.pitch = content() if callable(content) else content


def _surveyed(scale=1.0):
    return {
        name: [round(v * scale, 4) for v in place]
        for name, place in law_points().items()
        if name.startswith(("corner", "penalty_area"))
    }


kinds(
    "pitch",
    {
        "standard_pitch_written_down": {"length": 105.0, "width": 68.0, "crown": 0.2},
        "pitch_of_whole_numbers": {"length": 105, "width": 68},
        "surveyed_points": lambda: {"points": _surveyed()},
    },
    _pitch,
    base="clicked",
    harmless=True,
)
kinds(
    "pitch",
    {
        "pitch_of_another_size": {"length": 100.0, "width": 64.0},
        "surveyed_mirrored": lambda: {
            "points": {name: [-x, y, z] for name, (x, y, z) in _surveyed().items()}
        },
        "surveyed_point_5_m_off": {"points": {"corner_left_near": [-47.5, -34.0, 0.0]}},
    },
    _pitch,
    base="clicked",
)


@kind("pitch", base="clicked")
def pitch_named_and_missing(draft, rng):
    draft.spec["pitch"] = "stadium.json"


@kind("pitch", base="clicked")
def no_pitch_but_clicks(draft, rng):
    draft.spec["pitch"] = "none"


@kind("pitch", base="given")
def pitch_beside_none(draft, rng):
    draft.pitch = {"length": 105.0, "width": 68.0}
