"""Clicks that are not as they should be."""

import numpy as np

from .kinds import drop, exchange, kind, kinds, one
from .scene import LINES, drawn_line, law_points


def points_of(draft, rng):
    """The clicked points of a camera; never empty."""
    filled = [each["points"] for each in draft.clicks.values() if each.get("points")]
    return filled[int(rng.integers(len(filled)))] if filled else [{"name": "x", "xy": [1.0, 1.0]}]


SIDES = {"left": "right", "right": "left"}
ENDS = {"near": "far", "far": "near"}


def _rename(draft, rng, how):
    """Exchange words in the names of points, in one camera or in all."""
    words, is_everywhere = how
    every = [content["points"] for content in draft.clicks.values()]
    for points in every if is_everywhere else [points_of(draft, rng)]:
        for point in points:
            parts = point["name"].split("_")
            point["name"] = "_".join(words.get(part, part) for part in parts)


kinds(
    "clicks",
    {
        "left_for_right_in_one_camera": (SIDES, False),
        "left_for_right_in_all_cameras": (SIDES, True),
        "wrong_end_in_one_camera": (SIDES | ENDS, False),
    },
    _rename,
    base="clicked",
)


@kind("clicks", base="clicked", harmless=True)
def pitch_turned_in_all_cameras(draft, rng):
    _rename(draft, rng, (SIDES | ENDS, True))
    draft.truth = draft.people * [-1.0, -1.0, 1.0]


@kind("clicks", base="clicked")
def one_click_of_another_name(draft, rng):
    points = points_of(draft, rng)
    free = sorted(law_points().keys() - {point["name"] for point in points})
    if free:
        one(rng, points)["name"] = one(rng, free)


def _noise(draft, rng, how):
    size, share = how
    for point in points_of(draft, rng):
        if rng.random() < share:
            xy = np.add(point["xy"], rng.normal(0, size, 2))
            point["xy"] = np.clip(xy, 0, None).round(2).tolist()


kinds(
    "clicks",
    {"clicks_of_10_px_noise": (10.0, 1.0), "clicks_anywhere": (400.0, 1.0), "slips": (200.0, 0.1)},
    _noise,
    base="clicked",
)


def _move_clicks(draft, rng, change):
    """Move the clicks of one camera."""
    name = str(rng.choice(list(draft.clicks)))
    for point in draft.clicks[name]["points"]:
        point["xy"] = [float(v) for v in change(point["xy"], draft.cameras[name])]


kinds(
    "clicks",
    {
        "clicks_on_whole_pixels": lambda xy, c: np.round(xy),
        "clicks_counted_from_half_a_pixel": lambda xy, c: np.add(xy, 0.5),
    },
    _move_clicks,
    base="clicked",
    harmless=True,
)
kinds(
    "clicks",
    {
        "clicks_mirrored": lambda xy, c: (c.width - 1 - xy[0], xy[1]),
        "clicks_with_x_and_y_exchanged": lambda xy, c: (xy[1], min(xy[0], c.height - 1)),
        "clicks_from_0_to_1": lambda xy, c: (xy[0] / c.width, xy[1] / c.height),
        "clicks_all_at_one_place": lambda xy, c: (500.0, 500.0),
        "clicks_on_one_line": lambda xy, c: (xy[0], 400.0),
    },
    _move_clicks,
    base="clicked",
)


@kind("clicks", base="clicked", harmless=True)
def clicks_in_another_order(draft, rng):
    for content in draft.clicks.values():
        content["points"] = [content["points"][i] for i in rng.permutation(len(content["points"]))]


def _few(draft, rng, count):
    del points_of(draft, rng)[count:]


kinds("clicks", {f"{count}_clicks": count for count in (0, 1, 3, 4, 6)}, _few, base="clicked")


kinds(
    "clicks",
    {
        "clicks_of_two_cameras_exchanged": lambda draft, rng: exchange(draft.clicks, rng),
        "clicks_of_one_camera_missing": lambda draft, rng: drop(draft.clicks, rng),
        "click_twice": lambda draft, rng: (points := points_of(draft, rng)).append(dict(points[0])),
        "drawn_marking_unknown": lambda draft, rng: one(rng, list(draft.clicks.values()))[
            "drawn"
        ].append({"name": "sideline", "xy": [[1.0, 2.0]]}),
    },
    lambda draft, rng, act: act(draft, rng),
    base="clicked",
)


def _draw(draft, rng, how):
    count, is_wrong, keep_points = how
    for name, content in draft.clicks.items():
        for line in LINES:
            pixels = drawn_line(draft, draft.cameras[name], line, count, rng)
            if pixels:
                called = one(rng, [each for each in LINES if each != line]) if is_wrong else line
                if called not in [each["name"] for each in content["drawn"]]:
                    content["drawn"].append({"name": called, "xy": pixels})
                break
        if not keep_points:
            content["points"] = []


kinds(
    "clicks",
    {"drawn_lines": (12, False, True), "drawn_lines_of_two_pixels": (2, False, True)},
    _draw,
    base="clicked",
    harmless=True,
)
kinds(
    "clicks",
    {
        "drawn_lines_of_wrong_names": (12, True, True),
        "drawn_lines_alone": (12, False, False),
        "drawn_lines_of_20000_pixels": (20000, False, True),
    },
    _draw,
    base="clicked",
)
