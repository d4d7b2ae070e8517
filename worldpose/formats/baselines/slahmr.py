"""SLAHMR: folders of its runs, one for each piece of the video, all people in one world.

Layout as written by vye16/slahmr at commit 58518fe, slahmr/run_opt.py, slahmr/optim/optimizers.py
(`save_results`), slahmr/optim/output.py and slahmr/optim/moving_scene.py: in each run's folder
`track_info.json` with the tracks' `index` and `vis_mask` and the intervals of images, and for
each phase `<phase>/<clip>_<iteration>_world_results.npz` with SMPL+H `root_orient` (B, T, 3),
`pose_body` (B, T, 63), `trans` (B, T, 3), and `cam_R` (B, T, 3, 3), `cam_t` (B, T, 3) of
x_cam = R x_world + t; `<clip>_cameras_<iteration>.json` has `intrinsics` (T, 4) fx fy cx cy px.

The method moves every piece's world so that its first camera is near the origin, and scales its
camera path. Pieces are joined at their cameras: the orientation of one SLAM run is common to all,
and the centre of a piece's first camera is moved to the last one of the previous piece.
"""

from __future__ import annotations

import json
from collections.abc import Callable
from pathlib import Path
from typing import Any, Final

import numpy as np
from numpy.typing import NDArray

from worldpose.body import BodyModel
from worldpose.formats.baselines.fields import (
    floats,
    format_error,
    get_part,
    integer,
    integers,
    read_arrays,
)
from worldpose.formats.baselines.result import (
    MethodResult,
    Track,
    merge_people,
    pose_track,
    project_boxes,
)

WITH_MOTION_PRIOR: Final = "motion_chunks"
"""Phase with the final results."""
WITHOUT_MOTION_PRIOR: Final = "smooth_fit"
"""Phase before HuMoR, the motion prior, is used (E5)."""

_ARRAYS: Final = ("root_orient", "pose_body", "trans", "cam_R", "cam_t")
_Piece = tuple[NDArray[np.int64], NDArray[np.float64], NDArray[np.float64]]


def make_slahmr_reader(phase: str) -> Callable[[Path, BodyModel, tuple[int, int]], MethodResult]:
    """Return a reader for the results of one phase."""

    def read(path: Path, model: BodyModel, _: tuple[int, int]) -> MethodResult:
        return read_slahmr(path, model, phase)

    return read


def read_slahmr(path: Path, model: BodyModel, phase: str) -> MethodResult:
    """Return the people of SLAHMR's runs.

    Args:
        path: a run's folder, or one that holds the folders of all pieces at any depth.
        model: body model to pose.
        phase: phase to read; its last iteration is used.

    Raises:
        InputError: the folder has another layout.
    """
    runs = sorted(
        (_read_run(info, model, phase) for info in sorted(path.rglob("track_info.json"))),
        key=lambda run: run[0],
    )
    if not runs:
        raise format_error(path, "track_info.json of a run", "no such file")
    pieces: dict[int, list[_Piece]] = {}
    last = None
    for _, people, centers, _ in runs:
        shift = np.zeros(3) if last is None else last - centers[0]
        last = centers[-1] + shift
        for person, (frames, joints, boxes) in people.items():
            pieces.setdefault(person, []).append((frames, joints + shift, boxes))
    found, around = [], []
    for person, some in sorted(pieces.items()):
        frames, joints, boxes = (np.concatenate(arrays) for arrays in zip(*some, strict=True))
        # Where pieces overlap, the first one is used.
        frames, first = np.unique(frames, return_index=True)
        found.append((person, frames, joints[first]))
        around.append(boxes[first])
    tracks, known = merge_people(found, around)
    notes = {"shape": runs[-1][3], "phase": phase, "pieces": str(len(runs))}
    return MethodResult(tracks, "shared", known, notes=notes)


def _read_run(
    info: Path, model: BodyModel, phase: str
) -> tuple[int, dict[int, _Piece], NDArray[np.float64], str]:
    """Return first image, people by id, camera centres, and the body model of the shapes."""
    where = str(info)
    try:
        content: Any = json.loads(info.read_bytes())
    except (OSError, ValueError, RecursionError) as error:
        raise format_error(where, "JSON", str(error)) from None
    files = sorted((info.parent / phase).glob("*_world_results.npz"))
    if not files:
        raise format_error(info.parent / phase, "<clip>_<iteration>_world_results.npz", "none")
    arrays = read_arrays(files[-1], _ARRAYS)
    place = floats(f"{files[-1]}: trans", arrays["trans"], (None, None, 3))
    count, length = place.shape[:2]
    turns, pose, camera, shift = (
        floats(f"{files[-1]}: {name}", arrays[name][:, :length], (count, length, *tail))
        for name, tail in (
            ("root_orient", (3,)),
            ("pose_body", (63,)),
            ("cam_R", (3, 3)),
            ("cam_t", (3,)),
        )
    )
    focal, center = _read_intrinsics(files[-1], length)
    begin = int(integers(where, get_part(where, content, "meta", "data_interval"), 2)[0])
    start = int(integers(where, get_part(where, content, "meta", "seq_interval"), 2)[0])
    people: dict[int, _Piece] = {}
    used = ""
    for name, track in get_part(where, content, "tracks").items():
        row = integer(where, get_part(where, track, "index"))
        mask = floats(where, get_part(where, track, "vis_mask"), (None,)) > 0.5
        if not mask.any():
            continue
        if row >= count:
            raise format_error(where, f"tracks below {count}, as the results have", f"{row}")
        # A track lasts from the first to the last image of its person, visible or not.
        seen = np.flatnonzero(mask) - start
        rows = np.arange(seen[0], min(seen[-1] + 1, length))
        joints, used = pose_track(
            Track(rows, turns[row, rows], pose[row, rows], place[row, rows]), model, "other"
        )
        relative = np.einsum("fab,fjb->fja", camera[row, rows], joints) + shift[row, rows, None]
        boxes = project_boxes(relative, focal[rows], center[rows])
        people[integer(where, name)] = (begin + start + rows, joints, boxes)
    centers = -np.einsum("fba,fb->fa", camera[0], shift[0])
    return begin + start, people, centers, used


def _read_intrinsics(results: Path, length: int) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Return focal lengths and principal points (images, 2) [px] for a results file."""
    iteration = results.name.split("_")[-3]
    files = sorted(results.parent.glob(f"*_cameras_{iteration}.json"))
    if not files:
        raise format_error(results.parent, f"<clip>_cameras_{iteration}.json", "none")
    try:
        rows = json.loads(files[0].read_bytes())["intrinsics"]
    except (OSError, ValueError, KeyError, TypeError, RecursionError) as error:
        raise format_error(files[0], "intrinsics in JSON", f"{error!r}") from None
    numbers = floats(f"{files[0]}: intrinsics", rows, (None, 4))
    if len(numbers) < length:
        raise format_error(files[0], f"intrinsics of {length} images", f"{len(numbers)}")
    return numbers[:length, :2], numbers[:length, 2:]
