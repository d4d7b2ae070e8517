"""Reader and writer of 2D poses as npz: the arrays of `KeypointDetections`, faster than JSON.

Members: `frame` (frames,) int64, `keypoints` (frames, detections, 17, 2), `confidence` (frames,
detections, 17), `boxes` (frames, detections, 4) and `score` (frames, detections), all float32 in
little-endian order, NaN where missing (`data_contracts.keypoints`).
"""

from __future__ import annotations

import zipfile
from pathlib import Path
from typing import Final, cast

import numpy as np
from numpy.lib import format as npy
from numpy.typing import NDArray

from data_contracts.conventions import COCO17
from data_contracts.keypoints import KeypointDetections
from data_contracts.records import FRAME_LIMIT
from worldpose.errors import InputError
from worldpose.ingest.npz_files import (
    Header,
    npz_error,
    open_npz,
    read_array,
    read_header,
    require_size,
)
from worldpose.ingest.text_files import require_file

ARRAY_BYTES: Final = 4 << 30
"""Maximum size of one file's arrays [byte]; two hours of 25 people at 50 Hz are 2 GB."""

PEOPLE_LIMIT: Final = 1000
"""Maximum people per frame of one camera; a stadium's stands in one image have a few hundred."""

COORDINATE_LIMIT: Final = 1e6
"""Maximum absolute coordinate of a keypoint or box corner [px]."""

_BLOCK: Final = 4096
"""Frames per block of checks, which limits their memory."""
_BLOCK_PEOPLE: Final = 100_000
"""Maximum detections per block."""

_SHAPES: Final = {
    "frame": ("frames",),
    "keypoints": ("frames", "detections", len(COCO17), 2),
    "confidence": ("frames", "detections", len(COCO17)),
    "boxes": ("frames", "detections", 4),
    "score": ("frames", "detections"),
}


def write_keypoint_arrays(path: Path, people: KeypointDetections) -> None:
    """Write an npz file; the same arrays give the same bytes on every machine.

    The file has no compression, since a compressor's output changes with its version.
    """
    with zipfile.ZipFile(path, "w") as file:
        for name, array in {"frame": people.frame, **people.arrays()}.items():
            dtype = "<i8" if name == "frame" else "<f4"
            # A ZipInfo from a name alone has the fixed date 1980-01-01.
            with file.open(zipfile.ZipInfo(f"{name}.npy"), "w", force_zip64=True) as member:
                npy.write_array(member, np.ascontiguousarray(array, dtype), allow_pickle=False)


def read_keypoint_arrays(path: Path) -> KeypointDetections:
    """Return the people of an npz file as stored; frames rise, possibly with gaps.

    The function checks every declared type, shape and size before it unpacks data.

    Raises:
        InputError: with file and member: truncated or no npz, another type, shape or byte order,
            too large, frames that do not rise, infinite values, or a keypoint without confidence.
    """
    require_file(path)
    with open_npz(path) as file:
        infos = _members(path, file)
        headers = {name: read_header(path, file, info) for name, info in infos.items()}
        _check_headers(path, infos, headers)
        arrays = {name: read_array(path, file, info) for name, info in infos.items()}
    people = KeypointDetections(
        frame=cast("NDArray[np.int64]", arrays["frame"]),
        keypoints=cast("NDArray[np.float32]", arrays["keypoints"]),
        confidence=cast("NDArray[np.float32]", arrays["confidence"]),
        boxes=cast("NDArray[np.float32]", arrays["boxes"]),
        score=cast("NDArray[np.float32]", arrays["score"]),
    )
    _check_values(path, people)
    return people


def _members(path: Path, file: zipfile.ZipFile) -> dict[str, zipfile.ZipInfo]:
    names = [info.filename for info in file.infolist()]
    expected = [f"{name}.npy" for name in _SHAPES]
    if sorted(names) != sorted(expected):
        found = ", ".join(names[:8]) or "nothing"
        raise npz_error(str(path), f"the members {', '.join(expected)}", found)
    return {name: file.getinfo(f"{name}.npy") for name in _SHAPES}


def _check_headers(
    path: Path, infos: dict[str, zipfile.ZipInfo], headers: dict[str, Header]
) -> None:
    sizes: dict[str, int] = {}
    for name, dims in _SHAPES.items():
        where = f"{path}: {infos[name].filename}"
        shape, _, dtype = headers[name]
        wanted = np.dtype("<i8" if name == "frame" else "<f4")
        if dtype != wanted:
            raise npz_error(where, f"{wanted.str} ({wanted.name}, little-endian)", dtype.str)
        fits = len(shape) == len(dims) and all(
            n >= 0 and n == (sizes.setdefault(dim, n) if isinstance(dim, str) else dim)
            for n, dim in zip(shape, dims, strict=True)
        )
        if not fits:
            known = tuple(sizes.get(dim, dim) if isinstance(dim, str) else dim for dim in dims)
            raise npz_error(where, f"shape {known}".replace("'", ""), f"{shape}")
    if sizes["detections"] > PEOPLE_LIMIT:
        raise InputError(
            f"{path}: {infos['score'].filename}",
            expected=f"at most {PEOPLE_LIMIT} people per frame",
            found=f"room for {sizes['detections']}",
            todo="Keep the detections of each frame with the highest scores.",
        )
    require_size(path, list(infos.values()), ARRAY_BYTES)


def _check_values(path: Path, people: KeypointDetections) -> None:
    steps = np.diff(people.frame)
    if np.any(steps <= 0):
        place = int(np.argmax(steps <= 0)) + 1
        raise npz_error(
            f"{path}: frame[{place}]", "frame numbers that rise", f"{people.frame[place]}"
        )
    if np.any(np.abs(people.frame) > FRAME_LIMIT):
        raise npz_error(f"{path}: frame", f"frame numbers up to {FRAME_LIMIT}", "larger ones")
    block = max(1, min(_BLOCK, _BLOCK_PEOPLE // max(1, people.score.shape[1])))
    for start in range(0, len(people.frame), block):
        _check_block(path, start, people[start : start + block])


def _check_block(path: Path, start: int, people: KeypointDetections) -> None:
    found = np.isfinite(people.confidence)
    person = np.any(found, axis=-1)
    unlike = (np.isfinite(people.keypoints) != found[..., None]).any(axis=-1)
    far = np.abs(people.keypoints) > COORDINATE_LIMIT
    ordered = ~np.any(people.boxes[..., :2] > people.boxes[..., 2:], axis=-1)
    checks = (
        ("keypoints", far.any(axis=-1), f"pixels up to {COORDINATE_LIMIT:g}"),
        ("keypoints", unlike, "finite exactly where confidence is"),
        (
            "confidence",
            (people.confidence <= 0) | (people.confidence > 1),
            "values in (0, 1], NaN where not found",
        ),
        ("boxes", (np.abs(people.boxes) > COORDINATE_LIMIT).any(axis=-1) | ~ordered, "x0 y0 x1 y1"),
        ("boxes", person & np.isnan(people.boxes).any(axis=-1), "a box for every person"),
        ("score", np.isinf(people.score) | (people.score < 0), "finite values from 0"),
        ("score", person & np.isnan(people.score), "a score for every person"),
    )
    for name, wrong, rule in checks:
        if np.any(wrong):
            place = tuple(int(i) for i in np.argwhere(wrong)[0])
            value = getattr(people, name)[place]
            where = [place[0] + start, *place[1:]]
            raise npz_error(
                f"{path}: {name}{where} (frame {people.frame[place[0]]})", rule, f"{value}"
            )
