"""Detections, clips, clocks and names that are not as they should be."""

import numpy as np

from .camera_kinds import put, some
from .kinds import FILM, drop, exchange, kind, kinds, one
from .scene import FRAMES

# -------------------------------------------------------------------------------- detections

PER_PERSON = ("keypoints", "confidence", "boxes", "score")


def _change_people(draft, rng, how):
    """Replace arrays of one camera, or of all, by what a function of them and of chance returns."""
    change, is_everywhere = how
    cameras = list(draft.seen) if is_everywhere else [str(rng.choice(list(draft.seen)))]
    for name in cameras:
        draft.seen[name].update(change(draft.seen[name], rng))


def each_array(change, names=PER_PERSON):
    return lambda arrays, rng: {name: change(arrays[name]) for name in names}


def hide(share):
    """Take people away, by chance."""

    def change(arrays, rng):
        gone = rng.random(arrays["score"].shape) < share
        return {name: _without(arrays[name], gone) for name in PER_PERSON}

    return change


def hide_joints(share):
    def change(arrays, rng):
        gone = rng.random(arrays["confidence"].shape) < share
        found = {name: _without(arrays[name], gone) for name in ("keypoints", "confidence")}
        empty = np.isnan(found["confidence"]).all(axis=-1)
        return {name: _without(found.get(name, arrays[name]), empty) for name in PER_PERSON}

    return change


def _without(values, gone):
    values = values.copy()
    values[gone] = np.nan
    return values


def more(count):
    """Room for more people."""
    return each_array(
        lambda a: np.concatenate([a, np.full((len(a), count, *a.shape[2:]), np.nan)], axis=1)
    )


def false_people(count):
    def change(arrays, rng):
        known = arrays["score"].shape[1]
        found = more(count)(arrays, rng)
        at = rng.uniform([0, 0], [1900, 1000], (len(arrays["score"]), count, 1, 2))
        pixels = at + rng.normal(0, 25, (len(at), count, 17, 2))
        found["keypoints"][:, known:] = pixels
        found["confidence"][:, known:] = rng.uniform(0.3, 0.6, pixels.shape[:-1])
        found["score"][:, known:] = 0.5
        corners = [pixels.min(axis=2) - 5, pixels.max(axis=2) + 5]
        found["boxes"][:, known:] = np.concatenate(corners, axis=-1)
        return found

    return change


def noisy(size, share):
    def change(arrays, rng):
        mask = rng.random(arrays["confidence"].shape)[..., None] < share
        pixels = arrays["keypoints"]
        return {"keypoints": pixels + mask * rng.normal(0, size, pixels.shape)}

    return change


def moved(change):
    """Move keypoints and boxes."""

    def apply(arrays, rng):
        low, high = change(arrays["boxes"][..., :2]), change(arrays["boxes"][..., 2:])
        boxes = np.concatenate([np.minimum(low, high), np.maximum(low, high)], axis=-1)
        return {"keypoints": change(arrays["keypoints"]), "boxes": boxes}

    return apply


def one_value(name, value):
    def change(arrays, rng):
        values, found = arrays[name].copy(), np.argwhere(np.isfinite(arrays[name]))
        if len(found):
            values[tuple(found[int(rng.integers(len(found)))])] = value
        return {name: values}

    return change


def numbered(change):
    return each_array(change, ("frame",))


def further_frames(arrays, rng):
    return {
        name: np.concatenate([values, values + (1000 if name == "frame" else 0)])
        for name, values in arrays.items()
    }


LEFT_FOR_RIGHT = [0, 2, 1, 4, 3, 6, 5, 8, 7, 10, 9, 12, 11, 14, 13, 16, 15]
JOINTS = ("keypoints", "confidence")
kinds(
    "people",
    {
        "people_missed_at_times": (hide(0.1), True),
        "nobody_in_one_camera": (hide(1.0), False),
        "joints_missed_at_times": (hide_joints(0.1), True),
        "three_false_people": (false_people(3), False),
        "room_for_absent_people": (more(20), True),
        "people_in_another_order": (each_array(lambda a: a[:, ::-1]), True),
        "all_equally_confident": (each_array(lambda a: a * 0 + 0.9, ("confidence",)), True),
        "keypoints_of_3_px_noise": (noisy(3.0, 1.0), True),
        "a_tenth_of_keypoints_astray": (noisy(60.0, 0.1), True),
        "further_frames": (further_frames, False),
    },
    _change_people,
    harmless=True,
)
kinds(
    "people",
    {
        "half_of_the_people_missed": (hide(0.5), True),
        "nobody_at_all": (hide(1.0), True),
        "most_joints_missed": (hide_joints(0.8), True),
        "false_people_everywhere": (false_people(6), True),
        "300_false_people": (false_people(300), False),
        "1500_false_people": (false_people(1500), False),
        "everybody_twice": (each_array(lambda a: np.concatenate([a, a], axis=1)), True),
        "keypoints_anywhere_in_one_camera": (noisy(500.0, 1.0), False),
        "keypoints_anywhere": (noisy(500.0, 1.0), True),
        "people_from_0_to_1": (moved(lambda p: p / [1920, 1080]), True),
        "people_with_x_and_y_exchanged": (moved(lambda p: p[..., ::-1]), False),
        "people_mirrored": (moved(lambda p: [1919, 0] + p * [-1, 1]), False),
        "people_at_one_pixel": (moved(lambda p: p * 0 + 500), False),
        "people_beyond_belief": (moved(lambda p: p + 1e12), False),
        "people_beside_their_images": (moved(lambda p: p - 3000), True),
        "a_keypoint_of_nan": (one_value("keypoints", np.nan), False),
        "a_huge_keypoint": (one_value("keypoints", 1e30), False),
        "a_huge_score": (one_value("score", 1e30), False),
        "left_for_right_in_people": (each_array(lambda a: a[:, :, LEFT_FOR_RIGHT], JOINTS), False),
        "joints_of_another_order": (each_array(lambda a: a[:, :, ::-1], JOINTS), True),
        "only_one_frame": (each_array(lambda a: a[4:5], ("frame", *PER_PERSON)), True),
        "frames_counted_from_1": (numbered(lambda f: f + 1), False),
        "frames_beyond_the_clip": (numbered(lambda f: f + 1000), False),
        "negative_frames": (numbered(lambda f: f - 100), False),
        "every_tenth_frame": (numbered(lambda f: f * 10), True),
    },
    _change_people,
)
kinds(
    "people",
    {
        "detections_of_one_camera_missing": lambda draft, rng: drop(draft.seen, rng),
        "detections_of_two_cameras_exchanged": lambda draft, rng: exchange(draft.seen, rng),
    },
    lambda draft, rng, act: act(draft, rng),
)


@kind("people", harmless=True)
def as_coco_results(draft, rng):
    draft.coco = True


def _cast(draft, rng, people):
    draft.people = draft.truth = people(draft.people)


kinds(
    "people",
    {
        "people_who_stand_still": lambda p: np.repeat(p[:1], FRAMES, axis=0),
        "one_person_alone": lambda p: p[:, :1],
    },
    _cast,
    phase=FILM,
)

# ----------------------------------------------------------------------------- clips, clocks


def _match_key(draft, rng, how):
    key, value = how
    draft.spec[key] = value


def _camera_key(draft, rng, how):
    key, value = how
    one(rng, draft.spec["cameras"])[key] = value


def _clip(draft, rng, values):
    draft.spec["clips"][0].update(values)


kinds(
    "clips",
    {f"fps_of_{value}": ("fps", value) for value in (23.976, 29.97, 60)},
    _match_key,
    harmless=True,
)
kinds(
    "clips",
    {"fps_of_1": ("fps", 1.0), "fps_of_1e9": ("fps", 1e9), "fps_of_1e-300": ("fps", 1e-300)},
    _match_key,
)
kinds("clips", {"fps_of_a_camera": ("fps", 25.0)}, _camera_key, harmless=True)
kinds(
    "clips",
    {
        "another_fps_of_a_camera": ("fps", 50.0),
        "camera_of_huge_width": ("width", 10**9),
        "offset_of_1_frame": ("offset_frames", 1),
        "offset_of_100000_frames": ("offset_frames", 100000),
        "offset_beyond_numbers": ("offset_frames", 1e300),
    },
    _camera_key,
)


def _true_offset(draft, rng, offset):
    name = some(draft, rng)
    if name in draft.seen:
        draft.camera_spec(name)["offset_frames"] = offset
        draft.seen[name]["frame"] = draft.seen[name]["frame"] + offset


kinds("clips", {"true_offset_of_7": 7, "true_offset_of_-200": -200}, _true_offset, harmless=True)
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
        "clip_of_3_frames": {"frame_count": 3},
        "clip_longer_than_people": {"frame_count": 60},
        "clip_of_a_million_frames": {"frame_count": 10**6},
        "clip_before_all": {"first_frame": -100},
        "clip_after_all": {"first_frame": 5000},
    },
    _clip,
)


@kind("clips", harmless=True)
def two_clips(draft, rng):
    draft.spec["clips"] = [
        {"id": "a", "first_frame": 0, "frame_count": 5},
        {"id": "b", "first_frame": 5, "frame_count": 5},
    ]


def _far_clip(draft, rng, first):
    draft.spec["clips"].append({"id": "far", "first_frame": first, "frame_count": 4})


kinds("clips", {"clip_without_people": 100, "clips_90000_frames_apart": 90000}, _far_clip)


@kind("clips")
def clips_far_apart_with_people(draft, rng):
    _far_clip(draft, rng, 900_000)
    for arrays in draft.seen.values():
        for name, values in arrays.items():
            again = values[:4] + (900_000 if name == "frame" else 0)
            arrays[name] = np.concatenate([values, again])
    draft.truth = None


# -------------------------------------------------------------------------------------- ids


def _rename_camera(draft, rng, new):
    old = some(draft, rng)
    draft.camera_spec(old)["id"] = new
    if not isinstance(new, str) or "/" in new or "\0" in new or new in ("", ".", ".."):
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
        "camera_id_of_digits": "0001",
        "camera_id_of_truth": "true",
    },
    _rename_camera,
    harmless=True,
)
kinds(
    "ids",
    {
        "match_id_of_64_letters": ("match_id", "m" * 64),
        "match_id_with_dots": ("match_id", "a.b"),
        "roster": ("roster", [{"id": "kane", "name": "Harry Käne", "team": "\U0001f981"}]),
    },
    _match_key,
    harmless=True,
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
