"""Statistics of a data set: clips, frames, poses, distances."""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from pathlib import Path
from typing import Literal

import numpy as np

from data_contracts.arrays import Floats
from data_contracts.conventions import COCO17
from data_contracts.release import ClipStatistics, DataSetStatistics
from worldpose.errors import InputError
from worldpose.formats.challenge import read_submission
from worldpose.formats.joints_file import read_joints, read_poses
from worldpose.formats.release_cameras import read_camera_rows

CameraKind = Literal["S", "M", "M+Z"]


def read_places(folder: Path, clip: str) -> Floats:
    """Return people's positions in a clip (frames, persons, 3) [m]; NaN where one is missing.

    They are the pelvis of poses, up to an offset per person, or the mid-hip. InputError without
    any.
    """
    poses = folder / "poses" / f"{clip}.npz"
    if poses.is_file():
        found, _ = read_poses(poses)
        angles = np.concatenate([found.global_orient, found.body_pose], axis=-1)
        gone = np.isnan(angles).any(-1, keepdims=True)
        return np.where(gone, np.nan, found.transl).swapaxes(0, 1)
    for name in (f"{clip}.joints.npz", "joints.npz"):
        if (folder / name).is_file():
            hips = [COCO17.index("left_hip"), COCO17.index("right_hip")]
            return np.asarray(read_joints(folder / name).joints[:, :, hips].mean(2))
    for name in ("submission.zip", "submission.npz"):
        if (folder / name).is_file():
            # Joints 7 and 8 of the challenge's 15 are the hips.
            joints = read_submission(folder / name, (clip,))[clip]
            return np.asarray(joints[:, :, 7:9].mean(2)).swapaxes(0, 1)
    raise InputError(
        f"{folder}: {clip}",
        expected="poses, joints or a submission",
        found="none",
        todo="Give the folder that worldpose export wrote.",
    )


def clip_statistics(places: Floats, fps: float, camera: CameraKind | None = None) -> ClipStatistics:
    """Return the statistics of one clip.

    A person's distance is the path length over the ground, from frame to frame; gaps add nothing.
    Places are (frames, persons, 3) [m], world; NaN where a person is missing.
    """
    there = np.asarray(np.isfinite(places).all(-1))
    steps = np.linalg.norm(np.diff(places[..., :2], axis=0), axis=-1)
    ways = np.where(there[1:] & there[:-1], steps, 0.0).sum(0)
    return ClipStatistics(
        frames=len(places),
        seconds=len(places) / fps,
        persons=int(there.any(0).sum()),
        poses=int(there.sum()),
        trajectories_m=tuple(ways[there.any(0)].tolist()),
        camera=camera,
    )


def data_set_statistics(
    clips: Mapping[str, ClipStatistics], subjects: int | None = None
) -> DataSetStatistics:
    """Return the statistics of all clips together; `subjects` is the number of different people."""
    frames = sum(clip.frames for clip in clips.values())
    poses = sum(clip.poses for clip in clips.values())
    ways = [way for clip in clips.values() for way in clip.trajectories_m]
    # Duration of a pose: the time until the next one.
    seconds = sum(clip.poses * clip.seconds / clip.frames for clip in clips.values() if clip.frames)
    return DataSetStatistics(
        clips=dict(clips),
        frames=frames,
        minutes=sum(clip.seconds for clip in clips.values()) / 60.0,
        poses=poses,
        subjects=subjects,
        distance_km=sum(ways) / 1000.0,
        subjects_per_frame=poses / frames if frames else None,
        speed_m_s=sum(ways) / seconds if seconds else None,
        longest_trajectory_m=max(ways, default=None),
        camera=most_moving(clip.camera for clip in clips.values()),
    )


def most_moving(kinds: Iterable[CameraKind | None]) -> CameraKind | None:
    """Return the kind of the camera that moves most; None if none is known."""
    # Static, moving, or moving and zooming cameras, as in the paper's table.
    kinds_of_camera = ("S", "M", "M+Z")
    return max((kind for kind in kinds if kind), key=kinds_of_camera.index, default=None)


def camera_kind(path: Path) -> CameraKind | None:
    """Return the kind of a file's camera; None if it is unknown."""
    rows = read_camera_rows(path)
    if len(rows.rotation) == 1 and np.isfinite(rows.rotation).all():  # one row holds throughout
        return "S"
    return kind_of(rows.intrinsics[:, (0, 1), (0, 1)].mean(-1), rows.rotation)


def kind_of(focal: Floats, rotation: Floats) -> CameraKind | None:
    """Return the kind of a camera from focal lengths (frames,) [px]; None if it is unknown.

    Rotations are (frames, 3, 3), or (1, 3, 3) if only the first one is known.
    """
    zoom = 1e-2  # maximum relative change of focal length without zoom
    known = np.isfinite(focal)
    if known.any() and np.ptp(focal[known]) > zoom * focal[known].mean():
        return "M+Z"
    turns = rotation[np.isfinite(rotation).all((-1, -2))]
    if len(turns) < 2:
        return None
    # The angle of R1^T R2 is below a when the trace is above 1 + 2 cos a.
    traces = np.einsum("fab,ab->f", turns, turns[0])
    # Maximum rotation of a static camera [rad]: a pixel in a broadcast image.
    max_turn_rad = 1e-3
    return "M" if (traces < 1.0 + 2.0 * np.cos(max_turn_rad)).any() else "S"
