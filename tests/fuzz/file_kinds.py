"""Files that are not what their names say: raw bytes, arrays, videos; and settings of any type."""

import gzip
import os
import re

import numpy as np

from .camera_kinds import some
from .kinds import FILES, kind, kinds, one

# --------------------------------------------------------------------------------- raw bytes


def _flip(content, rng):
    spoilt = bytearray(content)
    for _ in range(5):
        spoilt[int(rng.integers(len(spoilt)))] ^= 1 << int(rng.integers(8))
    return bytes(spoilt)


def _number(content, rng, text):
    """Put another number in place of one of those in a text."""
    places = list(re.finditer(rb"(?<![\w.])-?\d+\.?\d*(?![\w.])", content))
    if not places:
        return content
    at = one(rng, places)
    return content[: at.start()] + text + content[at.end() :]


SPOILS = {
    "cut_in_half": lambda c, rng: c[: len(c) // 2],
    "cut_by_one_byte": lambda c, rng: c[:-1],
    "empty": lambda c, rng: b"",
    "with_bom": lambda c, rng: b"\xef\xbb\xbf" + c,
    "with_crlf": lambda c, rng: c.replace(b"\n", b"\r\n"),
    "in_utf16": lambda c, rng: c.decode("utf-8", "replace").encode("utf-16"),
    "of_zeros": lambda c, rng: b"\0" * len(c),
    "of_noise": lambda c, rng: rng.bytes(max(64, len(c))),
    "with_flipped_bits": _flip,
    "packed_by_gzip": lambda c, rng: gzip.compress(c),
    "nested_deeply": lambda c, rng: b"[" * 20000 + b"]" * 20000,
    "twice": lambda c, rng: c + c,
    "of_10_mb": lambda c, rng: c + b" " * (10 << 20),
    "with_a_huge_number": lambda c, rng: _number(c, rng, b"1e400"),
    "with_a_negative_number": lambda c, rng: _number(c, rng, b"-1"),
    "with_nan": lambda c, rng: _number(c, rng, b"NaN"),
    "with_null": lambda c, rng: _number(c, rng, b"null"),
    "with_text_for_a_number": lambda c, rng: _number(c, rng, b'"12"'),
    "with_a_decimal_comma": lambda c, rng: _number(c, rng, b"12,5"),
    "with_a_list_for_a_number": lambda c, rng: _number(c, rng, b"[1]"),
    "with_lone_surrogate": lambda c, rng: c.replace(b'"name"', b'"\\ud800"', 1),
}
"""Mutations of a file's bytes."""

FILES_OF = {
    "yaml": lambda draft, rng: "match.yaml",
    "toml": lambda draft, rng: "calibration.toml",
    "clicks": lambda draft, rng: f"annotations/static_calibration/{some(draft, rng)}.json",
    "npz": lambda draft, rng: f"detections/{some(draft, rng)}.npz",
    "coco": lambda draft, rng: f"detections/{some(draft, rng)}.json",
    "pitch": lambda draft, rng: "pitch.json",
}
TEXTUAL = (
    "tabs",
    "number",
    "nan",
    "hexa",
    "under",
    "comma",
    "sexa",
    "truth",
    "list",
    "zero",
    "null",
)
"""Of the above, those that mean nothing to arrays."""


def _spoil(draft, rng, how):
    role, change = how
    if role == "coco":
        draft.coco = True
    if role == "pitch":
        draft.pitch = {"length": 105.0, "width": 68.0, "crown": 0.2}
    path = FILES_OF[role](draft, rng)
    seed = int(rng.integers(2**32))

    def strike(folder):
        file = folder / path
        if file.is_file():
            file.write_bytes(change(file.read_bytes(), np.random.default_rng(seed)))

    draft.after.append(strike)
    draft.truth = None  # the meaning of a flipped bit is unknown


BASES = {"toml": "given", "clicks": "clicked", "pitch": "clicked"}
for role in FILES_OF:
    for label, change in SPOILS.items():
        is_textual = any(word in label for word in TEXTUAL)
        if role == "npz" and is_textual:
            continue
        kinds(
            "bytes",
            {f"{role}_{label}": (role, change)},
            _spoil,
            phase=FILES,
            base=BASES.get(role, "any"),
        )


def _harmless_text(draft, rng, how):
    role, change = how
    path = FILES_OF[role](draft, rng)

    def strike(folder):
        file = folder / path
        if file.is_file():
            file.write_bytes(change(file.read_bytes()))

    draft.after.append(strike)


for role, base in (("yaml", "any"), ("toml", "given"), ("clicks", "clicked")):
    kinds(
        "bytes",
        {
            f"{role}_saved_with_bom": (role, lambda c: b"\xef\xbb\xbf" + c),
            f"{role}_saved_with_crlf": (role, lambda c: c.replace(b"\n", b"\r\n")),
            f"{role}_saved_with_blank_lines": (role, lambda c: b"\n\n" + c + b"\n\n"),
        },
        _harmless_text,
        phase=FILES,
        base=base,
        harmless=True,
    )


def _instead(draft, rng, how):
    role, make = how
    path = FILES_OF[role](draft, rng)

    def strike(folder):
        file = folder / path
        if file.exists() and not file.is_dir():
            file.unlink()
            make(file)

    draft.after.append(strike)
    draft.truth = None


def _loop(file):
    file.symlink_to(file.name)


def _outside(file):
    file.symlink_to("/etc/hostname")


for role in ("yaml", "toml", "clicks", "npz"):
    kinds(
        "bytes",
        {
            f"{role}_missing": (role, lambda file: None),
            f"{role}_is_a_folder": (role, lambda file: file.mkdir()),
            f"{role}_is_a_pipe": (role, os.mkfifo),
            f"{role}_links_to_itself": (role, _loop),
            f"{role}_links_outside": (role, _outside),
            f"{role}_links_to_a_device": (role, lambda file: file.symlink_to("/dev/zero")),
        },
        _instead,
        phase=FILES,
        base=BASES.get(role, "any"),
    )


def _text(draft, rng, how):
    role, before, after = how
    path = FILES_OF[role](draft, rng)

    def strike(folder):
        file = folder / path
        if file.is_file():
            file.write_text(file.read_text().replace(before, after, 1))

    draft.after.append(strike)
    draft.truth = None


kinds(
    "bytes",
    {
        "yaml_with_a_key_twice": ("yaml", "fps:", "fps: 50\nfps:"),
        "yaml_with_an_alias": ("yaml", "contract: 1", "contract: &a 1\nanother: *a"),
        "yaml_with_a_python_tag": ("yaml", "fps:", "x: !!python/object/apply:os.system [id]\nfps:"),
        "yaml_with_a_merge": ("yaml", "fps:", "<<: {a: 1}\nfps:"),
        "yaml_with_a_timestamp": ("yaml", "match_id: fuzz", "match_id: !!timestamp 2024-99-99"),
        "yaml_with_an_int_tag": ("yaml", "contract: 1", "contract: !!int ''"),
        "toml_with_a_key_twice": ("toml", "size =", "size = [1, 1]\nsize ="),
        "toml_with_dotted_keys": ("toml", "size =", ".".join("a" * 900) + " = 1\nsize ="),
        "clicks_with_a_key_twice": ("clicks", '"drawn"', '"points": [], "drawn"'),
        "clicks_with_a_surrogate": ("clicks", '"corner', '"\\ud800corner'),
    },
    _text,
    phase=FILES,
)


@kind("bytes", phase=FILES, harmless=True)
def foreign_files_beside(draft, rng):
    def strike(folder):
        for place in ("", "detections/", "annotations/"):
            if (folder / place).is_dir():
                for name in (".DS_Store", "._match.yaml", "Thumbs.db", "README.txt"):
                    (folder / f"{place}{name}").write_bytes(b"\0foreign")
        (folder / "detections" / ".cam0.npz").write_bytes(b"hidden")

    draft.after.append(strike)


# -------------------------------------------------------------------------------------- stills


def _still(draft, rng, make):
    name = some(draft, rng)
    size = draft.cameras[name].width, draft.cameras[name].height

    def strike(folder):
        (folder / "stills").mkdir(exist_ok=True)
        (folder / "stills" / f"{name}.png").write_bytes(make(size))

    draft.after.append(strike)


def _png(picture):
    import cv2

    return cv2.imencode(".png", picture)[1].tobytes()


def _declared(width, height):
    import struct
    import zlib

    def chunk(kind_of, content):
        check = zlib.crc32(kind_of + content)
        return struct.pack(">I", len(content)) + kind_of + content + struct.pack(">I", check)

    head = struct.pack(">IIBBBBB", width, height, 8, 2, 0, 0, 0)
    body = zlib.compress(b"\0" * 100)
    return b"\x89PNG\r\n\x1a\n" + chunk(b"IHDR", head) + chunk(b"IDAT", body) + chunk(b"IEND", b"")


kinds(
    "video",
    {
        "still_of_grass": lambda s: _png(np.full((s[1], s[0], 3), (40, 120, 60), np.uint8)),
        "still_of_another_size": lambda s: _png(np.zeros((90, 160, 3), np.uint8)),
        "still_cut_off": lambda s: _png(np.zeros((s[1], s[0], 3), np.uint8))[:-200],
        "still_of_text": lambda s: b"not a picture",
        "still_empty": lambda s: b"",
        "still_of_60000_by_60000": lambda s: _declared(60000, 60000),
    },
    _still,
    phase=FILES,
    base="clicked",
)


# -------------------------------------------------------------------------------------- videos


def write_videos(draft, folder):
    """Small videos of a match of which nothing else is known (base `filmed`)."""
    from worldpose.video.files import write_video

    (folder / "videos").mkdir(exist_ok=True)
    for number, each in enumerate(draft.spec["cameras"]):
        pictures = [
            np.full((each["height"], each["width"], 3), 20 + 10 * number + 3 * n, np.uint8)
            for n in range(draft.spec["clips"][0]["frame_count"])
        ]
        file = folder / "videos" / f"{each['id']}.mp4"
        write_video(file, pictures, float(draft.spec["fps"]), quality=5)


def _video(draft, rng, change):
    name = some(draft, rng)
    seed = int(rng.integers(2**32))

    def strike(folder):
        file = folder / "videos" / f"{name}.mp4"
        if file.is_file():
            file.write_bytes(change(file.read_bytes(), np.random.default_rng(seed)))

    draft.after.append(strike)


kinds(
    "video",
    {f"video_{label}": SPOILS[label] for label in SPOILS if not any(w in label for w in TEXTUAL)},
    _video,
    phase=FILES,
    base="filmed",
)


def _filmed_otherwise(draft, rng, how):
    frames, size, fps = how
    name = some(draft, rng)

    def strike(folder):
        from worldpose.video.files import write_video

        file = folder / "videos" / f"{name}.mp4"
        width, height = size or (64, 48)
        pictures = [np.full((height, width, 3), 50, np.uint8)] * frames
        write_video(file, pictures, fps, quality=5)

    draft.after.append(strike)


kinds(
    "video",
    {
        "video_of_one_frame": (1, None, 25.0),
        "video_of_another_size": (10, (32, 48), 25.0),
        "video_of_another_rate": (10, None, 50.0),
        "video_of_1_frame_a_second": (10, None, 1.0),
    },
    _filmed_otherwise,
    phase=FILES,
    base="filmed",
)
kinds(
    "video",
    {"video_of_more_frames": (40, None, 25.0)},
    _filmed_otherwise,
    phase=FILES,
    base="filmed",
    harmless=True,
)


def _pictures(draft, rng, names):
    camera = some(draft, rng)

    def strike(folder):
        file = folder / "videos" / f"{camera}.mp4"
        if file.is_file():
            file.unlink()
        place = folder / "videos" / camera
        place.mkdir()
        for name in names:
            (place / name).write_bytes(_png(np.full((48, 64, 3), 50, np.uint8)))

    draft.after.append(strike)
    draft.camera_spec(camera)["video"] = f"videos/{camera}"


kinds(
    "video",
    {
        "pictures_without_numbers": ["a.png", "b.png"],
        "pictures_with_gaps": ["0.png", "3.png", "9.png"],
        "pictures_of_huge_numbers": ["0.png", "99999999999999999999.png"],
        "no_pictures": [],
        "pictures_that_are_hidden": [".0.png"],
    },
    _pictures,
    phase=FILES,
    base="filmed",
)


# ------------------------------------------------------------------------------------ settings

VALUES = (
    "null",
    "true",
    '"x"',
    "[]",
    "{}",
    "0",
    "-1",
    "1e308",
    "1e-308",
    "nan",
    "Infinity",
    "1.5",
    "9" * 400,
)


def _setting(draft, rng, value):
    from flows.method import METHOD

    stages = [
        stage
        for stage in METHOD
        if stage.settings.model_fields
        and not {"detection", "redetection", "broadcast", "refitting"} & set(stage.name.split("_"))
    ]
    stage = one(rng, stages)
    name = one(rng, sorted(stage.settings.model_fields))
    draft.overrides.append(f"{stage.name}.{name}={value}")
    draft.truth = None


kinds("settings", {f"setting_of_{value[:12]}": value for value in VALUES}, _setting)


def _assignment(draft, rng, text):
    draft.overrides.append(text)


kinds(
    "settings",
    {
        "setting_without_value": "triangulation.min_views",
        "setting_of_unknown_stage": "triangulating.min_views=3",
        "setting_of_unknown_name": "triangulation.min_view=3",
        "setting_of_surrogate": 'triangulation.min_views="\\ud800"',
        "setting_of_deep_json": "triangulation.min_views=" + "[" * 3000,
    },
    _assignment,
)
