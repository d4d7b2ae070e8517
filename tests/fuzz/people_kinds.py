"""Clicks, detections, clips, clocks and names that are not as they should be."""

import math

import numpy as np

from .camera_kinds import put, some
from .kinds import FILM, kind, kinds
from .scene import FRAMES, LINES, drawn_line, law_points

# ------------------------------------------------------------------------------------ clicks


def points_of(draft, rng):
    """The clicked points of a camera; never empty."""
    filled = [each["points"] for each in draft.clicks.values() if each.get("points")]
    return filled[int(rng.integers(len(filled)))] if filled else [{"name": "x", "xy": [1.0, 1.0]}]


def one(rng, values):
    return values[int(rng.integers(len(values)))]


def _rename(draft, rng, how):
    pairs, all_cameras = how
    chosen = (
        [c["points"] for c in draft.clicks.values()] if all_cameras else [points_of(draft, rng)]
    )
    for points in chosen:
        for point in points:
            for a, b in pairs:
                if a in point["name"]:
                    point["name"] = point["name"].replace(a, b)
                    break
                if b in point["name"]:
                    point["name"] = point["name"].replace(b, a)
                    break


kinds(
    "clicks",
    {
        "left_for_right_in_one_camera": ([("left", "right")], False),
        "near_for_far_in_one_camera": ([("near", "far")], False),
        "left_for_right_in_all_cameras": ([("left", "right")], True),
    },
    _rename,
    base="clicked",
)


def _turn_names(draft, points):
    for point in points:
        name = point["name"]
        for a, b in (("left", "right"), ("near", "far")):
            name = name.replace(a, "?").replace(b, a).replace("?", b)
        point["name"] = name


@kind("clicks", base="clicked")
def wrong_end_in_one_camera(draft, rng):
    _turn_names(draft, points_of(draft, rng))


@kind("clicks", base="clicked", harmless=True)
def pitch_turned_in_all_cameras(draft, rng):
    for content in draft.clicks.values():
        _turn_names(draft, content["points"])
    draft.truth = draft.people * [-1.0, -1.0, 1.0]


@kind("clicks", base="clicked")
def two_names_exchanged(draft, rng):
    points = points_of(draft, rng)
    a, b = one(rng, points), one(rng, points)
    a["name"], b["name"] = b["name"], a["name"]


@kind("clicks", base="clicked")
def one_click_of_another_name(draft, rng):
    points = points_of(draft, rng)
    free = sorted(law_points().keys() - {point["name"] for point in points})
    if free:
        one(rng, points)["name"] = one(rng, free)


@kind("clicks", base="clicked")
def a_click_on_what_is_behind(draft, rng):
    name = str(rng.choice(list(draft.clicks)))
    camera = draft.cameras[name]
    behind = [
        each
        for each, place in law_points().items()
        if camera.rotation[2] @ place + camera.translation[2] < 0
    ]
    if behind:
        xy = [camera.width / 2.0, camera.height / 2.0]
        draft.clicks[name]["points"].append({"name": one(rng, behind), "xy": xy})


def _noise(draft, rng, how):
    size, share = how
    for point in points_of(draft, rng):
        if rng.random() < share:
            xy = np.add(point["xy"], rng.normal(0, size, 2))
            point["xy"] = np.clip(xy, 0, None).round(2).tolist()


kinds(
    "clicks",
    {
        "clicks_of_3_px_noise": (3.0, 1.0),
        "clicks_of_10_px_noise": (10.0, 1.0),
        "clicks_anywhere": (400.0, 1.0),
        "a_few_slips": (60.0, 0.2),
    },
    _noise,
    base="clicked",
)


def _slip(draft, rng, size):
    point = one(rng, points_of(draft, rng))
    angle = rng.uniform(0, 2 * math.pi)
    point["xy"] = [
        max(0.0, point["xy"][0] + size * math.cos(angle)),
        max(0.0, point["xy"][1] + size * math.sin(angle)),
    ]


kinds("clicks", {"a_slip_of_30_px": 30.0, "a_slip_of_200_px": 200.0}, _slip, base="clicked")


def _each_click(draft, rng, change):
    for content in draft.clicks.values():
        for point in content["points"]:
            point["xy"] = [float(v) for v in change(point["xy"])]


kinds(
    "clicks",
    {
        "clicks_on_whole_pixels": lambda xy: np.round(xy),
        "clicks_counted_from_half_a_pixel": lambda xy: np.add(xy, 0.5),
    },
    _each_click,
    base="clicked",
    harmless=True,
)


@kind("clicks", base="clicked", harmless=True)
def clicks_in_another_order(draft, rng):
    for content in draft.clicks.values():
        content["points"] = [content["points"][i] for i in rng.permutation(len(content["points"]))]


def _camera_clicks(draft, rng, change):
    name = str(rng.choice(list(draft.clicks)))
    for point in draft.clicks[name]["points"]:
        point["xy"] = [float(v) for v in change(point["xy"], draft.cameras[name])]


kinds(
    "clicks",
    {
        "clicks_upside_down": lambda xy, c: (xy[0], c.height - 1 - xy[1]),
        "clicks_mirrored": lambda xy, c: (c.width - 1 - xy[0], xy[1]),
        "clicks_with_x_and_y_exchanged": lambda xy, c: (xy[1], min(xy[0], c.height - 1)),
        "clicks_at_half_size": lambda xy, c: (xy[0] / 2, xy[1] / 2),
        "clicks_from_0_to_1": lambda xy, c: (xy[0] / c.width, xy[1] / c.height),
        "clicks_all_at_one_place": lambda xy, c: (500.0, 500.0),
        "clicks_on_one_line": lambda xy, c: (xy[0], 400.0),
        "clicks_shifted": lambda xy, c: (min(xy[0] + 40, c.width), xy[1]),
    },
    _camera_clicks,
    base="clicked",
)


def _few(draft, rng, count):
    points = points_of(draft, rng)
    del points[count:]


kinds(
    "clicks",
    {f"{count}_clicks": count for count in (0, 1, 2, 3, 4, 5, 6)},
    _few,
    base="clicked",
)


@kind("clicks", base="clicked")
def collinear_clicks_alone(draft, rng):
    for content in draft.clicks.values():
        kept = [
            p for p in content["points"] if "touch" in p["name"] or p["name"].endswith("_near_back")
        ]
        kept += [p for p in content["points"] if p["name"].startswith(("halfway", "center"))]
        content["points"] = kept or content["points"][:2]


@kind("clicks", base="clicked")
def clicks_of_one_corner(draft, rng):
    points = points_of(draft, rng)
    middle = one(rng, points)["xy"]
    points.sort(key=lambda point: math.dist(point["xy"], middle))
    del points[6:]


@kind("clicks", base="clicked")
def clicks_of_two_cameras_exchanged(draft, rng):
    a, b = rng.choice(list(draft.clicks), 2, replace=False) if len(draft.clicks) > 1 else ("", "")
    if a:
        draft.clicks[a], draft.clicks[b] = draft.clicks[b], draft.clicks[a]


@kind("clicks", base="clicked")
def clicks_of_one_camera_missing(draft, rng):
    del draft.clicks[str(rng.choice(list(draft.clicks)))]


@kind("clicks", base="clicked")
def clicks_of_no_camera(draft, rng):
    draft.clicks["nobody"] = {"points": points_of(draft, rng)}


@kind("clicks", base="clicked")
def click_twice(draft, rng):
    points = points_of(draft, rng)
    points.append(dict(points[0]))


@kind("clicks", base="clicked")
def two_names_at_one_place(draft, rng):
    points = points_of(draft, rng)
    points[-1]["xy"] = list(points[0]["xy"])


def _click_entry(draft, rng, how):
    key, value = how
    points_of(draft, rng)[0][key] = value


kinds(
    "clicks",
    {
        "click_of_unknown_name": ("name", "corner_left_nera"),
        "click_of_capital_name": ("name", "CORNER_LEFT_NEAR"),
        "click_of_umlaut": ("name", "Eckfahne-süd"),
        "click_of_empty_name": ("name", ""),
        "click_of_a_number": ("name", 7),
        "click_outside": ("xy", [5000.0, 20.0]),
        "click_of_negative_place": ("xy", [-40.0, 20.0]),
        "click_of_text": ("xy", ["10", "20"]),
        "click_of_null": ("xy", None),
        "click_of_one_number": ("xy", [4.0]),
        "click_of_three_numbers": ("xy", [4.0, 5.0, 6.0]),
        "click_of_nan": ("xy", [math.nan, 4.0]),
        "click_of_infinity": ("xy", [math.inf, 4.0]),
        "click_beyond_numbers": ("xy", [10**400, 4.0]),
        "click_of_mapping": ("xy", {"x": 4.0, "y": 5.0}),
        "click_with_a_note": ("note", "unsure"),
    },
    _click_entry,
    base="clicked",
)


def _draw(draft, rng, how):
    count, noise, wrong_name, keep_points = how
    for name, content in draft.clicks.items():
        for line in LINES:
            pixels = drawn_line(draft, draft.cameras[name], line, count, rng, noise)
            if pixels:
                called = line
                if wrong_name:
                    called = one(rng, [each for each in LINES if each != line])
                if called not in [each["name"] for each in content["drawn"]]:
                    content["drawn"].append({"name": called, "xy": pixels})
                break
        if not keep_points:
            content["points"] = []


kinds(
    "clicks",
    {"drawn_lines": (12, 0.6, False, True), "drawn_lines_of_two_pixels": (2, 0.6, False, True)},
    _draw,
    base="clicked",
    harmless=True,
)
kinds(
    "clicks",
    {
        "drawn_lines_of_wrong_names": (12, 0.6, True, True),
        "drawn_lines_alone": (12, 0.6, False, False),
        "drawn_lines_of_one_pixel": (1, 0.6, False, True),
        "drawn_lines_of_3000_pixels": (3000, 0.6, False, True),
        "drawn_lines_of_20000_pixels": (20000, 0.6, False, True),
        "drawn_lines_of_10_px_noise": (60, 10.0, False, True),
    },
    _draw,
    base="clicked",
)


@kind("clicks", base="clicked")
def drawn_marking_unknown(draft, rng):
    one(rng, list(draft.clicks.values()))["drawn"].append({"name": "sideline", "xy": [[1.0, 2.0]]})


@kind("clicks", base="clicked")
def drawn_marking_without_pixels(draft, rng):
    one(rng, list(draft.clicks.values()))["drawn"].append({"name": "halfway_line", "xy": []})


@kind("clicks", base="clicked")
def drawn_marking_outside(draft, rng):
    one(rng, list(draft.clicks.values()))["drawn"].append(
        {"name": "halfway_line", "xy": [[1.0, 2.0], [9999.0, 3.0]]}
    )


# -------------------------------------------------------------------------------- detections


def arrays_of(draft, rng):
    return draft.seen[str(rng.choice(list(draft.seen)))]


def each_of(draft, rng, all_cameras):
    return list(draft.seen.values()) if all_cameras else [arrays_of(draft, rng)]


def hide(arrays, mask):
    """Take people (frames, detections) away."""
    for name in ("keypoints", "confidence", "boxes", "score"):
        arrays[name][mask] = np.nan


def _missing(draft, rng, how):
    share, all_cameras = how
    for arrays in each_of(draft, rng, all_cameras):
        hide(arrays, rng.random(arrays["score"].shape) < share)


kinds(
    "people",
    {
        "people_missed_at_times": (0.1, True),
        "nobody_in_one_camera": (1.0, False),
    },
    _missing,
    harmless=True,
)
kinds("people", {"half_of_the_people_missed": (0.5, True), "nobody_at_all": (1.0, True)}, _missing)


def _joints_missing(draft, rng, share):
    for arrays in draft.seen.values():
        gone = rng.random(arrays["confidence"].shape) < share
        arrays["keypoints"][gone] = np.nan
        arrays["confidence"][gone] = np.nan
        empty = np.isnan(arrays["confidence"]).all(axis=-1)
        hide(arrays, empty)


kinds("people", {"joints_missed_at_times": 0.1}, _joints_missing, harmless=True)
kinds("people", {"most_joints_missed": 0.8}, _joints_missing)


def more(arrays, count):
    """Room for more people."""
    for name in ("keypoints", "confidence", "boxes", "score"):
        shape = list(arrays[name].shape)
        shape[1] = count
        arrays[name] = np.concatenate([arrays[name], np.full(shape, np.nan)], axis=1)


def _false_people(draft, rng, how):
    count, all_cameras = how
    for arrays in each_of(draft, rng, all_cameras):
        shape = arrays["score"].shape
        more(arrays, count)
        at = rng.uniform([0, 0], [1900, 1000], (shape[0], count, 1, 2))
        pixels = at + rng.normal(0, 25, (shape[0], count, 17, 2))
        arrays["keypoints"][:, shape[1] :] = pixels
        arrays["confidence"][:, shape[1] :] = rng.uniform(0.3, 0.6, pixels.shape[:-1])
        arrays["score"][:, shape[1] :] = 0.5
        arrays["boxes"][:, shape[1] :] = np.concatenate(
            [pixels.min(axis=2) - 5, pixels.max(axis=2) + 5], axis=-1
        )


kinds("people", {"three_false_people": (3, False)}, _false_people, harmless=True)
kinds(
    "people",
    {
        "false_people_everywhere": (6, True),
        "40_false_people": (40, False),
        "300_false_people": (300, False),
        "1500_false_people": (1500, False),
    },
    _false_people,
)


@kind("people")
def everybody_twice(draft, rng):
    for arrays in draft.seen.values():
        for name in ("keypoints", "confidence", "boxes", "score"):
            arrays[name] = np.concatenate([arrays[name]] * 2, axis=1)


@kind("people")
def everybody_a_hundred_times(draft, rng):
    arrays = arrays_of(draft, rng)
    for name in ("keypoints", "confidence", "boxes", "score"):
        arrays[name] = np.concatenate([arrays[name]] * 100, axis=1)


@kind("people", harmless=True)
def room_for_absent_people(draft, rng):
    for arrays in draft.seen.values():
        more(arrays, 20)


@kind("people")
def room_for_2000_absent_people(draft, rng):
    more(arrays_of(draft, rng), 2000)


@kind("people", harmless=True)
def people_in_another_order(draft, rng):
    for arrays in draft.seen.values():
        order = rng.permutation(arrays["score"].shape[1])
        for name in ("keypoints", "confidence", "boxes", "score"):
            arrays[name] = arrays[name][:, order]


@kind("people", harmless=True)
def as_coco_results(draft, rng):
    draft.coco = True


@kind("people", harmless=True)
def all_equally_confident(draft, rng):
    for arrays in draft.seen.values():
        arrays["confidence"][np.isfinite(arrays["confidence"])] = 0.9


@kind("people")
def hardly_confident(draft, rng):
    for arrays in draft.seen.values():
        arrays["confidence"] *= 1e-3


def _noisy(draft, rng, how):
    size, share, all_cameras = how
    for arrays in each_of(draft, rng, all_cameras):
        mask = rng.random(arrays["confidence"].shape) < share
        arrays["keypoints"] += mask[..., None] * rng.normal(0, size, arrays["keypoints"].shape)


kinds(
    "people",
    {
        "keypoints_of_3_px_noise": (3.0, 1.0, True),
        "a_tenth_of_keypoints_astray": (60.0, 0.1, True),
    },
    _noisy,
    harmless=True,
)
kinds(
    "people",
    {
        "keypoints_of_20_px_noise": (20.0, 1.0, True),
        "keypoints_anywhere_in_one_camera": (500.0, 1.0, False),
        "keypoints_anywhere": (500.0, 1.0, True),
    },
    _noisy,
)


def _pixels(draft, rng, how):
    change, all_cameras = how
    for arrays in each_of(draft, rng, all_cameras):
        arrays["keypoints"] = change(arrays["keypoints"])
        low, high = change(arrays["boxes"][..., :2]), change(arrays["boxes"][..., 2:])
        arrays["boxes"] = np.concatenate([np.minimum(low, high), np.maximum(low, high)], axis=-1)


kinds(
    "people",
    {
        "people_at_half_size": (lambda p: p / 2, False),
        "people_from_0_to_1": (lambda p: p / [1920, 1080], True),
        "people_with_x_and_y_exchanged": (lambda p: p[..., ::-1], False),
        "people_mirrored": (lambda p: [1919, 0] + p * [-1, 1], False),
        "people_shifted_by_30_px": (lambda p: p + [30, 0], False),
        "people_at_one_pixel": (lambda p: p * 0 + 500, False),
        "people_a_million_pixels_off": (lambda p: p + 9.9e5, False),
        "people_beyond_belief": (lambda p: p + 1e12, False),
        "people_of_infinity": (lambda p: p + np.inf, False),
        "people_beside_their_images": (lambda p: p - 3000, True),
    },
    _pixels,
)


def _one_value(draft, rng, how):
    name, value = how
    arrays = arrays_of(draft, rng)
    found = np.argwhere(np.isfinite(arrays[name]))
    if len(found):
        arrays[name][tuple(found[int(rng.integers(len(found)))])] = value


kinds(
    "people",
    {
        "a_keypoint_of_nan": ("keypoints", np.nan),
        "a_keypoint_of_infinity": ("keypoints", np.inf),
        "a_huge_keypoint": ("keypoints", 1e30),
        "a_confidence_of_zero": ("confidence", 0.0),
        "a_confidence_of_two": ("confidence", 2.0),
        "a_confidence_of_nan": ("confidence", np.nan),
        "a_negative_confidence": ("confidence", -0.5),
        "a_box_of_nan": ("boxes", np.nan),
        "a_box_of_infinity": ("boxes", np.inf),
        "a_score_of_nan": ("score", np.nan),
        "a_negative_score": ("score", -1.0),
        "a_huge_score": ("score", 1e30),
    },
    _one_value,
)
kinds("people", {"a_box_inside_out": None}, lambda draft, rng, _: _swap_box(draft, rng))


def _swap_box(draft, rng):
    arrays = arrays_of(draft, rng)
    arrays["boxes"] = arrays["boxes"][..., [2, 3, 0, 1]]


@kind("people")
def boxes_as_large_as_images(draft, rng):
    for arrays in draft.seen.values():
        arrays["boxes"][np.isfinite(arrays["boxes"])] = 0.0
        arrays["boxes"][..., 2:] += [1920.0, 1080.0]


SIDES = [0, 2, 1, 4, 3, 6, 5, 8, 7, 10, 9, 12, 11, 14, 13, 16, 15]


def _joint_order(draft, rng, how):
    order, all_cameras = how
    for arrays in each_of(draft, rng, all_cameras):
        for name in ("keypoints", "confidence"):
            arrays[name] = arrays[name][:, :, order]


kinds(
    "people",
    {
        "left_for_right_in_people_of_one_camera": (SIDES, False),
        "joints_of_another_order": (list(range(16, -1, -1)), True),
        "joints_of_another_order_in_one_camera": (list(range(16, -1, -1)), False),
    },
    _joint_order,
)


@kind("people")
def only_one_frame(draft, rng):
    for arrays in draft.seen.values():
        for name, values in arrays.items():
            arrays[name] = values[4:5]


@kind("people")
def frames_in_another_order(draft, rng):
    arrays = arrays_of(draft, rng)
    arrays["frame"] = arrays["frame"][::-1].copy()


@kind("people")
def frame_twice(draft, rng):
    arrays = arrays_of(draft, rng)
    arrays["frame"] = np.maximum(arrays["frame"], 1)


def _frame_numbers(draft, rng, how):
    change, all_cameras = how
    for arrays in each_of(draft, rng, all_cameras):
        arrays["frame"] = change(arrays["frame"])


kinds(
    "people",
    {
        "frames_counted_from_1": (lambda f: f + 1, False),
        "frames_beyond_the_clip": (lambda f: f + 1000, False),
        "all_frames_beyond_the_clip": (lambda f: f + 1000, True),
        "frames_of_3_s_later": (lambda f: f + 3, False),
        "negative_frames": (lambda f: f - 100, False),
        "huge_frames": (lambda f: f + 10**15, False),
        "every_tenth_frame": (lambda f: f * 10, True),
    },
    _frame_numbers,
)


@kind("people", harmless=True)
def further_frames(draft, rng):
    arrays = arrays_of(draft, rng)
    for name, values in arrays.items():
        arrays[name] = np.concatenate([values, values + (1000 if name == "frame" else 0)])


@kind("people")
def detections_of_one_camera_missing(draft, rng):
    del draft.seen[str(rng.choice(list(draft.seen)))]


@kind("people")
def detections_of_two_cameras_exchanged(draft, rng):
    if len(draft.seen) > 1:
        a, b = rng.choice(list(draft.seen), 2, replace=False)
        draft.seen[a], draft.seen[b] = draft.seen[b], draft.seen[a]


@kind("people")
def detections_of_one_camera_as_anothers(draft, rng):
    if len(draft.seen) > 1:
        a, b = rng.choice(list(draft.seen), 2, replace=False)
        draft.seen[a] = {name: values.copy() for name, values in draft.seen[b].items()}


@kind("people")
def detections_of_nobody_known(draft, rng):
    draft.seen["extra"] = arrays_of(draft, rng)


@kind("people")
def detections_without_room(draft, rng):
    arrays = arrays_of(draft, rng)
    for name in ("keypoints", "confidence", "boxes", "score"):
        arrays[name] = arrays[name][:, :0]


@kind("people")
def detections_of_no_frame(draft, rng):
    arrays = arrays_of(draft, rng)
    for name in arrays:
        arrays[name] = arrays[name][:0]


@kind("people", phase=FILM)
def people_who_stand_still(draft, rng):
    draft.people = np.repeat(draft.people[:1], FRAMES, axis=0)
    draft.truth = draft.people


@kind("people", phase=FILM)
def people_who_jump_about(draft, rng):
    draft.people = draft.people + rng.uniform(-3, 3, (FRAMES, draft.people.shape[1], 1, 3)) * [
        1,
        1,
        0,
    ]
    draft.truth = None


@kind("people", phase=FILM)
def one_person_alone(draft, rng):
    draft.people = draft.people[:, :1]
    draft.truth = draft.people


@kind("people", phase=FILM)
def giants(draft, rng):
    draft.people = draft.people * [1.0, 1.0, 1.6]
    draft.truth = draft.people


# ----------------------------------------------------------------------------- clips, clocks


def _fps(draft, rng, value):
    draft.spec["fps"] = value


kinds(
    "clips",
    {f"fps_of_{value}": value for value in (23.976, 29.97, 30, 50, 60)},
    _fps,
    harmless=True,
)
kinds(
    "clips",
    {
        f"fps_{name}": value
        for name, value in {
            "of_1": 1.0,
            "of_240": 240,
            "of_1000": 1000.0,
            "of_25000": 25000,
            "of_1e9": 1e9,
            "of_1e308": 1e308,
            "of_a_thousandth": 0.001,
            "of_1e-300": 1e-300,
            "of_zero": 0,
            "negative": -25.0,
            "as_text": "25",
            "as_null": None,
            "as_nan": math.nan,
            "as_infinity": math.inf,
            "as_fraction": "25/1",
            "as_truth": True,
        }.items()
    },
    _fps,
)


def _camera_key(draft, rng, how):
    key, value = how
    one(rng, draft.spec["cameras"])[key] = value


kinds("clips", {"fps_of_a_camera": ("fps", 25.0)}, _camera_key, harmless=True)
kinds(
    "clips",
    {
        "another_fps_of_a_camera": ("fps", 50.0),
        "camera_without_width": ("width", None),
        "camera_of_zero_width": ("width", 0),
        "camera_of_huge_width": ("width", 10**9),
        "camera_of_width_beyond_numbers": ("width", 10**400),
        "camera_of_text_width": ("width", "1920"),
        "camera_of_fractional_width": ("width", 1920.5),
        "offset_of_1_frame": ("offset_frames", 1),
        "offset_of_3_frames": ("offset_frames", 3),
        "offset_of_half_a_frame": ("offset_frames", 0.5),
        "offset_of_100000_frames": ("offset_frames", 100000),
        "offset_of_1e18": ("offset_frames", 10**18),
        "offset_beyond_numbers": ("offset_frames", 1e300),
        "offset_of_nan": ("offset_frames", math.nan),
        "offset_as_text": ("offset_frames", "3"),
        "camera_of_unknown_kind": ("kind", "drone"),
        "camera_of_unknown_key": ("lens", "wide"),
        "still_that_is_not_there": ("still", "stills/none.png"),
        "still_that_climbs": ("still", "../../etc/passwd"),
        "still_of_absolute_path": ("still", "/etc/passwd"),
        "video_that_is_not_there": ("video", "videos/none.mp4"),
        "video_of_nul": ("video", "videos/a\0b.mp4"),
        "video_of_a_long_name": ("video", "v" * 5000),
    },
    _camera_key,
)


def _true_offset(draft, rng, offset):
    name = some(draft, rng)
    if name in draft.seen:
        draft.camera_spec(name)["offset_frames"] = offset
        draft.seen[name]["frame"] = draft.seen[name]["frame"] + offset


kinds(
    "clips",
    {"true_offset_of_7": 7, "true_offset_of_100000": 100000, "true_negative_offset": -200},
    _true_offset,
    harmless=True,
)


def _clip(draft, rng, values):
    draft.spec["clips"][0].update(values)


kinds(
    "clips",
    {
        "clip_of_6_frames": {"frame_count": 6},
        "clip_from_frame_3": {"first_frame": 3, "frame_count": 7},
    },
    _clip,
    harmless=True,
)
kinds(
    "clips",
    {
        "clip_of_1_frame": {"frame_count": 1},
        "clip_of_2_frames": {"frame_count": 2},
        "clip_of_3_frames": {"frame_count": 3},
        "clip_of_no_frame": {"frame_count": 0},
        "clip_of_minus_frames": {"frame_count": -5},
        "clip_longer_than_people": {"frame_count": 60},
        "clip_of_a_million_frames": {"frame_count": 10**6},
        "clip_of_1e12_frames": {"frame_count": 10**12},
        "clip_beyond_numbers": {"frame_count": 10**30},
        "clip_before_all": {"first_frame": -100},
        "clip_partly_before": {"first_frame": -5},
        "clip_after_all": {"first_frame": 5000},
        "clip_at_1e18": {"first_frame": 10**18},
        "clip_of_fractions": {"frame_count": 9.5},
        "clip_of_text": {"frame_count": "10"},
        "clip_of_unknown_broadcast": {"broadcast": "main"},
        "clip_of_static_broadcast": {"broadcast": "cam0"},
        "clip_of_unknown_people": {"people": {"0": "kane"}},
        "clip_of_huge_broadcast_offset": {"broadcast_offset_frames": 1e300},
        "clip_of_unknown_key": {"half": 1},
    },
    _clip,
)


@kind("clips", harmless=True)
def two_clips(draft, rng):
    draft.spec["clips"] = [
        {"id": "a", "first_frame": 0, "frame_count": 5},
        {"id": "b", "first_frame": 5, "frame_count": 5},
    ]


@kind("clips")
def two_clips_that_overlap(draft, rng):
    draft.spec["clips"].append({"id": "again", "first_frame": 2, "frame_count": 6})


def _far_clip(draft, rng, first):
    draft.spec["clips"].append({"id": "far", "first_frame": first, "frame_count": 4})


kinds("clips", {"clip_without_people": 100, "clips_90000_frames_apart": 90000}, _far_clip)


@kind("clips", base="any")
def clips_far_apart_with_people(draft, rng):
    first = int(rng.choice([90_000, 900_000]))
    draft.spec["clips"].append({"id": "far", "first_frame": first, "frame_count": 4})
    for arrays in draft.seen.values():
        for name, values in arrays.items():
            again = values[:4] + (first if name == "frame" else 0)
            arrays[name] = np.concatenate([values, again])
    draft.truth = None


@kind("clips")
def no_clip(draft, rng):
    draft.spec["clips"] = []


@kind("clips")
def no_cameras(draft, rng):
    draft.spec["cameras"] = []


# -------------------------------------------------------------------------------------- ids


def _rename_camera(draft, rng, new):
    old = some(draft, rng)
    draft.camera_spec(old)["id"] = new
    if not isinstance(new, str) or "/" in new or "\0" in new or new in ("", ".", ".."):
        return
    if len(new.encode()) > 240 or any(
        ord(letter) > 0xD7FF and ord(letter) < 0xE000 for letter in new
    ):
        return
    draft.cameras = {(new if name == old else name): c for name, c in draft.cameras.items()}
    for content in (draft.seen, draft.clicks):
        if old in content:
            content[new] = content.pop(old)
    for table in (draft.given or {}).values():
        if table.get("name") == old:
            table["name"] = new


kinds(
    "ids",
    {
        "camera_id_with_dots": "cam.1.left",
        "camera_id_of_64_letters": "c" * 64,
        "camera_id_with_capitals": "Cam_One-2",
        "camera_id_of_digits": "0001",
        "camera_id_of_truth": "true",
        "camera_id_of_device": "CON",
    },
    _rename_camera,
    harmless=True,
)
kinds(
    "ids",
    {
        "camera_id_of_65_letters": "c" * 65,
        "camera_id_with_umlaut": "kamera-süd",
        "camera_id_of_emoji": "cam\U0001f600",
        "camera_id_of_hebrew": "מצלמה",
        "camera_id_of_combining_letters": "came\u0301ra",
        "camera_id_with_space": "cam 1",
        "camera_id_with_slash": "a/b",
        "camera_id_that_climbs": "..",
        "camera_id_empty": "",
        "camera_id_with_leading_dot": ".cam",
        "camera_id_with_leading_dash": "-cam",
        "camera_id_with_newline": "cam\n1",
        "camera_id_with_trailing_newline": "cam\n",
        "camera_id_with_nul": "cam\x001",
        "camera_id_of_number": 7,
        "camera_id_of_yaml_truth": True,
        "camera_id_of_null": None,
        "camera_id_of_list": ["cam0"],
        "camera_id_of_mapping": {"cam": 0},
        "camera_id_with_markup": "[bold]cam",
        "camera_id_of_the_clip": "clip",
    },
    _rename_camera,
)


@kind("ids")
def camera_ids_that_differ_in_case(draft, rng):
    names = list(draft.cameras)
    if len(names) > 1 and f"{names[0]}".swapcase() not in names:
        _rename_camera_to(draft, names[1], names[0].swapcase())


def _rename_camera_to(draft, old, new):
    draft.camera_spec(old)["id"] = new
    draft.cameras = {(new if name == old else name): c for name, c in draft.cameras.items()}
    for content in (draft.seen, draft.clicks):
        if old in content:
            content[new] = content.pop(old)
    for table in (draft.given or {}).values():
        if table.get("name") == old:
            table["name"] = new


@kind("ids")
def camera_id_twice(draft, rng):
    draft.spec["cameras"].append(dict(draft.spec["cameras"][0]))


def _spec_key(draft, rng, how):
    key, value = how
    draft.spec[key] = value


kinds(
    "ids",
    {
        "match_id_of_64_letters": ("match_id", "m" * 64),
        "match_id_with_dots": ("match_id", "a.b"),
        "match_id_of_device": ("match_id", "NUL"),
        "roster": ("roster", [{"id": "kane", "name": "Harry Käne", "team": "\U0001f981"}]),
    },
    _spec_key,
    harmless=True,
)
kinds(
    "ids",
    {
        "match_id_of_truth": ("match_id", False),
        "match_id_of_date": ("match_id", "2024-05-01 12:00"),
        "match_id_that_climbs": ("match_id", "../x"),
        "match_id_of_65_letters": ("match_id", "m" * 65),
        "match_id_of_umlaut": ("match_id", "spiel-über"),
        "match_id_of_nothing": ("match_id", None),
        "contract_of_text": ("contract", "1"),
        "contract_of_2": ("contract", 2),
        "cameras_as_mapping": ("cameras", {"cam0": {"width": 1920}}),
        "cameras_as_text": ("cameras", "cam0"),
        "roster_of_names": ("roster", ["kane"]),
        "roster_twice": ("roster", [{"id": "kane"}, {"id": "kane"}]),
        "unknown_key": ("framerate", 25),
        "key_of_number": (7, 25),
        "key_of_truth": (True, 25),
    },
    _spec_key,
)


@kind("ids")
def sixty_copies_of_a_camera(draft, rng):
    name = some(draft, rng)
    for n in range(60):
        if name in draft.seen:
            put(draft, f"more{n}", draft.cameras[name])
            draft.seen[f"more{n}"] = draft.seen[name]
            if name in draft.clicks:
                draft.clicks[f"more{n}"] = draft.clicks[name]
            for key, table in list((draft.given or {}).items()):
                if table.get("name") == name:
                    draft.given[f"{key}_{n}"] = {**table, "name": f"more{n}"}
