"""Files of the FIFA skeletal tracking challenge: boxes, skeletons of fitted bodies, submissions."""

from __future__ import annotations

import tempfile
import zipfile
from collections.abc import Collection, Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Final, Literal

import numpy as np
from numpy.lib import format as npy
from numpy.typing import NDArray

from data_contracts.arrays import Floats
from data_contracts.records import FRAME_LIMIT
from worldpose.body.keypoints import BODY25, CHALLENGE15, fold_keypoints
from worldpose.body.model import BodyModel, BodyParameters
from worldpose.errors import InputError, say_failure
from worldpose.formats.archives import Member, read_archive, write_archive, wrong
from worldpose.formats.files import whole_file
from worldpose.formats.release_cameras import camera_arrays
from worldpose.formats.tables import read_parquet
from worldpose.geometry.cameras import Camera
from worldpose.parsing import read_npy


@dataclass(frozen=True, eq=False)
class ChallengeClip:
    """Players of one clip in the moving camera's image, in the challenge's format."""

    boxes: Floats
    """(frames, persons, 4) x0, y0, x1, y1 [px]; NaN when absent."""
    skel_2d: Floats
    """(frames, persons, 15 or 25, 2) [px]; NaN when absent."""
    skel_3d: Floats
    """(frames, persons, 15 or 25, 3) [m], camera axes, about the mid-hip; NaN when absent."""


@dataclass(frozen=True, eq=False)
class ChallengeTruth:
    """A clip of the challenge, and its ground truth."""

    clip: ChallengeClip
    persons: NDArray[np.int64]
    """(persons,) indices into the poses that it was made from: people visible in any frame."""
    submission: Floats
    """(persons, frames, 15, 3) [m], world; NaN if there is no body."""


def challenge_truth(model: BodyModel, poses: BodyParameters, camera: Camera) -> ChallengeTruth:
    """Return boxes and skeletons of fitted bodies in the moving camera's image.

    A box contains the part of a body inside the image; a person outside the image has neither box
    nor skeleton in that frame. Skeletons are BODY25 and extend beyond the image border. `skel_3d`
    is the ideal result of a single-view estimator: the skeleton in the camera's axes, with the
    mid-hip as origin. Poses are (persons, frames); the camera (frames,) is NaN where there is none.
    """
    persons, frames = poses.batch_shape
    points = fold_keypoints(model, BODY25)
    joints = np.empty((frames, persons, len(BODY25), 3))
    boxes = np.empty((frames, persons, 4))
    block_frames = 8  # whose surfaces are in memory at a time; 33 MB for 25 people
    for start in range(0, frames, block_frames):
        part = slice(start, min(start + block_frames, frames))
        some = poses[:, part]
        joints[part] = points(some).swapaxes(0, 1)
        boxes[part] = _boxes(camera[part], model.vertices(some).swapaxes(0, 1))
    seen = np.all(np.isfinite(boxes), axis=-1)[..., None, None]
    pixels = _project(camera, joints)
    turned = np.einsum("fab,fpjb->fpja", camera.cam_from_world.rotation, joints)
    relative = turned - turned[:, :, BODY25.index("mid_hip"), None]
    clip = ChallengeClip(boxes, np.where(seen, pixels, np.nan), np.where(seen, relative, np.nan))
    kept = np.flatnonzero(seen.any((0, 2, 3)))
    places = [BODY25.index(name) for name in CHALLENGE15]
    return ChallengeTruth(
        ChallengeClip(clip.boxes[:, kept], clip.skel_2d[:, kept], clip.skel_3d[:, kept]),
        kept,
        joints[:, kept][:, :, places].swapaxes(0, 1),
    )


def _project(camera: Camera, points: Floats) -> Floats:
    """Project points (frames, persons, n, 3) to pixels (frames, persons, n, 2)."""
    frames, persons, count = points.shape[:3]
    return camera.project(points.reshape(frames, -1, 3)).reshape(frames, persons, count, 2)


def _boxes(camera: Camera, surface: Floats) -> Floats:
    """Return boxes (frames, persons, 4) of points (frames, persons, n, 3), clipped to the image."""
    pixels = _project(camera, surface)
    edge = camera.image_size[:, None, None] - 0.5
    missing = np.isnan(pixels).any(-1, keepdims=True)
    low = np.where(missing, np.inf, pixels).min(2)
    high = np.where(missing, -np.inf, pixels).max(2)
    low, high = np.maximum(low, -0.5), np.minimum(high, edge[:, 0])
    boxes = np.concatenate([low, high], axis=-1)
    boxes[~(low < high).all(-1)] = np.nan
    return boxes


Edition = Literal[2025, 2026]

SUBMISSION: Final = "submission.npz"
"""Member of a submission's zip."""
_COLUMNS: Final = ("sequence", "frame", "person", "joint", "x", "y", "z")
"""Columns of a submission's table, beside `row_id`."""
PARQUET: Final = ".parquet"
"""Ending of a submission's table."""
KINDS: Final = {"boxes": (4,), "skel_2d": ("points", 2), "skel_3d": ("points", 3)}
"""Arrays per clip, and their dimensions after frames and persons."""


def write_challenge_camera(path: Path, camera: Camera, edition: Edition) -> float:
    """Write cameras/<clip>.npz; return the greatest error of the lens in the image [px].

    It has every frame's K and k, and R and t of the first frame alone; InputError if that has no
    camera. The kit's lenses have k1 and k2 alone: with others, those are the best over the image's
    pixels. The edition of 2025 repeats R and t as Rt.
    """
    if np.isnan(camera.numbers[0]).any():
        raise wrong(
            str(path),
            "a camera in the clip's first frame, whose pose the layout gives",
            "none",
            "Calibrate the first frame, or export another format.",
        )
    arrays = camera_arrays(camera)
    arrays["k"], worst = arrays["k"].copy(), 0.0
    for frame in np.flatnonzero(arrays["k"][:, 2:].any(axis=1) & np.isfinite(camera.focal[:, 0])):
        one = camera[int(frame)]
        rays = one.normalize(pixels := one.image_grid())
        radius = (rays**2).sum(axis=-1)
        known = np.isfinite(radius)  # a lens may fold in the corners
        off = ((pixels - one.principal_point) / one.focal - rays)[known]
        columns = np.stack([rays * radius[:, None] ** power for power in (1, 2)], axis=-1)[known]
        k, *_ = np.linalg.lstsq(columns.reshape(-1, 2), off.reshape(-1), rcond=None)
        arrays["k"][frame] = [*k, 0.0, 0.0, 0.0]
        rest = (columns @ k - off) * one.focal
        worst = max(worst, float(np.linalg.norm(rest, axis=-1).max()))
    arrays["R"], arrays["t"] = arrays["R"][:1], arrays["t"][:1]
    if edition == 2025:
        arrays["Rt"] = np.concatenate([arrays["R"], arrays["t"][..., None]], axis=-1)
    write_archive(path, arrays)
    return worst


def write_challenge(
    folder: Path, clips: Mapping[str, ChallengeClip], edition: Edition
) -> list[Path]:
    """Write boxes and skeletons of clips; return the files."""
    written = []
    for kind in KINDS:
        arrays = {clip: getattr(data, kind).astype(np.float64) for clip, data in clips.items()}
        if edition == 2025:
            written.append(folder / f"{kind}.npz")
            write_archive(written[-1], arrays)
            continue
        for clip, array in arrays.items():
            written.append(folder / kind / f"{clip}.npy")
            with whole_file(written[-1]) as draft, draft.open("wb") as file:
                npy.write_array(file, np.ascontiguousarray(array, "<f8"), version=(1, 0))
    return written


def write_submission(path: Path, joints: Mapping[str, Floats]) -> None:
    """Write a submission: (persons, frames, 15, 3) [m, world] by clip, in single precision.

    The ending decides the form: zip, npz, or a table as of 2025 (parquet).
    """
    if path.suffix.lower() == PARQUET:
        import pandas as pd  # late: it takes 0.3 s

        from worldpose.formats.tables import write_parquet

        parts = []
        for clip, array in joints.items():
            at = np.argwhere(np.isfinite(array).all(-1))
            columns = dict(zip(("person", "frame", "joint"), at.T, strict=True))
            places = dict(zip("xyz", array[tuple(at.T)].T, strict=True))
            parts.append(pd.DataFrame({"sequence": clip, **columns, **places}))
        table = pd.concat(parts)[[*_COLUMNS]]
        ids = (table[name].astype(str) for name in _COLUMNS[:4])
        table.insert(0, "row_id", ["_".join(row) for row in zip(*ids, strict=True)])
        write_parquet(path, table, {})
        return
    if path.suffix.lower() == ".npz":
        write_archive(path, {clip: array.astype(np.float32) for clip, array in joints.items()})
        return
    single = {clip: array.astype(np.float32) for clip, array in joints.items()}
    with tempfile.TemporaryDirectory() as workshop:
        inner = Path(workshop) / SUBMISSION
        write_archive(inner, single)
        with whole_file(path) as draft, zipfile.ZipFile(draft, "w") as file:
            file.writestr(zipfile.ZipInfo(SUBMISSION), inner.read_bytes(), zipfile.ZIP_DEFLATED)


def fill_submission(joints: Floats, places: Floats) -> tuple[Floats, int]:
    """Return joints (persons, frames, 15, 3) [m] without gaps, and the number of poses added.

    A challenge scores every box, also where no body could be fitted. Such a frame takes the
    person's body of the nearest frame, or else the mean of all bodies, at the person's place
    (persons, frames, 2) [m], below the mid-hip; NaN where unknown.
    """
    hips = [CHALLENGE15.index(name) for name in ("right_hip", "left_hip")]
    root = joints[..., hips, :2].mean(axis=-2)
    body = joints.copy()
    body[..., :2] -= root[..., None, :]
    has = np.asarray(np.isfinite(joints).all((-1, -2)))
    mean = body[has].mean(axis=0)
    filled, frames = joints.copy(), np.arange(joints.shape[1])
    for person in range(len(joints)):
        at, known = (np.flatnonzero(each) for each in (has[person], _finite(places[person])))
        lacks = np.flatnonzero(~has[person])
        if len(known):
            track = np.stack([np.interp(frames, known, axis[known]) for axis in places[person].T])
        elif len(at):
            track = np.stack([np.interp(frames, at, axis[at]) for axis in root[person].T])
        else:
            continue
        own = body[person, at[np.abs(at - lacks[:, None]).argmin(axis=1)]] if len(at) else mean
        filled[person, lacks] = own
        filled[person, lacks, :, :2] += track.T[lacks, None]
    return filled, int((_finite(filled).all(-1) & ~has).sum())


def _finite(points: Floats) -> NDArray[np.bool_]:
    return np.asarray(np.isfinite(points).all(-1))


def write_pitch_points(path: Path, points: Floats) -> None:
    """Write points (n, 3) [m, world] along the markings, one per line."""
    with whole_file(path) as draft:
        np.savetxt(draft, points, fmt="%.4f")


def read_challenge(folder: Path, only: str | None = None) -> dict[str, ChallengeClip]:
    """Read the clips of a challenge folder of either edition, by name, or the `only` one wanted."""
    kinds: dict[str, dict[str, Floats]] = {}
    for kind in KINDS:
        together = folder / f"{kind}.npz"
        files = sorted((folder / kind).glob("*.npy"))
        if together.is_file():
            dims = ("frames", "persons", *KINDS[kind])
            kinds[kind] = _by_clip(together, dims, None if only is None else (only,))
        elif files:
            kinds[kind] = {
                file.stem: read_kit_array(file, kind) for file in files if only in (None, file.stem)
            }
        else:
            raise wrong(
                str(folder), f"{kind}/<clip>.npy or {kind}.npz", "neither", "Check the path."
            )
    clips = {}
    for clip, boxes in kinds["boxes"].items():
        arrays = {"boxes": boxes}
        for kind in ("skel_2d", "skel_3d"):
            array = kinds[kind].get(clip)
            if array is None or array.shape[:2] != boxes.shape[:2]:
                raise wrong(
                    f"{folder}: {kind} of {clip}",
                    f"shape {boxes.shape[:2]} of frames and persons, as the boxes have",
                    "nothing" if array is None else f"{array.shape[:2]}",
                )
            arrays[kind] = array
        clips[clip] = ChallengeClip(**arrays)
    return clips


def submission_clips(path: Path) -> tuple[str, ...]:
    """Return the names of a submission's clips without loading them; InputError if it is none."""
    if path.suffix.lower() == PARQUET:
        return tuple(_read_table(path, None))
    with _npz_of(path) as file:
        return _clips_of(file)


def is_submission(path: Path) -> bool:
    """Return whether a file has a submission's layout: a zip with one, an npz or a table."""
    if not path.is_file() or path.suffix.lower() not in (".zip", ".npz", PARQUET):
        return False
    if path.suffix.lower() == PARQUET:
        return True
    try:
        return "joints" not in submission_clips(path)  # a joints file is an npz, too
    except InputError:
        return False


def read_submission(path: Path, only: Collection[str] | None = None) -> dict[str, Floats]:
    """Read the joints (persons, frames, 15, 3) [m, world] of a submission by clip.

    It is an npz, zipped or bare, or a table as of 2025, with a row for each joint of sequence,
    frame, person, joint, x, y, z. A table's last persons and frames are those with a joint. Of the
    clips, `only` names those to load.
    """
    if path.suffix.lower() == PARQUET:
        return _read_table(path, only)
    with _npz_of(path) as file:
        return _by_clip(file, ("persons", "frames", 15, 3), only)


def _read_table(path: Path, only: Collection[str] | None) -> dict[str, Floats]:
    """Read a submission's table (parquet) by clip."""
    table = read_parquet(path, _COLUMNS)

    def numbers(names: Sequence[str]) -> Floats:
        try:
            return np.stack([table[name].astype(np.float64) for name in names], axis=1)
        except (ValueError, TypeError) as error:
            raise wrong(f"{path}: {', '.join(names)}", "numbers", say_failure(error)) from error

    index = numbers(_COLUMNS[1:4])
    max_persons = 1000  # in a submission's table [1]
    limits = np.array([FRAME_LIMIT, max_persons, len(CHALLENGE15)])
    off = (index != np.floor(index)) | (index < 0) | (index >= limits)
    if off.any():
        row, column = np.argwhere(off)[0].tolist()
        where = f"{path}: row {row}: {_COLUMNS[1 + column]}"
        raise wrong(
            where, f"a whole number from 0 to {limits[column] - 1}", f"{index[row, column]}"
        )
    values = numbers(_COLUMNS[4:])
    sequence, found = table["sequence"].astype(np.str_), dict[str, Floats]()
    for clip in np.unique(sequence).tolist():
        own = sequence == clip
        frame, person, joint = index[own].astype(np.int64).T
        shape = (int(frame.max()) + 1, int(person.max()) + 1, len(CHALLENGE15))
        counts = np.bincount(np.ravel_multi_index((frame, person, joint), shape))
        if (counts > 1).any():
            cell = np.unravel_index(int(counts.argmax()), shape)
            twice = "frame {}, person {}, joint {}".format(*cell)
            raise wrong(f"{path}: {clip}", "one row for each joint", f"several of {twice}")
        places = np.full((shape[1], shape[0], shape[2], 3), np.nan)
        places[person, frame, joint] = values[own]
        if only is None or clip in only:
            found[clip] = places
    return found


@contextmanager
def _npz_of(path: Path) -> Iterator[Path]:
    """Yield the npz file of a submission, unzipped to a temporary file if necessary."""
    if not path.is_file():
        raise wrong(str(path), "a submission", "nothing", "Check the path.")
    try:
        with zipfile.ZipFile(path) as file:
            if SUBMISSION not in file.namelist():
                yield path
                return
            with tempfile.TemporaryDirectory() as workshop:
                yield Path(file.extract(SUBMISSION, workshop))
    except (zipfile.BadZipFile, OSError, RuntimeError) as error:
        raise wrong(str(path), f"a zip with {SUBMISSION}", f"{error}") from error


def _clips_of(path: Path) -> tuple[str, ...]:
    try:
        with zipfile.ZipFile(path) as file:
            return tuple(name.removesuffix(".npy") for name in file.namelist())
    except zipfile.BadZipFile as error:
        raise wrong(str(path), "a whole npz file", f"{error}") from error


def _by_clip(
    path: Path, dims: tuple[str | int, ...], only: Collection[str] | None = None
) -> dict[str, Floats]:
    """Read arrays of an npz file by clip; named lengths can differ between clips."""
    members = {
        name: Member(tuple(f"{d} of {name}" if isinstance(d, str) else d for d in dims), "float")
        for name in _clips_of(path)
    }
    found: dict[str, Any] = read_archive(path, members, only)
    return found


def read_kit_array(path: Path, kind: str) -> Floats:
    """Return a clip's array of one of `KINDS`; InputError if it is no npy of floats so shaped."""
    try:
        with path.open("rb") as stream:
            array = read_npy(stream)
    except (OSError, ValueError, EOFError) as error:
        raise wrong(str(path), "an npy array", f"{error}") from error
    tail = KINDS[kind]
    fits = array.ndim == 2 + len(tail) and array.dtype.kind == "f"
    fits = fits and all(
        isinstance(d, str) or n == d for n, d in zip(array.shape[2:], tail, strict=True)
    )
    if not fits:
        expected = f"float numbers of shape (frames, persons, {', '.join(map(str, tail))})"
        todo = "Write the file again."
        raise InputError(str(path), expected, f"{array.dtype} of shape {array.shape}", todo)
    return array.astype(np.float64)
