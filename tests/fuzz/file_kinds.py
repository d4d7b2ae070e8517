"""Files that are not what their names say: raw bytes, links and videos."""

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


@kind("bytes", phase=FILES, harmless=True)
def foreign_files_beside(draft, rng):
    def strike(folder):
        for place in ("", "detections/", "annotations/"):
            if (folder / place).is_dir():
                for name in (".DS_Store", "._match.yaml", "Thumbs.db", "README.txt"):
                    (folder / f"{place}{name}").write_bytes(b"\0foreign")
        (folder / "detections" / ".cam0.npz").write_bytes(b"hidden")

    draft.after.append(strike)


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
