"""Interactive 3D view of a clip in an HTML page: people, markings, cameras."""

from __future__ import annotations

import base64
import json
import math
from collections.abc import Mapping
from dataclasses import dataclass
from html import escape
from typing import Final

import numpy as np
from numpy.typing import NDArray

from data_contracts.conventions import COCO17_BONES
from data_contracts.pitch import PitchSpec
from worldpose.formats.joints_file import JointTracks
from worldpose.geometry import Camera

UNIT: Final = 0.005
"""Resolution of joint coordinates [m]: 164 m to either side fit into 16 bits."""
MISSING: Final = -32768
RATE: Final = 25.0
"""Maximum frames per second [1/s]; the browser interpolates."""
NUMBERS: Final = 1_500_000
"""Maximum coordinates per clip: 4 MB of text, or 58 s of 20 people."""


@dataclass(frozen=True, eq=False)
class Scene:
    """Content of the 3D view of one clip.

    Attributes:
        caption: names the clip.
        tracks: all people.
        fps: frames per second [1/s].
        cameras: single static cameras by id.
        broadcast: a batch, one per frame of `tracks`; None without a broadcast camera.
        pitch: draw its markings; None without a pitch.
    """

    caption: str
    tracks: JointTracks
    fps: float
    cameras: Mapping[str, Camera]
    broadcast: Camera | None = None
    pitch: PitchSpec | None = None


def scene_html(scene: Scene) -> str:
    """Return the HTML of a scene for the page's script."""
    data = json.dumps(_content(scene), separators=(",", ":"), allow_nan=False)
    # Only this text could end the enclosing element.
    data = data.replace("</", "<\\/")
    buttons = "".join(
        f'<button type="button" data-do="{name}">{label}</button>'
        for name, label in (
            ("play", "Play"),
            ("home", "Perspective"),
            ("above", "From above"),
            ("side", "From the side"),
            ("through", "Broadcast camera"),
        )
    )
    caption = escape(scene.caption)
    return (
        f'<div class="scene"><canvas tabindex="0" role="img" aria-label="{caption}"></canvas>'
        f'<div class="bar">{buttons}<input type="range" min="0" value="0" step="any" '
        'aria-label="Time"><output></output></div>'
        f'<script type="application/json">{data}</script></div>'
    )


def _content(scene: Scene) -> dict[str, object]:
    from worldpose.reports.drawing import HIPS, markings, person_color

    joints = scene.tracks.joints
    every = max(round(scene.fps / RATE), math.ceil(joints.size / NUMBERS), 1)
    shown = joints[::every]
    hips = shown[:, :, HIPS].mean(2)
    there = hips[np.isfinite(hips).all(-1)]
    there = there if len(there) else np.zeros((1, 3))
    low, high = np.percentile(there[:, :2], [2, 98], axis=0)
    middle = 0.5 * (low + high)
    return {
        "first": int(scene.tracks.frames[0]) if len(scene.tracks.frames) else 0,
        "every": every,
        "fps": scene.fps,
        "frames": len(shown),
        "persons": shown.shape[1],
        "ids": [str(person) for person in scene.tracks.person_ids],
        "colors": [person_color(int(person)) for person in scene.tracks.person_ids],
        "bones": [list(bone) for bone in COCO17_BONES],
        "unit": UNIT,
        "joints": _text(_whole(shown)),
        "middle": [*_rounded(middle), 0.8],
        "reach": round(max(9.0, 0.75 * float(np.linalg.norm(high - low))), 1),
        "markings": []
        if scene.pitch is None
        else [_rounded(line) for line in markings(scene.pitch)],
        "grid": [] if scene.pitch is not None else _grid(middle),
        "cameras": [
            {"name": name, "center": _rounded(camera.center)}
            for name, camera in scene.cameras.items()
        ],
        "broadcast": None if scene.broadcast is None else _text(_moving(scene.broadcast, every)),
    }


def _whole(joints: NDArray[np.float64]) -> NDArray[np.int16]:
    """Return joints in integer units; `MISSING` for missing or too distant joints."""
    known = np.isfinite(joints) & (np.abs(joints) < -MISSING * UNIT - 1.0)
    scaled = np.where(known, joints, 0.0) / UNIT
    whole = np.where(known.all(-1, keepdims=True), np.round(scaled), MISSING)
    return whole.astype("<i2")


def _moving(camera: Camera, every: int) -> NDArray[np.float32]:
    """Return rotation, translation, focal length, width and height of every shown frame."""
    pose = camera.cam_from_world
    count = len(pose.translation)
    size = np.broadcast_to(camera.image_size, (count, 2))
    rows = np.concatenate(
        [pose.rotation.reshape(count, 9), pose.translation, camera.focal[:, :1], size], axis=1
    )
    return rows[::every].astype("<f4")


def _grid(middle: NDArray[np.float64]) -> list[list[list[float]]]:
    """Return a ground grid of 1 m spacing, for scenes without markings."""
    around = np.round(middle)
    lines = []
    for step in np.arange(-8.0, 9.0):
        for axis in (0, 1):
            ends = np.zeros((2, 3))
            ends[:, axis] = around[axis] + step
            ends[:, 1 - axis] = around[1 - axis] + np.array([-8.0, 8.0])
            lines.append(_rounded(ends))
    return lines


def _text(numbers: NDArray[np.generic]) -> str:
    return base64.b64encode(np.ascontiguousarray(numbers).tobytes()).decode("ascii")


def _rounded(values: NDArray[np.float64]) -> list:  # type: ignore[type-arg]
    return np.round(values, 2).tolist()  # type: ignore[no-any-return]
