"""Data of a clip's 3D view: what stays the same, and people in ranges of frames, as small binaries.

A binary has a length (uint32), a JSON header of that length, and arrays; the header's `arrays` says
type, shape and place of each. `infra/review_pages/src/scene3d.js` reads it.
"""

from __future__ import annotations

import json
import struct
from collections.abc import Mapping
from typing import Any, Final

import numpy as np
from numpy.typing import NDArray

from data_contracts.conventions import COCO17_BONES
from flows.reports.clip_video import RATE, clip_view, video_frames
from flows.results.best_results import (
    body_tracks,
    broadcast_cameras,
    clip_positions,
    estimated_pitch,
    joint_tracks,
    static_cameras,
)
from flows.stage import Match
from worldpose.body import OPEN_BODY, BodyModel
from worldpose.geometry import Camera
from worldpose.reports.bodies import BodyTracks
from worldpose.reports.drawing import markings, person_color
from worldpose.store import Run

ANGLE_UNIT: Final = 2e-4
"""Resolution of rotation vectors [rad]: 6.5 rad to either side fit into 16 bits."""
JOINT_UNIT: Final = 2.5e-3
"""Resolution of joint coordinates [m]: 82 m to either side fit into 16 bits."""
SURFACE_UNIT: Final = 1e-4
"""Resolution of the body's surface [m]."""
MISSING: Final = -32768
RANGE_SECONDS: Final = 30.0
"""Maximum length of a range of frames [s]."""
INFLUENCES: Final = 4
"""Joints that move one vertex."""

Arrays = dict[str, NDArray[np.generic]]


def pack(header: Mapping[str, Any], arrays: Mapping[str, NDArray[np.generic]]) -> bytes:
    """Return a header and arrays as one binary; arrays begin at multiples of four bytes."""
    places, blobs, size = {}, [], 0
    for name, array in arrays.items():
        data = np.ascontiguousarray(array).tobytes()
        kind = array.dtype.newbyteorder("<").str.lstrip("<|")
        places[name] = {"type": kind, "shape": list(array.shape), "at": size}
        blobs.append(data + bytes(-len(data) % 4))
        size += len(blobs[-1])
    text = json.dumps({**header, "arrays": places}, separators=(",", ":"), allow_nan=False).encode()
    text += b" " * (-len(text) % 4)
    return struct.pack("<I", len(text)) + text + b"".join(blobs)


def describe_scene(run: Run, match: Match, clip: str) -> bytes:
    """Return what stays the same in a clip's 3D view: people, bodies, cameras, pitch, video.

    Bodies of an installed model get no surface: the view draws capsules from their joints.
    """
    tracks, bodies = joint_tracks(run, clip), body_tracks(run, clip)
    frames, every = tracks.frames, _step(match)
    positions = clip_positions(run, clip)
    names = dict(zip(positions.person.tolist(), positions.names, strict=True))
    fitted = [] if bodies is None else bodies.person_ids.tolist()
    arrays: Arrays = {} if bodies is None else _body_arrays(bodies)
    pitch = estimated_pitch(run, match.folder.pitch, match.folder.spec, clip)
    lines = [] if pitch is None else markings(pitch)
    header = {
        "clip": clip,
        "run": run.record.run_id,
        "fps": match.folder.spec.fps,
        "first": int(frames[0]) if len(frames) else 0,
        "every": every,
        "frames": len(frames[::every]),
        "range_frames": max(1, round(RANGE_SECONDS * match.folder.spec.fps / every)),
        "people": [
            {
                "id": person,
                "name": names.get(person, ""),
                "color": person_color(person),
                "body": fitted.index(person) if person in fitted else None,
            }
            for person in tracks.person_ids.tolist()
        ],
        "units": {"angle": ANGLE_UNIT, "joint": JOINT_UNIT, "surface": SURFACE_UNIT},
        "bones": [list(bone) for bone in COCO17_BONES],
        "markings": [(np.round(line, 2) + 0.0).tolist() for line in lines],
        "cameras": _static_cameras(run, match),
        "broadcast": clip if clip in broadcast_cameras(run) else None,
        "video": _video(run, match, clip),
    }
    return pack(header, arrays)


def describe_frames(run: Run, match: Match, clip: str, first: int, count: int) -> bytes:
    """Return people and the broadcast camera in a range of the view's frames.

    Args:
        run: the run.
        match: the match.
        clip: id of the clip.
        first: index of the first frame, counted in the view's frames.
        count: number of frames; a range is at most `RANGE_SECONDS` long.
    """
    every = _step(match)
    longest = max(1, round(RANGE_SECONDS * match.folder.spec.fps / every))
    tracks, bodies = joint_tracks(run, clip), body_tracks(run, clip)
    shown = tracks.frames[::every][first : first + min(count, longest)]
    joints = tracks.joints[np.searchsorted(tracks.frames, shown)]
    arrays: Arrays = {}
    if bodies is not None:
        rows = np.searchsorted(bodies.frames, shown).clip(max=max(0, len(bodies.frames) - 1))
        is_there = np.equal(bodies.frames[rows], shown)
        angles = np.concatenate([bodies.poses.global_orient, bodies.poses.body_pose], axis=-1)[rows]
        place = np.where(is_there[:, None, None], bodies.poses.transl[rows], np.nan)
        pose = angles.reshape(*angles.shape[:2], -1, 3)
        arrays["pose"] = _whole(pose, ANGLE_UNIT)
        arrays["place"] = place.astype("<f4")
        columns = np.searchsorted(bodies.person_ids, tracks.person_ids)
        columns = columns.clip(max=max(0, len(bodies.person_ids) - 1))
        has_body = bodies.person_ids[columns] == tracks.person_ids
        is_drawn = has_body & np.all(np.isfinite(place), axis=-1)[:, columns]
        joints = np.where(is_drawn[..., None, None], np.nan, joints)  # the body says more
    loose = np.flatnonzero(np.any(np.all(np.isfinite(joints), axis=-1), axis=(0, 2)))
    if len(loose):
        arrays["joints"] = _whole(joints[:, loose], JOINT_UNIT)
    moving = broadcast_cameras(run).get(clip)
    if moving is not None:
        arrays["broadcast"] = _moving_rows(run, moving, clip, shown)
    return pack({"first": first, "count": len(shown), "loose": loose.tolist()}, arrays)


def _step(match: Match) -> int:
    """Return every which match frame the view shows; the browser interpolates."""
    return max(1, round(match.folder.spec.fps / RATE))


def _body_arrays(bodies: BodyTracks) -> Arrays:
    """Return each person's joints and surface in rest, and how the surface follows the joints."""
    model = bodies.model
    known = np.isfinite(bodies.poses.betas).all(-1)
    rows = known.argmax(axis=0)  # the shape is one per person and clip
    betas = np.nan_to_num(bodies.poses.betas[rows, np.arange(len(rows))])
    rest = model.joint_template + np.einsum("jcs,ps->pjc", model.joint_directions, betas)
    arrays: Arrays = {
        "rest_joints": rest.astype("<f4"),
        "parents": model.parents.astype("<i2"),
    }
    if model.name.partition("/")[0] != OPEN_BODY.partition("/")[0]:
        return arrays  # the surface of a licensed body stays on this machine
    surface = model.template + np.einsum("vcs,ps->pvc", model.shape_directions, betas)
    order = np.argsort(-model.weights, axis=1)[:, :INFLUENCES]
    shares = np.take_along_axis(model.weights, order, axis=1)
    shares /= shares.sum(axis=1, keepdims=True)
    return arrays | {
        "surface": np.round(surface / SURFACE_UNIT).astype("<i2"),
        "normals": _normals(model),
        "faces": model.faces.astype("<u2"),
        "influences": order.astype("u1"),
        "shares": np.round(255 * shares).astype("u1"),
    }


def _normals(model: BodyModel) -> NDArray[np.int8]:
    """Return the normals of the mean body in rest (vertices, 4), 127 = 1."""
    corners = model.template[model.faces]
    across = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    normals = np.zeros_like(model.template)
    for corner in range(3):
        np.add.at(normals, model.faces[:, corner], across)
    normals /= np.maximum(np.linalg.norm(normals, axis=1, keepdims=True), 1e-12)
    return np.pad(np.round(127 * normals), ((0, 0), (0, 1))).astype(np.int8)


def _whole(values: NDArray[np.floating], unit: float) -> NDArray[np.int16]:
    """Return values in integer units; `MISSING` where one of three is missing or too large."""
    known = np.isfinite(values) & (np.abs(values) < -MISSING * unit - 1e-3)
    scaled = np.where(known, values, 0.0) / unit
    return np.where(known.all(-1, keepdims=True), np.round(scaled), MISSING).astype("<i2")


def _static_cameras(run: Run, match: Match) -> list[dict[str, Any]]:
    if not match.has_static_cameras:
        return []
    cameras = static_cameras(run, match.folder.spec)
    return [
        {"name": name, "row": _rows(Camera.stack([camera]))[0].tolist()}
        for name, camera in cameras.items()
    ]


def _rows(camera: Camera) -> NDArray[np.float64]:
    """Return rotation, translation, focal lengths, principal point and image size (cameras, 18)."""
    pose = camera.cam_from_world
    count = len(pose.translation)
    size = np.broadcast_to(camera.image_size, (count, 2))
    focal = np.broadcast_to(camera.focal, (count, 2))
    middle = np.broadcast_to(camera.principal_point, (count, 2))
    rotation = pose.rotation.reshape(count, 9)
    return np.round(np.concatenate([rotation, pose.translation, focal, middle, size], axis=1), 6)


def _moving_rows(
    run: Run, camera: Camera, clip: str, shown: NDArray[np.int64]
) -> NDArray[np.float32]:
    """Return the rows of the broadcast camera in the shown frames; NaN where it is unknown."""
    own = run[f"broadcast_calibration/{clip}"]["frame"].values
    rows = np.full((len(shown), 18), np.nan)
    at = np.searchsorted(own, shown).clip(max=max(0, len(own) - 1))
    is_there = own[at] == shown
    rows[is_there] = _rows(camera[at[is_there]])
    return rows.astype("<f4")


def _video(run: Run, match: Match, clip: str) -> dict[str, Any] | None:
    """Return the camera of the clip's overlay video, its frames, and its rate [1/s]."""
    owner = clip_view(run, match, clip)
    if owner is None:
        return None
    frames = video_frames(run, match, clip, owner)
    rate = match.folder.spec.fps / _step(match)
    return {"camera": owner, "first": int(frames[0]), "frames": len(frames), "rate": rate}
