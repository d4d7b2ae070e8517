"""Inputs of baseline methods: tracked boxes and true cameras (E6)."""

from __future__ import annotations

from pathlib import Path
from typing import Final

import numpy as np
from numpy.typing import NDArray

from data_contracts.release import BaselineSettings
from worldpose.errors import InputError
from worldpose.formats.archives import write_archive
from worldpose.formats.files import whole_file
from worldpose.geometry import Camera

Y_DOWN: Final = np.array([[1.0, 0.0, 0.0], [0.0, 0.0, -1.0], [0.0, 1.0, 0.0]])
"""Rotation of world points to axes with y down, the ground orientation of SLAHMR."""


def write_tracks(path: Path, boxes: NDArray[np.float64], ids: NDArray[np.int64]) -> None:
    """Write boxes as a MOTChallenge text, whole or not at all.

    One line for each person and image: image from 1, id, left, top, width, height [px] and
    confidence 1, then three times -1. In that format, (1, 1) is the top-left corner of the top-left
    pixel.

    Args:
        path: the file.
        boxes: (frames, persons, 4) x0 y0 x1 y1 [px]; NaN if a person is not in the image.
        ids: (persons,), renumbered from 1.
    """
    frames, people = np.nonzero(np.isfinite(boxes).all(-1))
    found = boxes[frames, people]
    # (0, 0) is the centre of a pixel here, (1, 1) its upper left corner there.
    corners = np.concatenate([found[:, :2] + 1.5, found[:, 2:] - found[:, :2]], axis=1)
    lines = [
        f"{frame + 1},{ids[person] + 1},{x:.2f},{y:.2f},{w:.2f},{h:.2f},1,-1,-1,-1"
        for frame, person, (x, y, w, h) in zip(frames, people, corners.tolist(), strict=True)
    ]
    with whole_file(path) as draft:
        draft.write_text("".join(f"{line}\n" for line in lines), encoding="ascii")


def write_slahmr_cameras(path: Path, camera: Camera) -> None:
    """Write `cameras.npz` as SLAHMR reads it, for its variant with true cameras (E5).

    Members: `height`, `width`, `focal` [px], `intrins` (frames, 4) fx fy cx cy [px] and `w2c`
    (frames, 4, 4), in world axes with y down: x as in the world, z along the world's y. The method
    has no distortion model.

    Args:
        path: the file.
        camera: (frames,).

    Raises:
        InputError: a frame has no camera.

    Note:
        Layout as read by vye16/slahmr at commit 58518fe, slahmr/data/dataset.py
        (`load_cameras_npz`).
    """
    missing = np.flatnonzero(np.isnan(camera.numbers).any(-1))
    if len(missing):
        raise InputError(
            str(path),
            expected="a camera in every frame: the method knows no gaps",
            found=f"none in {len(missing)} of {len(camera.focal)}, the first {missing[0]}",
            todo="Calibrate the camera there, or shorten the clip.",
        )
    pose = camera.cam_from_world
    transforms = np.tile(np.eye(4), (len(camera.focal), 1, 1))
    transforms[:, :3, :3] = pose.rotation @ Y_DOWN.T
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


def write_baseline_settings(path: Path, settings: BaselineSettings) -> None:
    """Write the settings for running the methods, as JSON."""
    with whole_file(path) as draft:
        draft.write_text(settings.model_dump_json(indent=2) + "\n", encoding="utf-8")
