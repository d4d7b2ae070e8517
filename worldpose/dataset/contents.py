"""Content of a data set's files, unvalidated: 3D points, cameras and 2D points per clip."""

from __future__ import annotations

import json
import math
from collections.abc import Callable, Collection, Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from data_contracts.arrays import Flags, Floats, Integers
from data_contracts.conventions import COCO17
from data_contracts.release import Finding, ReleaseManifest
from worldpose.body.keypoints import BODY25, CHALLENGE15, fold_keypoints
from worldpose.body.model import BodyModel, BodyParameters
from worldpose.errors import InputError, say_failure
from worldpose.formats.archives import wrong
from worldpose.formats.challenge import (
    ChallengeClip,
    read_challenge,
    read_submission,
    submission_clips,
)
from worldpose.formats.joints_file import read_joints, read_poses
from worldpose.formats.release_cameras import CameraRows, read_camera_rows
from worldpose.geometry.rigid import Rigid


@dataclass(frozen=True, eq=False)
class PointSource:
    """3D points of one file."""

    name: str
    """The file, relative to the data set."""
    skeleton: tuple[str, ...]
    """Names of the points."""
    points: Floats
    """(frames, persons, points, 3) [m], world."""
    place: Floats | None = None
    """(frames, persons, 3), `transl` of poses; None if the file has points instead of poses."""
    pivot: Floats | None = None
    """(frames, persons, 3) [m], difference between rotation about the origin and about the
    pelvis."""
    in_degrees: Floats | None = None
    """The points if the file's angles were degrees; None if they cannot be."""
    frames: Integers | None = None
    """(frames,) match frames, ascending; None if the file numbers none."""
    views: NDArray[np.integer] | None = None
    """(frames, persons, points), as in `JointTracks`; None if unknown."""

    def with_points(self, points: Floats) -> PointSource:
        """Return the same source with other points."""
        return PointSource(self.name, self.skeleton, points)

    def point(self, name: str) -> Floats:
        """Return one point of all people (frames, persons, 3) [m], world."""
        return self.points[:, :, self.skeleton.index(name)]


@dataclass(frozen=True, eq=False)
class CameraView:
    """One camera and its 2D points of people."""

    name: str
    rows: CameraRows
    pixels: Floats | None = None
    """(frames, persons, points, 2) [px]; None if the data set has no 2D."""
    skeleton: tuple[str, ...] = ()

    @property
    def is_moving(self) -> bool:
        """Whether the camera has a row per frame."""
        return len(self.rows.rotation) > 1

    def shared_points(self, source: PointSource) -> tuple[Floats, Integers] | None:
        """Return the 2D of points that a source has too, and their indices in it; or None."""
        if self.pixels is None or self.pixels.shape[1] != source.points.shape[1]:
            return None
        shared = [name for name in self.skeleton if name in source.skeleton]
        pixels = self.pixels[:, :, [self.skeleton.index(name) for name in shared]]
        return pixels, np.array([source.skeleton.index(name) for name in shared], dtype=np.int64)


def sample_evenly(count: int, most: int) -> Integers:
    """Return at most so many of the indices from 0 to `count` - 1, evenly spread."""
    return np.linspace(0, count - 1, max(0, min(count, most))).round().astype(np.int64)


@dataclass(frozen=True, eq=False)
class ShippedClip:
    """All data of one clip."""

    name: str
    fps: float
    sources: tuple[PointSource, ...]
    views: tuple[CameraView, ...]
    pitch: bool = True
    """Whether the ground is z = 0; otherwise the world frame is that of the camera calibration."""
    findings: tuple[Finding, ...] = field(default=())
    """Findings of the reader."""
    given: ChallengeClip | None = None
    """Boxes and skeletons of the challenge's layout."""
    notes: tuple[str, ...] = ()
    """What could not be compared."""


def convention(fault: str, says: str, *where: str, **figures: float) -> Finding:
    """Return the finding of a broken convention."""
    return Finding(fault=fault, kind="convention", where=where, says=says, figures=figures)


def implausible(fault: str, says: str, *where: str, **figures: float) -> Finding:
    """Return the finding of implausible data."""
    return Finding(fault=fault, kind="plausibility", where=where, says=says, figures=figures)


def absent_rows(name: str, arrays: Mapping[str, NDArray[Any]]) -> tuple[Floats, list[Finding]]:
    """Return a mask (rows, columns) of missing persons and frames of a file, and findings on it.

    The arrays (rows, columns, ...) of a file must be missing together. A row is missing if it is so
    in any array, or zero in all.
    """
    flat = {
        key: array.reshape(*array.shape[:2], math.prod(array.shape[2:]))
        for key, array in arrays.items()
    }
    partly = {key: np.isnan(array).any(-1) for key, array in flat.items()}
    missing = np.any(list(partly.values()), axis=0)
    findings = []
    if (uneven := missing & ~np.all(list(partly.values()), axis=0)).any():
        findings.append(
            Finding(
                fault="missing_values_disagree",
                kind="damage",
                where=(name,),
                says=f"{', '.join(flat)} are not missing (NaN) in the same frames",
                figures={"share_of_rows": float(uneven.mean())},
            )
        )
    zeros = np.all([(array == 0.0).all(-1) for array in flat.values()], axis=0)
    if zeros.any():
        said = (
            f"{', '.join(flat)} are exactly zero where a person is missing; missing values are NaN"
        )
        share = float(zeros.mean())
        findings.append(convention("zeros_for_missing", said, name, share_of_rows=share))
    gone: Floats = missing | zeros
    return gone, findings


SUBMISSIONS = ("submission.zip", "submission.npz")


def list_clips(folder: Path) -> tuple[str, ...]:
    """Return the names of a data set's clips; InputError without poses, joints and submission."""
    names = {path.stem for path in (folder / "poses").glob("*.npz")}
    names |= {path.name.removesuffix(".joints.npz") for path in folder.glob("*.joints.npz")}
    for name in SUBMISSIONS:
        if (folder / name).is_file():
            names |= set(submission_clips(folder / name))
    # Name of the one clip of a data set without clip names.
    only_clip = "clip"
    if not names and (folder / "joints.npz").is_file():
        names = {only_clip}
    if not names:
        parts = sorted({str(path.parents[1]) for path in folder.glob("*/poses/*.npz")})
        raise InputError(
            str(folder),
            expected="an exported data set: poses/<clip>.npz, joints.npz, <clip>.joints.npz or "
            "submission.zip",
            found=", ".join(sorted(path.name for path in folder.iterdir())[:8])
            if folder.is_dir()
            else "no such folder",
            todo=f"Give a part of this data set: {', '.join(parts)}."
            if parts
            else "Give the folder that worldpose export wrote, or one of the same layout.",
        )
    return tuple(sorted(names))


def read_clip(
    folder: Path,
    clip: str,
    clips: tuple[str, ...],
    body: Callable[[str | None], BodyModel],
    manifest: ReleaseManifest | None,
    fps: float,
    pitch: bool = True,
) -> ShippedClip:
    """Read all data of one of the `clips` of a data set; other cameras are static.

    `body` returns the body model for a name, or for a file without one; `pitch` says whether the
    ground is z = 0.
    """
    sources, findings, ids = _sources(folder, clip, clips, body)
    if manifest is not None and clip in manifest.clips:
        ids = manifest.clips[clip].person_ids
    own, static = camera_files(folder, clip, clips)
    rows = {path.stem: read_camera_rows(path) for path in sorted((*own, *static))}
    rig = sorted((folder / "cameras" / clip).glob("*.npz"))
    rows |= {f"{clip}/{path.stem}": read_camera_rows(path) for path in rig}
    frames = max((len(source.points) for source in sources), default=0)
    coco = folder if len(clips) == 1 else folder / clip
    views, notes = list[CameraView](), list[str]()
    for name, camera in rows.items():
        file, pixels = coco / f"{name}.json", None
        if file.is_file():
            shown: Flags = np.ones(frames, np.bool_)
            if len(camera.rotation) == frames:
                shown = np.asarray(np.isfinite(camera.rotation).all((-1, -2)))
            pixels = read_coco(file, ids, shown)
            if pixels is None:
                notes.append(f"{file}: not compared: it has other images than the clip has frames")
        views.append(CameraView(name, camera, pixels, COCO17))
    given = None
    if (folder / "boxes.npz").is_file() or any((folder / "boxes").glob("*.npy")):
        given = read_challenge(folder, clip).get(clip)
        if given is not None:
            arrays = {"boxes": given.boxes, "skel_2d": given.skel_2d, "skel_3d": given.skel_3d}
            gone, more = absent_rows(f"boxes and skeletons of {clip}", arrays)
            findings += more
            pixels = np.where(gone[..., None, None], np.nan, given.skel_2d)
            skeleton = BODY25 if pixels.shape[2] == len(BODY25) else CHALLENGE15
            views = [
                CameraView(view.name, view.rows, pixels, skeleton) if view.name == clip else view
                for view in views
            ]
            sources, swapped = _rows_of_boxes(sources, clip, pixels.shape[:2])
            findings += swapped
    return ShippedClip(
        clip, fps, tuple(sources), tuple(views), pitch, tuple(findings), given, tuple(notes)
    )


def camera_files(folder: Path, clip: str, clips: Collection[str]) -> tuple[list[Path], list[Path]]:
    """Return the camera files of one clip, `<clip>` or `<clip>.<camera>`, and those of no clip."""
    found: dict[str, list[Path]] = {}
    for path in sorted((folder / "cameras").glob("*.npz")):
        owners = (each for each in clips if path.stem == each or path.stem.startswith(f"{each}."))
        found.setdefault(max(owners, key=len, default=""), []).append(path)
    return found.get(clip, []), found.get("", [])


def read_coco(path: Path, ids: tuple[int, ...], shown: Flags) -> Floats | None:
    """Read 2D points (frames, persons, 17, 2) [px] of a COCO file; NaN if v is 0.

    The images are those of the frames with a camera, `shown` (frames,), in order; None if there are
    fewer or more, as of a camera of another rate. People who are not in `ids` are left out.
    """
    pixels = np.full((len(shown), len(ids), len(COCO17), 2), np.nan)
    person_of = {person: place for place, person in enumerate(ids)}
    try:
        dataset: Mapping[str, Any] = json.loads(path.read_bytes())
        numbers = sorted(int(image["id"]) for image in dataset["images"])
        places = np.flatnonzero(shown).tolist()
        if len(numbers) != len(places):
            return None
        frame_of = dict(zip(numbers, places, strict=True))
        for row in dataset["annotations"]:
            frame, person = frame_of[row["image_id"]], person_of.get(row["track_id"])
            if person is None:
                continue
            points = np.array(row["keypoints"], dtype=np.float64).reshape(len(COCO17), 3)
            pixels[frame, person] = np.where(points[:, 2:] > 0, points[:, :2], np.nan)
    except (ValueError, KeyError, TypeError, OverflowError, RecursionError) as error:
        raise wrong(str(path), "COCO keypoints with track_id", say_failure(error)) from error
    return pixels


def _sources(
    folder: Path, clip: str, clips: tuple[str, ...], body: Callable[[str | None], BodyModel]
) -> tuple[list[PointSource], list[Finding], tuple[int, ...]]:
    """Return the 3D points of every file of one clip, the reader's findings, and person ids."""
    sources: list[PointSource] = []
    findings: list[Finding] = []
    ids: tuple[int, ...] = ()
    poses = folder / "poses" / f"{clip}.npz"
    if poses.is_file():
        source, more = _read_poses(poses, f"poses/{clip}.npz", body)
        sources.append(source)
        findings += more
        ids = tuple(range(source.points.shape[1]))
    for name in (f"{clip}.joints.npz", *(["joints.npz"] if len(clips) == 1 else [])):
        if (folder / name).is_file():
            tracks = read_joints(folder / name)
            gone, more = absent_rows(name, {"joints": tracks.joints.swapaxes(0, 1)})
            findings += [each for each in more if each.fault == "zeros_for_missing"]
            zeros = (tracks.joints == 0.0).all((-1, -2))
            joints = np.where(zeros[..., None, None], np.nan, tracks.joints)
            source = PointSource(name, COCO17, joints, frames=tracks.frames, views=tracks.views)
            sources.append(source)
            ids = tuple(tracks.person_ids.tolist())
    for name in SUBMISSIONS:
        if (folder / name).is_file() and clip in (found := read_submission(folder / name, (clip,))):
            gone, more = absent_rows(f"{name}: {clip}", {"joints": found[clip]})
            findings += [each for each in more if each.fault == "zeros_for_missing"]
            joints = np.where(gone[..., None, None], np.nan, found[clip]).swapaxes(0, 1)
            sources.append(PointSource(f"{name}: {clip}", CHALLENGE15, joints))
    return sources, findings, ids


def _read_poses(
    path: Path, name: str, body: Callable[[str | None], BodyModel]
) -> tuple[PointSource, list[Finding]]:
    """Return the points of a pose file's bodies, and their values under other conventions."""
    poses, model_name = read_poses(path)
    model = body(model_name)
    if poses.betas.shape[-1] != model.shapes:
        todo = "Name the body model that the betas belong to."
        expected, found = f"{model.shapes} betas of {model.name}", f"{poses.betas.shape[-1]}"
        raise wrong(f"{path}: betas", expected, found, todo)
    gone, findings = absent_rows(
        name,
        {
            "transl": poses.transl,
            "global_orient": poses.global_orient,
            "body_pose": poses.body_pose,
        },
    )
    place = np.where(gone[..., None], np.nan, poses.transl)
    poses = BodyParameters(poses.betas, poses.global_orient, poses.body_pose, place)
    pelvis = model.joint_template[0] + poses.betas @ model.joint_directions[0].T
    turned = (Rigid.from_rotvec(poses.global_orient, np.zeros(3)).rotation @ pelvis[..., None])[
        ..., 0
    ]
    in_degrees = None
    # An angle far beyond a full turn is not a plausible axis-angle value.
    angles = np.concatenate([poses.global_orient, poses.body_pose], axis=-1)
    if np.nanmax(np.abs(angles), initial=0.0) > 7.0:
        converted = BodyParameters(
            poses.betas, np.radians(poses.global_orient), np.radians(poses.body_pose), place
        )
        in_degrees = _points(model, converted)
    source = PointSource(
        name,
        BODY25,
        _points(model, poses),
        place.swapaxes(0, 1),
        np.asarray(turned - pelvis).swapaxes(0, 1),
        in_degrees,
    )
    return source, findings


def _points(model: BodyModel, poses: BodyParameters) -> Floats:
    """Return BODY25 (frames, persons, 25, 3) [m] of bodies (persons, frames), in bounded memory."""
    keypoints = fold_keypoints(model, BODY25)
    persons, frames = poses.batch_shape
    points = np.empty((frames, persons, len(BODY25), 3))
    # Maximum number of frames, with all people, posed per chunk.
    max_frames = 200
    for start in range(0, frames, max_frames):
        part = slice(start, min(start + max_frames, frames))
        points[part] = keypoints(poses[:, part]).swapaxes(0, 1)
    return points


def _rows_of_boxes(
    sources: list[PointSource], clip: str, shape: tuple[int, ...]
) -> tuple[list[PointSource], list[Finding]]:
    """Return sources with the boxes' frames and persons, and findings on swapped dimensions."""
    kept, findings = [], []
    for source in sources:
        if source.points.shape[:2] == shape[::-1] and shape[0] != shape[1]:
            said = "the first dimension is the frames; a submission has persons first"
            findings.append(convention("frames_before_persons", said, source.name))
            source = source.with_points(source.points.swapaxes(0, 1))
        kept.append(source)
    return kept, findings
