"""Kinds of mutation of a match: tables of small functions of a draft and of chance."""

import math
import re
from collections.abc import Callable
from dataclasses import dataclass, replace

import cv2
import numpy as np

from .scene import LINES, drawn_line, law_points

KINDS: dict = {}
FILM, DATA, FILES = "film", "data", "files"
"""When a kind strikes: before the cameras film, on clicks and detections, on written files."""


@dataclass(frozen=True)
class Kind:
    """One way to change something that was good.

    Attributes:
        group: camera, clicks, people, clips, ids, pitch, toml, bytes, video, store, request.
        apply: of the draft, or of the project for the last two groups, and a random generator.
        phase: when it strikes.
        base: the match that it needs: any, clicked, given, filmed, stored.
        harmless: a correct reader gives the right result all the same.
    """

    group: str
    apply: Callable
    phase: str
    base: str
    harmless: bool


def add(group, functions, *, phase=DATA, base="any", harmless=""):
    """Register functions by name; `harmless` names those whose result must be right, or all."""
    for name, apply in functions.items():
        assert name not in KINDS, name
        is_harmless = harmless == "all" or name in harmless.split()
        KINDS[name] = Kind(group, apply, phase, base, is_harmless)


def mutation(function):
    """Let a function of a draft, of chance, and of more be named in a table with what is more."""

    def stated(*values, **named):
        return lambda draft, rng: function(draft, rng, *values, **named)

    return stated


def one(rng, values):
    """One of the values, by chance."""
    values = list(values)
    return values[int(rng.integers(len(values)))]


# ------------------------------------------------------------ cameras that film otherwise


def middle_of(draft):
    return draft.people.reshape(-1, 3).mean(axis=0)


@mutation
def change(draft, rng, **values):
    """Change one camera; a function is of its former value."""
    name = one(rng, draft.cameras)
    camera = draft.cameras[name]
    new = {k: v(getattr(camera, k)) if callable(v) else v for k, v in values.items()}
    draft.cameras[name] = replace(camera, **new)


def focal(factor):
    return change(focal=lambda f: tuple(np.multiply(f, factor).tolist()))


@mutation
def scale(draft, rng, *factors):
    for name, factor in zip(list(draft.cameras), np.broadcast_to(factors, 4), strict=False):
        camera = draft.cameras[name]
        sizes = [max(1, round(side * factor)) for side in (camera.width, camera.height)]
        principal = tuple((c + 0.5) * factor - 0.5 for c in camera.principal)
        long = tuple(f * factor for f in camera.focal)
        draft.cameras[name] = replace(
            camera, width=sizes[0], height=sizes[1], focal=long, principal=principal
        )
    draft.pixel_noise *= min(1.0, *factors)
    draft.click_noise *= min(1.0, *factors)


@mutation
def roll(draft, rng, angle):
    name = one(rng, draft.cameras)
    camera = draft.cameras[name]
    draft.cameras[name] = camera.looking(camera.center, middle_of(draft), roll=angle)


@mutation
def place(draft, rng, out, height, aside):
    """Put a camera so far from the people, and let it look past them [m]."""
    name, middle = one(rng, draft.cameras), middle_of(draft)
    camera = draft.cameras[name]
    way = (camera.center - middle)[:2] / np.linalg.norm((camera.center - middle)[:2])
    aim = middle + [-aside * way[1], aside * way[0], 0.0]
    draft.cameras[name] = camera.looking([*(middle[:2] + out * way), height], aim)


def put(draft, name, camera):
    """Add a camera to the match."""
    draft.cameras[name] = camera
    draft.spec["cameras"].append({"id": name, "width": camera.width, "height": camera.height})


@mutation
def count_of(draft, rng, count):
    for name in list(draft.cameras)[count:]:
        del draft.cameras[name]
    draft.spec["cameras"] = draft.spec["cameras"][:count]


BARREL, SIXTH = (-0.15, 0.03, 0.0, 0.0, 0.0), (-0.2, 0.08, 0.0, 0.0, -0.02)
CAMERAS = {
    "one_smaller_image": scale(2 / 3, 1, 1, 1),
    "mixed_image_sizes": scale(2 / 3, 4 / 3, 1, 2),
    "image_of_8k": scale(4, 1, 1, 1),
    "images_of_160_by_90": scale(*[1 / 12] * 4),
    "rolled_by_90": roll(math.pi / 2),
    "upside_down": roll(math.pi),
    "clicked_barrel_lens": change(distortion=BARREL),
    "clicked_sixth_order_lens": change(distortion=SIXTH),
    "folding_lens": change(distortion=(-0.9, 0.0, 0.0, 0.0, 0.0)),
    "wide_lens": focal(0.6),
    "long_lens": focal(1.4),
    "oblong_pixels": focal((1.0, 1.03)),
    "at_eye_level": place(25.0, 1.6, 0.0),
    "among_the_people": place(4.0, 1.7, 0.0),
    "far_away": place(200.0, 30.0, 0.0),
    "looking_away": place(25.0, 10.0, 500.0),
    "one_camera": count_of(1),
    "two_cameras": count_of(2),
    "three_cameras": count_of(3),
    "two_cameras_at_one_place": lambda d, r: put(d, "twin", d.cameras[one(r, d.cameras)]),
}
RIGHT_CAMERAS = "one_smaller_image mixed_image_sizes image_of_8k rolled_by_90 upside_down"
add("camera", CAMERAS, phase=FILM, harmless=f"{RIGHT_CAMERAS} three_cameras")
lenses = {"barrel_lens": change(distortion=BARREL), "sixth_order_lens": change(distortion=SIXTH)}
add("camera", lenses, phase=FILM, base="given", harmless="all")

# ------------------------------------------------------------- calibration.toml and pitch


@mutation
def table(draft, rng, change, everywhere=False):
    """Change one table of the calibration, or all."""
    every = list(draft.given.values())
    for each in every if everywhere else [one(rng, every)]:
        change(each)


def entry(key, value, everywhere=False):
    """Replace an entry; a function is of its former value."""
    return table(lambda t: t.update({key: value(t[key]) if callable(value) else value}), everywhere)


def times(key, factor, everywhere=False):
    return entry(key, lambda v: np.multiply(v, factor).tolist(), everywhere)


def focal_entry(factor):
    return entry(
        "matrix", lambda m: (np.array(m) * [[factor, 1, 1], [1, factor, 1], [1] * 3]).tolist()
    )


def matrix_of(rotation):
    return cv2.Rodrigues(np.array(rotation))[0]


def world(turn, shift=(0.0, 0.0, 0.0)):
    """Every camera and truth in another world frame."""

    def apply(draft, rng):
        rotation = matrix_of(turn)
        for each in draft.given.values():
            turned = matrix_of(each["rotation"]) @ rotation.T
            each["translation"] = (each["translation"] - turned @ np.array(shift)).tolist()
            each["rotation"] = cv2.Rodrigues(turned)[0].ravel().tolist()
        if draft.truth is not None:
            draft.truth = draft.truth @ rotation.T + shift

    return apply


def exchange(content, rng, key=None):
    """Exchange the entries of two cameras, or one value of theirs."""
    if len(content) > 1:
        a, b = rng.choice(list(content), 2, replace=False)
        if key is None:
            content[a], content[b] = content[b], content[a]
        else:
            content[a][key], content[b][key] = content[b][key], content[a][key]


KEYS = ("size", "matrix", "distortions", "rotation", "translation")
TABLES = {
    "one_lens_in_another_order": entry("distortions", lambda d: [*d[:2], d[4], *d[2:4]]),
    "one_camera_in_millimetres": times("translation", 1000.0),
    "all_cameras_in_millimetres": times("translation", 1000.0, True),
    "one_rotation_in_degrees": times("rotation", 57.29577951),
    "one_inverse_rotation": times("rotation", -1.0),
    "one_inverse_translation": times("translation", -1.0),
    "one_focal_10_percent_long": focal_entry(1.1),
    "one_focal_in_millimetres": focal_entry(0.0055),
    "one_huge_focal": focal_entry(1e5),
    "one_negative_focal": focal_entry(-1.0),
    "one_infinite_focal": focal_entry(1e400),
    "rotation_transposed_as_matrix": entry("rotation", lambda r: matrix_of(r).T.tolist()),
    "two_cameras_exchanged": lambda d, r: exchange(d.given, r, "name"),
    "world_with_y_up": world((-math.pi / 2, 0.0, 0.0)),
    "calibration_of_one_camera_missing": lambda d, r: d.given.pop(one(r, d.given)),
    "calibration_of_a_further_camera": lambda d, r: d.given.update(
        more={**one(r, d.given.values()), "name": "more"}
    ),
    "calibration_without_a_key": lambda d, r: one(r, d.given.values()).pop(one(r, KEYS), None),
}
add("toml", TABLES, base="given")
RIGHT_TABLES = {
    "lens_of_four": entry("distortions", lambda lens: lens[:4]),
    "translation_as_column": entry("translation", lambda t: [[v] for v in t]),
    "rotation_as_matrix": entry("rotation", lambda r: matrix_of(r).tolist()),
    "rounded_matrix": entry("rotation", lambda r: matrix_of(r).round(5).tolist()),
    "further_keys": entry("error", 0.3),
    "world_100_km_off": world((0.0, 0.0, 0.0), (6e4, 8e4, 150.0)),
    "world_turned": world((0.0, 0.0, 1.1), (3.0, -2.0, 0.0)),
}
add("toml", RIGHT_TABLES, base="given", harmless="all")


def pitch(**content):
    return lambda draft, rng: setattr(draft, "pitch", content)


SURVEY = {
    name: place for name, place in law_points().items() if re.match("corner|penalty_area", name)
}
PITCHES = {
    "standard_pitch_written_down": pitch(length=105.0, width=68.0, crown=0.2),
    "pitch_of_whole_numbers": pitch(length=105, width=68),
    "surveyed_points": pitch(points={n: np.round(p, 4).tolist() for n, p in SURVEY.items()}),
    "pitch_of_another_size": pitch(length=100.0, width=64.0),
    "surveyed_mirrored": pitch(points={n: [-x, y, z] for n, (x, y, z) in SURVEY.items()}),
    "surveyed_point_5_m_off": pitch(points={"corner_left_near": [-47.5, -34.0, 0.0]}),
    "pitch_named_and_missing": lambda d, r: d.spec.update(pitch="stadium.json"),
    "no_pitch_but_clicks": lambda d, r: d.spec.update(pitch="none"),
}
RIGHT_PITCHES = "standard_pitch_written_down pitch_of_whole_numbers surveyed_points"
add("pitch", PITCHES, base="clicked", harmless=RIGHT_PITCHES)
add("pitch", {"pitch_beside_none": pitch(length=105.0, width=68.0)}, base="given")

# ------------------------------------------------------------------------------- clicks


def points_of(draft, rng):
    """The clicked points of a camera; never empty."""
    filled = [each["points"] for each in draft.clicks.values() if each.get("points")]
    return one(rng, filled or [[{"name": "x", "xy": [1.0, 1.0]}]])


SIDES, ENDS = {"left": "right", "right": "left"}, {"near": "far", "far": "near"}


@mutation
def rename(draft, rng, words, everywhere=False):
    """Exchange words in the names of points, in one camera or in all."""
    every = [content["points"] for content in draft.clicks.values()]
    for points in every if everywhere else [points_of(draft, rng)]:
        for point in points:
            parts = point["name"].split("_")
            point["name"] = "_".join(words.get(part, part) for part in parts)


def turn_pitch(draft, rng):
    rename(SIDES | ENDS, True)(draft, rng)
    draft.truth = draft.people * [-1.0, -1.0, 1.0]


@mutation
def noise(draft, rng, size, share=1.0):
    for point in points_of(draft, rng):
        if rng.random() < share:
            xy = np.add(point["xy"], rng.normal(0, size, 2))
            point["xy"] = np.clip(xy, 0, None).round(2).tolist()


@mutation
def move_clicks(draft, rng, change):
    """Move the clicks of one camera."""
    name = one(rng, draft.clicks)
    for point in draft.clicks[name]["points"]:
        point["xy"] = [float(v) for v in change(point["xy"], draft.cameras[name])]


def shuffle_clicks(draft, rng):
    for content in draft.clicks.values():
        rng.shuffle(content["points"])


@mutation
def few_clicks(draft, rng, count):
    del points_of(draft, rng)[count:]


@mutation
def draw(draft, rng, count, *, is_wrong=False, alone=False):
    for name, content in draft.clicks.items():
        for line in LINES:
            if pixels := drawn_line(draft, draft.cameras[name], line, count, rng):
                called = one(rng, sorted(LINES.keys() - {line})) if is_wrong else line
                if called not in [each["name"] for each in content["drawn"]]:
                    content["drawn"].append({"name": called, "xy": pixels})
                break
        if alone:
            content["points"] = []


UNKNOWN = {"name": "sideline", "xy": [[1.0, 2.0]]}
CLICKS = {
    "left_for_right_in_one_camera": rename(SIDES),
    "left_for_right_in_all_cameras": rename(SIDES, True),
    "wrong_end_in_one_camera": rename(SIDES | ENDS),
    "pitch_turned_in_all_cameras": turn_pitch,
    "clicks_of_10_px_noise": noise(10.0),
    "clicks_anywhere": noise(400.0),
    "slips": noise(200.0, 0.1),
    "clicks_on_whole_pixels": move_clicks(lambda xy, c: np.round(xy)),
    "clicks_counted_from_half_a_pixel": move_clicks(lambda xy, c: np.add(xy, 0.5)),
    "clicks_mirrored": move_clicks(lambda xy, c: (c.width - 1 - xy[0], xy[1])),
    "clicks_with_x_and_y_exchanged": move_clicks(lambda xy, c: (xy[1], min(xy[0], c.height - 1))),
    "clicks_from_0_to_1": move_clicks(lambda xy, c: (xy[0] / c.width, xy[1] / c.height)),
    "clicks_all_at_one_place": move_clicks(lambda xy, c: (500.0, 500.0)),
    "clicks_on_one_line": move_clicks(lambda xy, c: (xy[0], 400.0)),
    "clicks_in_another_order": shuffle_clicks,
    **{f"{count}_clicks": few_clicks(count) for count in (0, 1, 3, 4, 6)},
    "clicks_of_two_cameras_exchanged": lambda d, r: exchange(d.clicks, r),
    "clicks_of_one_camera_missing": lambda d, r: d.clicks.pop(one(r, d.clicks)),
    "click_twice": lambda d, r: (points := points_of(d, r)).append(dict(points[0])),
    "drawn_marking_unknown": lambda d, r: one(r, d.clicks.values())["drawn"].append(UNKNOWN),
    "drawn_lines": draw(12),
    "drawn_lines_of_two_pixels": draw(2),
    "drawn_lines_of_wrong_names": draw(12, is_wrong=True),
    "drawn_lines_alone": draw(12, alone=True),
    "drawn_lines_of_20000_pixels": draw(20000),
}
RIGHT_CLICKS = "pitch_turned_in_all_cameras clicks_on_whole_pixels clicks_in_another_order"
RIGHT_CLICKS += " clicks_counted_from_half_a_pixel drawn_lines drawn_lines_of_two_pixels"
add("clicks", CLICKS, base="clicked", harmless=RIGHT_CLICKS)
