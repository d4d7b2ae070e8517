"""Kinds of mutation of detections, clips, ids, and of the bytes of files."""

import gzip
import os
import re

import numpy as np

from worldpose.video.files import write_video

from .kinds import FILES, add, exchange, mutation, one

PER_PERSON, JOINTS = ("keypoints", "confidence", "boxes", "score"), ("keypoints", "confidence")


@mutation
def people(draft, rng, change, everywhere=True):
    """Replace arrays of one camera, or of all, by what a function of them and of chance returns."""
    for name in list(draft.seen) if everywhere else [one(rng, draft.seen)]:
        draft.seen[name].update(change(draft.seen[name], rng))


def arrays(change, names=PER_PERSON, everywhere=True):
    return people(lambda a, rng: {name: change(a[name]) for name in names}, everywhere)


def numbered(change, everywhere=False):
    return arrays(change, ("frame",), everywhere)


def without(values, gone):
    return np.where(gone.reshape(gone.shape + (1,) * (values.ndim - gone.ndim)), np.nan, values)


def hide(share, everywhere=True):
    def change(a, rng):
        gone = rng.random(a["score"].shape) < share
        return {name: without(a[name], gone) for name in PER_PERSON}

    return people(change, everywhere)


def hide_joints(share):
    def change(a, rng):
        gone = rng.random(a["confidence"].shape) < share
        found = a | {name: without(a[name], gone) for name in JOINTS}
        empty = np.isnan(found["confidence"]).all(axis=-1)
        return {name: without(found[name], empty) for name in PER_PERSON}

    return people(change)


def room(count):
    """Room for more people."""
    return lambda a: np.concatenate([a, np.full((len(a), count, *a.shape[2:]), np.nan)], axis=1)


def false_people(count, everywhere=False):
    def change(a, rng):
        known = a["score"].shape[1]
        found = {name: room(count)(a[name]) for name in PER_PERSON}
        at = rng.uniform([0, 0], [1900, 1000], (len(a["score"]), count, 1, 2))
        pixels = at + rng.normal(0, 25, (len(at), count, 17, 2))
        corners = np.concatenate([pixels.min(axis=2) - 5, pixels.max(axis=2) + 5], axis=-1)
        new = (pixels, rng.uniform(0.3, 0.6, pixels.shape[:-1]), corners, 0.5)
        for name, values in zip(PER_PERSON, new, strict=True):
            found[name][:, known:] = values
        return found

    return people(change, everywhere)


def noisy(size, share=1.0, everywhere=True):
    def change(a, rng):
        mask = rng.random(a["confidence"].shape)[..., None] < share
        return {"keypoints": a["keypoints"] + mask * rng.normal(0, size, a["keypoints"].shape)}

    return people(change, everywhere)


def moved(change, everywhere=False):
    """Move keypoints and boxes."""

    def apply(a, rng):
        ends = np.stack([change(a["boxes"][..., :2]), change(a["boxes"][..., 2:])])
        boxes = np.concatenate([ends.min(axis=0), ends.max(axis=0)], axis=-1)
        return {"keypoints": change(a["keypoints"]), "boxes": boxes}

    return people(apply, everywhere)


def one_value(name, value):
    def change(a, rng):
        values, found = a[name].copy(), np.argwhere(np.isfinite(a[name]))
        if len(found):
            values[tuple(one(rng, found))] = value
        return {name: values}

    return people(change, False)


def further_frames(a, rng):
    """The same people once more, much later."""
    return {n: np.concatenate([v, v + 1000 * (n == "frame")]) for n, v in a.items()}


SWAPPED = [0, 2, 1, 4, 3, 6, 5, 8, 7, 10, 9, 12, 11, 14, 13, 16, 15]
PEOPLE = {
    "people_missed_at_times": hide(0.1),
    "nobody_in_one_camera": hide(1.0, False),
    "joints_missed_at_times": hide_joints(0.1),
    "three_false_people": false_people(3),
    "room_for_absent_people": arrays(room(20)),
    "people_in_another_order": arrays(lambda a: a[:, ::-1]),
    "all_equally_confident": arrays(lambda a: a * 0 + 0.9, ("confidence",)),
    "keypoints_of_3_px_noise": noisy(3.0),
    "a_tenth_of_keypoints_astray": noisy(60.0, 0.1),
    "further_frames": people(further_frames, False),
    "as_coco_results": lambda d, r: setattr(d, "coco", True),
}
add("people", PEOPLE, harmless="all")
WRONG_PEOPLE = {
    "half_of_the_people_missed": hide(0.5),
    "nobody_at_all": hide(1.0),
    "most_joints_missed": hide_joints(0.8),
    "false_people_everywhere": false_people(6, True),
    "300_false_people": false_people(300),
    "1500_false_people": false_people(1500),
    "everybody_twice": arrays(lambda a: np.concatenate([a, a], axis=1)),
    "keypoints_anywhere_in_one_camera": noisy(500.0, everywhere=False),
    "keypoints_anywhere": noisy(500.0),
    "people_from_0_to_1": moved(lambda p: p / [1920, 1080], True),
    "people_with_x_and_y_exchanged": moved(lambda p: p[..., ::-1]),
    "people_mirrored": moved(lambda p: [1919, 0] + p * [-1, 1]),
    "people_at_one_pixel": moved(lambda p: p * 0 + 500),
    "people_beyond_belief": moved(lambda p: p + 1e12),
    "people_beside_their_images": moved(lambda p: p - 3000, True),
    "a_keypoint_of_nan": one_value("keypoints", np.nan),
    "a_huge_keypoint": one_value("keypoints", 1e30),
    "a_huge_score": one_value("score", 1e30),
    "left_for_right_in_people": arrays(lambda a: a[:, :, SWAPPED], JOINTS, False),
    "joints_of_another_order": arrays(lambda a: a[:, :, ::-1], JOINTS),
    "only_one_frame": arrays(lambda a: a[4:5], ("frame", *PER_PERSON)),
    "frames_counted_from_1": numbered(lambda f: f + 1),
    "frames_beyond_the_clip": numbered(lambda f: f + 1000),
    "negative_frames": numbered(lambda f: f - 100),
    "every_tenth_frame": numbered(lambda f: f * 10, True),
    "detections_of_one_camera_missing": lambda d, r: d.seen.pop(one(r, d.seen)),
    "detections_of_two_cameras_exchanged": lambda d, r: exchange(d.seen, r),
}
add("people", WRONG_PEOPLE)


def match_key(**values):
    return lambda draft, rng: draft.spec.update(values)


def camera_key(**values):
    return lambda draft, rng: one(rng, draft.spec["cameras"]).update(values)


def clip(**values):
    return lambda draft, rng: draft.spec["clips"][0].update(values)


@mutation
def true_offset(draft, rng, offset):
    name = one(rng, draft.cameras)
    if name in draft.seen:
        draft.camera_spec(name)["offset_frames"] = offset
        draft.seen[name]["frame"] = draft.seen[name]["frame"] + offset


CLIP = {"id": "a", "first_frame": 0, "frame_count": 5}
CLIPS = {
    **{f"fps_of_{value}": match_key(fps=value) for value in (23.976, 29.97, 60, 1.0, 1e9, 1e-300)},
    "fps_of_a_camera": camera_key(fps=25.0),
    "another_fps_of_a_camera": camera_key(fps=50.0),
    "camera_of_huge_width": camera_key(width=10**9),
    "offset_of_1_frame": camera_key(offset_frames=1),
    "offset_of_100000_frames": camera_key(offset_frames=100000),
    "offset_beyond_numbers": camera_key(offset_frames=1e300),
    "true_offset_of_7": true_offset(7),
    "true_offset_of_-200": true_offset(-200),
    "clip_of_6_frames": clip(frame_count=6),
    "clip_from_frame_3": clip(first_frame=3, frame_count=7),
    "clip_of_1_frame": clip(frame_count=1),
    "clip_of_3_frames": clip(frame_count=3),
    "clip_longer_than_people": clip(frame_count=60),
    "clip_of_a_million_frames": clip(frame_count=10**6),
    "clip_before_all": clip(first_frame=-100),
    "clip_after_all": clip(first_frame=5000),
    "two_clips": lambda d, r: d.spec.update(clips=[CLIP, CLIP | {"id": "b", "first_frame": 5}]),
    "clips_apart": lambda d, r: d.spec["clips"].append(CLIP | {"first_frame": 90000}),
}
RIGHT_CLIPS = "fps_of_23.976 fps_of_29.97 fps_of_60 fps_of_a_camera true_offset_of_7 two_clips"
add(
    "clips", CLIPS, harmless=f"{RIGHT_CLIPS} true_offset_of_-200 clip_of_6_frames clip_from_frame_3"
)


@mutation
def camera_id(draft, rng, new):
    old = one(rng, draft.cameras)
    draft.camera_spec(old)["id"] = new
    for content in (draft.cameras, draft.seen, draft.clicks):
        if old in content:
            content[new] = content.pop(old)
    for each in (draft.given or {}).values():
        if each.get("name") == old:
            each["name"] = new


IDS = {
    "camera_id_with_dots": camera_id("cam.1.left"),
    "camera_id_of_64_letters": camera_id("c" * 64),
    "camera_id_of_digits": camera_id("0001"),
    "camera_id_of_truth": camera_id("true"),
    "match_id_of_64_letters": match_key(match_id="m" * 64),
    "match_id_with_dots": match_key(match_id="a.b"),
    "roster": match_key(roster=[{"id": "kane", "name": "Harry Käne", "team": "\U0001f981"}]),
}
add("ids", IDS, harmless="all")

# ------------------------------------------------------------------------ files of wrong bytes


def flip(content, rng):
    spoilt = bytearray(content)
    for _ in range(5):
        spoilt[int(rng.integers(len(spoilt)))] ^= 1 << int(rng.integers(8))
    return bytes(spoilt)


def number(text):
    """Put another number in place of one of those in a text."""

    def change(content, rng):
        places = list(re.finditer(rb"(?<![\w.])-?\d+\.?\d*(?![\w.])", content))
        if not places:
            return content
        at = one(rng, places)
        return content[: at.start()] + text + content[at.end() :]

    return change


SPOILS = {
    "cut_in_half": lambda c, rng: c[: len(c) // 2],
    "cut_by_one_byte": lambda c, rng: c[:-1],
    "empty": lambda c, rng: b"",
    "in_utf16": lambda c, rng: c.decode("utf-8", "replace").encode("utf-16"),
    "of_zeros": lambda c, rng: b"\0" * len(c),
    "of_noise": lambda c, rng: rng.bytes(max(64, len(c))),
    "with_flipped_bits": flip,
    "packed_by_gzip": lambda c, rng: gzip.compress(c),
    "twice": lambda c, rng: c + c,
}
"""Mutations of any file's bytes."""
TEXTS = {
    "nested_deeply": lambda c, rng: b"[" * 20000 + b"]" * 20000,
    "of_10_mb": lambda c, rng: c + b" " * (10 << 20),
    "with_a_huge_number": number(b"1e400"),
    "with_a_negative_number": number(b"-1"),
    "with_nan": number(b"NaN"),
    "with_null": number(b"null"),
    "with_text_for_a_number": number(b'"12"'),
    "with_a_decimal_comma": number(b"12,5"),
    "with_a_list_for_a_number": number(b"[1]"),
    "with_lone_surrogate": lambda c, rng: c.replace(b'"name"', b'"\\ud800"', 1),
}
HARMLESS_TEXTS = {
    "saved_with_bom": lambda c, rng: b"\xef\xbb\xbf" + c,
    "saved_with_crlf": lambda c, rng: c.replace(b"\n", b"\r\n"),
    "saved_with_blank_lines": lambda c, rng: b"\n\n" + c + b"\n\n",
}
INSTEAD = {
    "missing": lambda file: None,
    "is_a_folder": lambda file: file.mkdir(),
    "is_a_pipe": os.mkfifo,
    "links_to_itself": lambda file: file.symlink_to(file.name),
    "links_outside": lambda file: file.symlink_to("/etc/hostname"),
    "links_to_a_device": lambda file: file.symlink_to("/dev/zero"),
}
ROLES = {
    "yaml": ("any", "match.yaml"),
    "toml": ("given", "calibration.toml"),
    "clicks": ("clicked", "annotations/static_calibration/{}.json"),
    "npz": ("any", "detections/{}.npz"),
    "coco": ("any", "detections/{}.json"),
    "pitch": ("clicked", "pitch.json"),
    "video": ("filmed", "videos/{}.mp4"),
}
"""The match that has a file of each role, and its path, by camera."""


@mutation
def strike(draft, rng, role, change, is_known=False):
    """Change one written file; the meaning of its bytes is then unknown, unless it is said."""
    draft.coco = draft.coco or role == "coco"
    if role == "pitch":
        draft.pitch = {"length": 105.0, "width": 68.0, "crown": 0.2}
    path = ROLES[role][1].format(one(rng, draft.cameras))
    own = np.random.default_rng(int(rng.integers(2**32)))
    draft.after.append(lambda folder: (folder / path).is_file() and change(folder / path, own))
    if not is_known:
        draft.truth = None


def rewrite(change):
    return lambda file, rng: file.write_bytes(change(file.read_bytes(), rng))


def replace_file(make):
    return lambda file, rng: (file.unlink(), make(file))


def films(frames, fps, size=(64, 48)):
    pictures = [np.full((size[1], size[0], 3), 50, np.uint8)] * frames
    return lambda file, rng: write_video(file, pictures, fps, quality=5)


for role, (base, _) in ROLES.items():
    is_text = role not in ("npz", "video")
    spoils = {f"{role}_{n}": strike(role, rewrite(c)) for n, c in SPOILS.items()}
    if is_text:
        spoils |= {f"{role}_{n}": strike(role, rewrite(c)) for n, c in TEXTS.items()}
    if role not in ("coco", "pitch", "video"):
        spoils |= {f"{role}_{n}": strike(role, replace_file(m)) for n, m in INSTEAD.items()}
    add("video" if role == "video" else "bytes", spoils, phase=FILES, base=base)
    if role in ("yaml", "toml", "clicks"):
        saved = {f"{role}_{n}": strike(role, rewrite(c), True) for n, c in HARMLESS_TEXTS.items()}
        add("bytes", saved, phase=FILES, base=base, harmless="all")


VIDEOS = {
    "video_of_one_frame": strike("video", films(1, 25.0)),
    "video_of_another_size": strike("video", films(10, 25.0, (32, 48))),
    "video_of_another_rate": strike("video", films(10, 50.0)),
    "video_of_1_frame_a_second": strike("video", films(10, 1.0)),
    "video_of_more_frames": strike("video", films(40, 25.0)),
}
add("video", VIDEOS, phase=FILES, base="filmed", harmless="video_of_more_frames")
