"""Result of a baseline method for one clip, and checked access to parts of the method's file."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any, Literal, NamedTuple

import numpy as np
from numpy.typing import NDArray

from data_contracts.arrays import Floats
from data_contracts.conventions import COCO17
from worldpose.body.body_file import is_open_body
from worldpose.body.keypoints import fold_keypoints
from worldpose.body.model import BodyModel, BodyParameters
from worldpose.errors import InputError
from worldpose.formats.archives import write_archive
from worldpose.formats.files import whole_file
from worldpose.formats.joints_file import JointTracks
from worldpose.geometry.cameras import Camera
from worldpose.geometry.rigid import Rigid
from worldpose.pickles import read_pickle


def write_tracks(
    path: Path, boxes: NDArray[np.float64], ids: NDArray[np.int64], number: NDArray[np.integer]
) -> None:
    """Write boxes (frames, persons, 4) x0 y0 x1 y1 [px], NaN if absent, as a MOTChallenge text.

    One line for each person and image: image from 1, id, left, top, width, height [px] and
    confidence 1, then three times -1. In that format, (1, 1) is the top-left corner of the top-left
    pixel. `ids` (persons,) are renumbered from 1; `number` (frames,) counts a video's images from
    0.
    """
    frames, people = np.nonzero(np.isfinite(boxes).all(-1))
    found = boxes[frames, people]
    # (0, 0) is the centre of a pixel here, (1, 1) its upper left corner there.
    corners = np.concatenate([found[:, :2] + 1.5, found[:, 2:] - found[:, :2]], axis=1)
    lines = [
        f"{number[frame] + 1},{ids[person] + 1},{x:.2f},{y:.2f},{w:.2f},{h:.2f},1,-1,-1,-1"
        for frame, person, (x, y, w, h) in zip(frames, people, corners.tolist(), strict=True)
    ]
    with whole_file(path) as draft:
        draft.write_text("".join(f"{line}\n" for line in lines), encoding="ascii")


def write_slahmr_cameras(path: Path, camera: Camera) -> None:
    """Write `cameras.npz` of a camera (frames,) as SLAHMR reads it, to use true cameras.

    Members: `height`, `width`, `focal` [px], `intrins` (frames, 4) fx fy cx cy [px] and `w2c`
    (frames, 4, 4), in world axes with y down: x as in the world, z along the world's y. The method
    has no distortion model. InputError if a frame has no camera. Layout as read by vye16/slahmr at
    commit 58518fe, slahmr/data/dataset.py (`load_cameras_npz`).
    """
    missing = np.flatnonzero(np.isnan(camera.numbers).any(-1))
    if len(missing):
        found = f"none in {len(missing)} of {len(camera.focal)}, the first {missing[0]}"
        todo = "Calibrate the camera there, or shorten the clip."
        raise InputError(
            str(path), "a camera in every frame: the method knows no gaps", found, todo
        )
    pose = camera.cam_from_world
    transforms = np.tile(np.eye(4), (len(camera.focal), 1, 1))
    # Rotation of world points to axes with y down, the ground orientation of SLAHMR.
    y_down = np.array([[1.0, 0.0, 0.0], [0.0, 0.0, -1.0], [0.0, 1.0, 0.0]])
    transforms[:, :3, :3] = pose.rotation @ y_down.T
    transforms[:, :3, 3] = pose.translation
    width, height = camera.image_size.reshape(-1, 2)[0]
    write_archive(
        path,
        {
            "height": np.array(height),
            "width": np.array(width),
            "focal": np.array(camera.focal.mean()),
            "intrins": np.concatenate([camera.focal, camera.principal_point], axis=-1),
            "w2c": transforms,
        },
    )


World = Literal["shared", "own", "camera"]
"""Reference frame of people: one for all, one per person, or the camera's in each frame."""
Shape = Literal["smpl", "open", "other"]
"""Body model of a file's betas: SMPL, the open body, or another (SMPL+H, SMPL-X, ...), whose
betas are not used here."""
Place = Literal["transl", "pelvis", "mid_hip"]
"""Reference point of a position: `transl` is added to SMPL's joints; the others are points."""


@dataclass(frozen=True, eq=False)
class MethodResult:
    """People of a clip as estimated by a method."""

    joints: JointTracks
    """Frames count the images from 0; COCO-17 [m]."""
    world: World
    boxes: Floats | None = None
    """(frames, persons, 4) x0 y0 x1 y1 [px] in the image; None if the file has none."""
    image_size: tuple[float, float] | None = None
    """Width and height of the image that the boxes refer to [px]; None = that of the video."""
    notes: Mapping[str, str] = field(default_factory=dict)
    """Processing beyond reading, for the settings that are recorded with a score."""


@dataclass(frozen=True, eq=False)
class MethodTrack:
    """Bodies of one person in some frames."""

    frames: NDArray[np.int64]
    """(frames,) images from 0, ascending."""
    global_orient: Floats
    """(frames, 3) [rad]."""
    body_pose: Floats
    """(frames, 63 or 69) [rad]; missing hands are flat."""
    place: Floats
    """(frames, 3) [m]."""
    betas: Floats | None = None
    """(frames, 10 or more), or (10 or more,)."""
    scale: Floats | None = None
    """(frames,) scale factor of the body about its pelvis; None = 1."""

    @classmethod
    def of_matrices(
        cls, frames: NDArray[np.int64], matrices: Floats, place: Floats, betas: Floats
    ) -> MethodTrack:
        """Return the track of rotation matrices (frames, 24, 3, 3) relative to the parents."""
        vectors = Rigid(np.asarray(matrices, np.float64), np.zeros(matrices.shape[:-1])).rotvec
        return cls(frames, vectors[:, 0], vectors[:, 1:].reshape(-1, 69), place, betas)


@dataclass
class Poser:
    """Poses the bodies of a result with a body model; `image_size` is the result's [px]."""

    model: BodyModel
    notes: dict[str, str] = field(default_factory=dict)
    image_size: tuple[float, float] | None = None

    def joints(self, track: MethodTrack, shape: Shape, place: Place = "transl") -> Floats:
        """Return a person's joints (frames, 17, 3) [m], with betas if the model is `shape`'s."""
        model, count = self.model, len(track.frames)
        pose = np.zeros((count, 69))
        pose[:, : track.body_pose.shape[-1]] = track.body_pose
        betas = np.zeros((count, model.shapes))
        self.notes["shape"] = f"the mean shape of {model.name}"
        if track.betas is not None and shape == ("open" if is_open_body(model.name) else "smpl"):
            known = min(model.shapes, track.betas.shape[-1])
            betas[:, :known] = track.betas[..., :known]
            self.notes["shape"] = "the file's betas"
        shift = track.place if place == "transl" else np.zeros((count, 3))
        names = (*COCO17, "mid_hip")
        keypoints = fold_keypoints(model, names)
        points = np.empty((count, len(names), 3))
        chunk_bodies = 4096  # bodies posed per chunk: 50 MB
        for start in range(0, count, chunk_bodies):
            part = slice(start, start + chunk_bodies)
            points[part] = keypoints(
                BodyParameters(betas[part], track.global_orient[part], pose[part], shift[part])
            )
        joints, pelvis = points[:, :-1], points[:, -1:]
        if track.scale is not None:
            joints = pelvis + track.scale[:, None, None] * (joints - pelvis)
        if place == "pelvis":
            joints = joints - pelvis + track.place[:, None]
        elif place == "mid_hip":
            hips = joints[:, COCO17.index("left_hip")] + joints[:, COCO17.index("right_hip")]
            joints = joints - 0.5 * hips[:, None] + track.place[:, None]
        return joints


class Person(NamedTuple):
    """One person of a result."""

    id: int
    frames: NDArray[np.int64]
    """(frames,) images from 0, ascending."""
    joints: Floats
    """(frames, 17, 3) [m]."""
    boxes: Floats | None = None
    """(frames, 4) [px]; None if unknown."""


def merge_people(
    world: World,
    people: Sequence[Person],
    notes: Mapping[str, str],
    image_size: tuple[float, float] | None = None,
) -> MethodResult:
    """Merge people with their own frames, NaN where one is missing; InputError without people."""
    if not people:
        todo = "Check that this is the result for the clip, or run the method again."
        raise InputError("results of a method", "at least one person", "no people", todo)
    frames = np.unique(np.concatenate([person.frames for person in people]))
    joints = np.full((len(frames), len(people), len(COCO17), 3), np.nan)
    around = np.full((len(frames), len(people), 4), np.nan)
    for place, person in enumerate(people):
        rows = np.searchsorted(frames, person.frames)
        joints[rows, place] = person.joints
        if person.boxes is not None:
            around[rows, place] = person.boxes
    ids = np.array([person.id for person in people], dtype=np.int64)
    boxes = around if np.isfinite(around).any() else None
    return MethodResult(JointTracks(frames, ids, joints), world, boxes, image_size, notes)


def project_boxes(joints: Floats, focal: Floats, center: Floats) -> Floats:
    """Return boxes (frames, 4) x0 y0 x1 y1 [px] around one person's joints in an image.

    Joints (frames, 17, 3) [m] are in camera axes, those behind the camera are ignored; the focal
    length and the principal point [px] are (2,) or (frames, 2).
    """
    ahead = joints[..., 2:] > 0.0
    depth = np.where(ahead, joints[..., 2:], np.nan)
    focal, center = (np.broadcast_to(v, (len(joints), 2))[:, None] for v in (focal, center))
    pixels = joints[..., :2] / depth * focal + center
    return boxes_around(pixels)


def boxes_around(pixels: Floats) -> Floats:
    """Return boxes (..., 4) around points (..., n, 2) [px]; NaN without any."""
    known = np.isfinite(pixels).all(-1, keepdims=True)
    low = np.where(known, pixels, np.inf).min(-2)
    high = np.where(known, pixels, -np.inf).max(-2)
    found = np.concatenate([low, high], axis=-1)
    return np.where(np.isfinite(found), found, np.nan)


def resample_result(result: MethodResult, seen_fps: float, fps: float) -> MethodResult:
    """Return a result of images at `seen_fps` at its clip's frames at `fps`, linearly interpolated.

    The first images of both are simultaneous. If either of the two images around a frame lacks a
    person, the frame lacks the person, too.
    """
    if seen_fps == fps or not len(result.joints.frames):
        return result
    own = result.joints.frames
    # A rounding error must not drop the last frame.
    first = int(np.ceil(own[0] * fps / seen_fps - 1e-6))
    last = int(np.floor(own[-1] * fps / seen_fps + 1e-6))
    frames = np.arange(first, last + 1)
    places = np.clip(frames * seen_fps / fps, own[0], own[-1])
    joints = _interpolate(result.joints.joints, own, places)
    boxes = None if result.boxes is None else _interpolate(result.boxes, own, places)
    note = f"from {seen_fps:g} to {fps:g} images per second, by linear interpolation"
    return replace(
        result,
        joints=JointTracks(frames, result.joints.person_ids, joints),
        boxes=boxes,
        notes={**result.notes, "resampled": note},
    )


def _interpolate(values: Floats, own: NDArray[np.int64], places: Floats) -> Floats:
    """Interpolate values (images, ...) at positions [images]; NaN if a neighbour is missing."""
    before = np.floor(places + 1e-6).astype(np.int64)
    share = np.clip(places - before, 0.0, 1.0)
    share[share < 1e-6] = 0.0
    one, two = (_take_rows(values, own, number) for number in (before, before + (share > 0.0)))
    weight = share.reshape(-1, *(1,) * (values.ndim - 1))
    return np.asarray((1.0 - weight) * one + weight * two)


def _take_rows(values: Floats, own: NDArray[np.int64], wanted: NDArray[np.int64]) -> Floats:
    rows = np.minimum(np.searchsorted(own, wanted), len(own) - 1)
    found = values[rows]
    found[own[rows] != wanted] = np.nan
    return found


def format_error(where: object, expected: str, found: str) -> InputError:
    """Return the error about one place of a method's file."""
    todo = "Give the file that the method's own code wrote, or name another method."
    return InputError(str(where), expected, found, todo)


def read_pickled(path: Path) -> Part:
    """Return the content of a file: dictionaries, lists, numbers, text and arrays.

    `worldpose.pickles` reads pickles, also of joblib, numpy and torch, and runs nothing in them.
    """
    try:
        content = read_pickle(path)
        if not isinstance(content, dict | list | np.ndarray):
            raise ValueError(f"a {type(content).__name__}")
        return Part(str(path), content)
    except (OSError, ValueError) as error:
        such = " as such" if isinstance(error, ValueError) else ""
        expected = "results of a method: arrays in a pickle, joblib, numpy or torch file"
        found = f"a file that cannot be read{such} ({error})"
        todo = "Give the file that the method's own code wrote. Nothing in this file was run."
        raise InputError(str(path), expected, found, todo) from error


@dataclass(frozen=True)
class Part:
    """A value in a method's file, with its place, which errors name for a value of another form."""

    where: str
    value: Any

    def __getitem__(self, key: str) -> Part:
        """Return the value of a key; the error names the keys that there are."""
        if not isinstance(self.value, Mapping) or key not in self.value:
            known = isinstance(self.value, Mapping) and ", ".join(map(str, [*self.value][:8]))
            raise format_error(self.where, key, known or f"a {type(self.value).__name__}")
        return Part(f"{self.where}: {key}", self.value[key])

    def by_person(self) -> Iterator[tuple[int, Part]]:
        """Yield id and value of each person in a dictionary by person."""
        if not isinstance(self.value, Mapping):
            found = f"a {type(self.value).__name__}"
            raise format_error(self.where, "a dictionary by person", found)
        for name, value in self.value.items():
            where = f"{self.where}: person {name}"
            yield Part(where, name).integer(), Part(where, value)

    def as_floats(self) -> Floats:
        """Return numbers as an array of any shape."""
        try:
            return np.asarray(self.value, dtype=np.float64)
        except (TypeError, ValueError, OverflowError):
            raise format_error(self.where, "numbers", f"a {type(self.value).__name__}") from None

    def floats(self, *shape: int | None) -> Floats:
        """Return numbers of a shape, None for any length; extra dimensions of 1 are dropped."""
        array = self.as_floats()
        while array.ndim > len(shape) and 1 in array.shape:
            # The first extra dimension that the shape lacks.
            ones = [i for i, n in enumerate(array.shape) if n == 1]
            fitting = (i for i in ones if _fits(np.delete(array.shape, i), shape))
            array = array.squeeze(next(fitting, ones[0]))
        if not _fits(array.shape, shape):
            wanted = ", ".join("any" if n is None else str(n) for n in shape)
            raise format_error(self.where, f"numbers of shape ({wanted})", f"{array.shape}")
        return array

    def integers(self, count: int | None = None) -> NDArray[np.int64]:
        """Return integers (count,)."""
        array = self.floats(count)
        if not np.array_equal(array, np.round(array)):
            raise format_error(self.where, "whole numbers", f"{array[:4]}")
        return array.astype(np.int64)

    def integer(self) -> int:
        """Return one integer, also if written as text."""
        found = self.floats()
        if not np.isfinite(found) or found != np.round(found) or abs(found) > 2**53:
            raise format_error(self.where, "a whole number", f"{self.value}")
        return int(found)

    def frames(self) -> NDArray[np.int64]:
        """Return frames, which ascend from 0 or more."""
        frames = self.integers()
        if np.any(np.diff(frames) <= 0) or np.any(frames < 0):
            raise format_error(self.where, "frames that rise from 0", f"{frames[:8]}")
        return frames


def _fits(found: object, shape: tuple[int | None, ...]) -> bool:
    lengths = np.asarray(found).tolist()
    return len(lengths) == len(shape) and all(
        map(lambda n, want: want in (None, n), lengths, shape)
    )
