"""Payload of the 3D viewer, and an HTML file that holds the viewer with it.

A part of the payload has a length (uint32), a JSON header of that length, and arrays; the header's
`arrays` gives type, shape and place of each. A clip has one part that describes the scene, and one
for each range of frames. `infra/review_pages/src/viewer/payload.js` reads the same parts.

- `scene`: `rest_joints` (B,24,3) [m], `parents` (24,), `surface` (B,V,3) [0.1 mm], `normals`,
  `faces`, `coarse_faces`, `rough_faces`, `influences` and `shares` (V,4).
- Ranges: `turns` (T,B,24,3) in `turn_units` [rad] relative to the parent joint, `place` (T,B,3)
  [m], `joints` (T,L,17,3) in `joint_unit` [m] relative to `anchor` (T,L,3) for people `loose`
  without a body, `ground` (T,G,3) x, y and deviation [m] of people of kind plane, `spread`
  (T,N,17) of joints, logarithmic: 1 = 1 mm, 255 = 1 m, 0 = unknown, `views` (T,N,17), `moving`
  (T,C,18) cameras.

The file has a script of type `application/octet-stream` with base64 per part (`data-clip`,
`data-part`: `scene`, the number of a range, or `video`).
"""

from __future__ import annotations

import base64
import json
import re
import struct
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from html import escape
from pathlib import Path
from typing import Any, Final

import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from data_contracts.arrays import Flags, Floats
from data_contracts.conventions import COCO17_BONES
from worldpose.body.body_file import is_open_body
from worldpose.body.model import (
    BodyModel,
    BodyParameters,
    articulate,
    cluster_vertices,
    vertex_normals,
)
from worldpose.errors import InputError
from worldpose.formats.files import whole_file
from worldpose.geometry.cameras import Camera

MAX_FILE_BYTES = 400_000_000
"""Largest file; browsers refuse texts of 512 MB, and this is more than ten minutes of a match."""

JOINT_UNIT: Final = 1e-4
"""Resolution of the joints of people without a body, relative to one of them [m]."""
SURFACE_UNIT: Final = 1e-4
"""Resolution of the body's surface [m]."""
_SHORT: Final = 32767
MIN_SPREAD_M, MAX_SPREAD_M = 1e-3, 1.0
"""Standard deviations that the smallest and the largest code stand for [m]."""

_SCRIPT: Final = '<script type="application/octet-stream" data-clip="{}" data-part="{}">'
_PART: Final = re.compile(_SCRIPT.format(r"(\d+)", r"(\w+)") + r"([^<]*)</script>")

Arrays = dict[str, NDArray[Any]]


@dataclass(frozen=True)
class ViewerPerson:
    """A person of a clip."""

    person: int
    """Id of the track."""
    name: str
    """Name to display; empty = unknown."""
    kind: str
    """Triangulated, mixed or plane (`data_contracts.tracking.Track.kind`)."""
    team: str
    """Name of the team; empty = unknown or official."""
    color: str
    """#rrggbb."""


@dataclass(frozen=True, eq=False)
class ViewerClip:
    """What the viewer shows of a clip, in metres and the world frame."""

    clip: str
    fps: float
    frames: NDArray[np.int64]
    """(frames,) match frames."""
    people: tuple[ViewerPerson, ...]
    joints: Floats
    """(frames, people, 17, 3) [m], COCO-17; NaN where missing."""
    spread: Floats
    """(frames, people, 17) [m], standard deviation per axis; NaN where unknown."""
    views: NDArray[np.int64]
    """(frames, people, 17), contributing cameras; -1 where unknown."""
    ground: Floats
    """(frames, people, 3) [m]: x, y and standard deviation of people placed by their feet."""
    height: Floats
    """(people,) [m], height of people placed by their feet; NaN where unknown."""
    bodies: BodyParameters | None
    """(frames, people), NaN where a person has no body."""
    model: BodyModel | None
    """Body model of `bodies`."""
    cameras: Mapping[str, Camera]
    """Static cameras by name."""
    moving: Mapping[str, Camera]
    """Moving cameras (frames,) by name, NaN where they are unknown."""
    markings: Sequence[Floats]
    """Painted lines (points, 3) [m]."""
    notes: Mapping[str, str]
    """Texts about the data by a short name, such as `licence`."""
    video: Mapping[str, Any] | None = None
    """Camera, first match frame, number of frames and step [frame] of the clip's video."""

    @property
    def has_people(self) -> bool:
        """Whether a person has joints, a body or a place on the pitch."""
        shown = np.isfinite(self.joints).any() or np.isfinite(self.ground[..., 0]).any()
        return bool(shown) or len(self.with_body) > 0

    def first_frames(self, count: int) -> ViewerClip:
        """Return the clip's first frames, `count` at most."""
        return replace(
            self,
            frames=self.frames[:count],
            joints=self.joints[:count],
            spread=self.spread[:count],
            views=self.views[:count],
            ground=self.ground[:count],
            bodies=None if self.bodies is None else self.bodies[:count],
            moving={name: camera[:count] for name, camera in self.moving.items()},
        )

    @property
    def range_frames(self) -> int:
        """Number of frames in a range."""
        range_seconds = 10.0  # duration of a range of frames [s]
        return max(1, round(range_seconds * self.fps))

    @property
    def with_body(self) -> NDArray[np.int64]:
        """Columns of people with a body in at least one frame."""
        if self.bodies is None:
            return np.zeros(0, dtype=np.int64)
        return np.flatnonzero(self.bodies.known.any(axis=0))


def encode_scene(clip: ViewerClip) -> bytes:
    """Return what stays the same in a clip: people, bodies, cameras, pitch, notes.

    A surface is written of the open body only; another body model's has terms of its own.
    """
    bodies = clip.with_body.tolist()
    file_format = "worldpose-viewer/1"
    header = {
        "format": file_format,
        "clip": clip.clip,
        "fps": clip.fps,
        "first": int(clip.frames[0]) if len(clip.frames) else 0,
        "frames": len(clip.frames),
        "range_frames": clip.range_frames,
        "people": [
            {
                "id": person.person,
                "name": person.name,
                "kind": person.kind,
                "team": person.team,
                "color": person.color,
                "body": bodies.index(column) if column in bodies else None,
                "height": None if np.isnan(clip.height[column]) else float(clip.height[column]),
            }
            for column, person in enumerate(clip.people)
        ],
        "units": {"joint": JOINT_UNIT, "surface": SURFACE_UNIT},
        "spread": [MIN_SPREAD_M, MAX_SPREAD_M],
        "bones": [list(bone) for bone in COCO17_BONES],
        "markings": [(np.round(_simplify(line), 3) + 0.0).tolist() for line in clip.markings],
        "cameras": [
            {"name": name, "row": _camera_rows(Camera.stack([camera]))[0].tolist()}
            for name, camera in clip.cameras.items()
        ],
        "moving": list(clip.moving),
        "video": None if clip.video is None else dict(clip.video),
        "notes": dict(clip.notes),
    }
    return _pack(header, _rest_arrays(clip) if bodies else {})


def encode_frames(clip: ViewerClip, first: int, count: int) -> bytes:
    """Return people and the moving cameras in `count` frames from index `first` of a clip."""
    here = slice(first, first + min(count, clip.range_frames))
    joints = clip.joints[here]
    arrays: Arrays = {}
    columns = clip.with_body
    if clip.bodies is not None and clip.model is not None and len(columns):
        poses = clip.bodies[here, columns]
        there = poses.known
        turned, units = _quantize_rotations(clip.model, poses, there)
        arrays["turns"], arrays["turn_units"] = turned, units
        arrays["place"] = np.where(there[..., None], poses.transl, np.nan).astype("<f4")
        drawn = np.zeros(joints.shape[:2], dtype=np.bool_)
        drawn[:, columns] = there
        joints = np.where(drawn[..., None, None], np.nan, joints)  # the body says more
    loose = np.flatnonzero(np.any(np.all(np.isfinite(joints), axis=-1), axis=(0, 2)))
    unit = JOINT_UNIT
    if len(loose):
        arrays["joints"], arrays["anchor"], unit = _quantize_joints(joints[:, loose])
    plane = np.flatnonzero(np.isfinite(clip.ground[here, :, 0]).any(axis=0))
    if len(plane):
        arrays["ground"] = clip.ground[here, plane].astype("<f4")
    if np.isfinite(clip.spread[here]).any():
        arrays["spread"] = encode_spread(clip.spread[here])
    if (clip.views[here] >= 0).any():
        views = clip.views[here]
        arrays["views"] = np.where(views < 0, 255, np.minimum(views, 254)).astype(np.uint8)
    if clip.moving:
        rows = [_camera_rows(camera[here]) for camera in clip.moving.values()]
        arrays["moving"] = np.stack(rows, axis=1).astype("<f4")
    header = {"first": first, "count": len(joints), "loose": loose.tolist()}
    return _pack(header | {"plane": plane.tolist(), "joint_unit": unit}, arrays)


def encode_spread(spread: Floats) -> NDArray[np.uint8]:
    """Return standard deviations [m] as codes on a logarithmic scale from 1 to 255; 0 = unknown."""
    share = np.log(np.clip(spread, MIN_SPREAD_M, MAX_SPREAD_M) / MIN_SPREAD_M)
    codes = 1.0 + np.round(254.0 * share / np.log(MAX_SPREAD_M / MIN_SPREAD_M))
    return np.where(np.isfinite(spread), np.nan_to_num(codes), 0.0).astype(np.uint8)


def decode_part(part: bytes) -> tuple[dict[str, Any], Arrays]:
    """Return header and arrays of a part."""
    (length,) = struct.unpack_from("<I", part)
    header: dict[str, Any] = json.loads(part[4 : 4 + length])
    arrays = {}
    for name, place in header.pop("arrays").items():
        count = int(np.prod(place["shape"]))
        data = np.frombuffer(part, f"<{place['type']}", count, 4 + length + place["at"])
        arrays[name] = data.reshape(place["shape"])
    return header, arrays


def decode_bodies(scene: bytes, frames: bytes) -> tuple[Floats, Floats]:
    """Return the bodies of a range as the viewer poses them, in the order of the scene's people.

    They are rotations (frames, bodies, 24, 3, 3) relative to the world, and joints (frames, bodies,
    24, 3) [m], NaN where a person has no body.
    """
    _, fixed = decode_part(scene)
    _, moving = decode_part(frames)
    turns = moving["turns"] * moving["turn_units"][:, None].astype(np.float64)
    local = Rotation.from_rotvec(turns.reshape(-1, 3)).as_matrix().reshape(*turns.shape, 3)
    rest = np.broadcast_to(fixed["rest_joints"].astype(np.float64), turns.shape)
    posed = articulate(rest, local, fixed["parents"].astype(np.int64))
    place = moving["place"].astype(np.float64)
    gone = np.isnan(place[..., :1, None, None])
    return np.where(gone, np.nan, posed.rotations), posed.joints + place[..., None, :]


def write_viewer(
    path: Path, page: str, clips: Sequence[ViewerClip], videos: Mapping[str, Path]
) -> None:
    """Write the built `page` with clips and their videos (mp4) inside, whole or not at all.

    It opens from disk without a network. InputError if nobody is in the clips, or it is too large.
    """
    if not any(clip.has_people for clip in clips):
        expected = "a person with joints, a body or a place on the pitch"
        todo = "Run the match to the end, and see with `worldpose status` what it found."
        raise InputError(
            str(path), expected, "none in " + ", ".join(clip.clip for clip in clips), todo
        )
    size = 0
    with whole_file(path) as draft, draft.open("w", encoding="utf-8", newline="\n") as file:
        for piece in viewer_pieces(page, clips, videos):
            size += file.write(piece)
            _require_size(path, size)


def viewer_pieces(
    page: str, clips: Sequence[ViewerClip], videos: Mapping[str, Path]
) -> Iterator[str]:
    """Yield the text of a page with clips inside, as `write_viewer` writes it."""
    data_mark = "<!--worldpose-data-->"
    before, _, after = page.partition(data_mark)
    title = escape(
        f"{clips[0].notes.get('match', 'worldpose')}: {', '.join(c.clip for c in clips)}"
    )
    title_mark = "<title>worldpose viewer</title>"
    yield before.replace(title_mark, f"<title>{title}</title>")
    for number, clip in enumerate(clips):
        for name, data in _parts(clip, videos.get(clip.clip)):
            yield f"{_SCRIPT.format(number, name)}{base64.b64encode(data).decode()}</script>\n"
    yield after


def read_viewer(path: Path) -> list[dict[str, bytes]]:
    """Return the parts of each clip of a viewer file: `scene`, `0`, `1`, ... and `video`."""
    clips: dict[int, dict[str, bytes]] = {}
    for number, name, text in _PART.findall(path.read_text(encoding="utf-8")):
        clips.setdefault(int(number), {})[name] = base64.b64decode(text)
    return [clips[number] for number in sorted(clips)]


def _parts(clip: ViewerClip, video: Path | None) -> Iterator[tuple[str, bytes]]:
    yield "scene", encode_scene(clip)
    for number, first in enumerate(range(0, len(clip.frames), clip.range_frames)):
        yield str(number), encode_frames(clip, first, clip.range_frames)
    if video is not None:
        yield "video", video.read_bytes()


def _require_size(path: Path, size: int) -> None:
    if size > MAX_FILE_BYTES:
        expected = f"at most {MAX_FILE_BYTES / 1e6:g} MB, which browsers open"
        todo = (
            "Cut the match into shorter clips, export a folder with a file per clip, or leave "
            "out --video."
        )
        raise InputError(str(path), expected, "more", todo)


def _pack(header: Mapping[str, Any], arrays: Mapping[str, NDArray[Any]]) -> bytes:
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


def _quantize_rotations(
    model: BodyModel, poses: BodyParameters, there: Flags
) -> tuple[NDArray[np.int16], NDArray[np.float32]]:
    """Return rotation vectors relative to the parents in whole units, and each joint's unit [rad].

    A joint's rotation relative to the world is rounded once only: the next one is relative to what
    its parent became by rounding. Poses (frames, bodies) that are not `there` get zeros. The shapes
    are (frames, bodies, 24, 3) and (24,).
    """
    parents = model.parents
    rotations = model.articulate(poses[there]).rotations
    whole = np.zeros((*there.shape, len(parents), 3), "<i2")
    units = np.zeros(len(parents), "<f4")
    if not len(rotations):
        return whole, units
    became = np.empty_like(rotations)
    rounded = np.empty((*rotations.shape[:2], 3))
    for joint, parent in enumerate(parents):
        before = became[:, parent] if joint else np.eye(3)
        turn = np.swapaxes(before, -1, -2) @ rotations[:, joint]
        vector = Rotation.from_matrix(turn).as_rotvec()
        # A single precision unit that is rounded down would not reach the largest value.
        units[joint] = np.float32(max(np.abs(vector).max(), 1e-6) / _SHORT * (1.0 + 1e-6))
        unit = float(units[joint])
        rounded[:, joint] = np.round(vector / unit)
        became[:, joint] = before @ Rotation.from_rotvec(rounded[:, joint] * unit).as_matrix()
    whole[there] = rounded.astype("<i2")
    return whole, units


def _quantize_joints(joints: Floats) -> tuple[NDArray[np.int16], NDArray[np.float32], float]:
    """Return joints relative to the first one that is known, that one, and the unit [m].

    The unit is larger than `JOINT_UNIT` where a joint is farther away than 16 bits reach.
    """
    known: Flags = np.all(np.isfinite(joints), axis=-1)
    first = np.take_along_axis(joints, known.argmax(axis=2)[..., None, None], axis=2)[:, :, 0]
    anchor = first.astype("<f4")
    away = np.where(known[..., None], joints - anchor[:, :, None].astype(np.float64), 0.0)
    away = np.nan_to_num(away)
    unit = max(JOINT_UNIT, float(np.abs(away).max()) / _SHORT)
    missing_code = -32768
    whole = np.where(known[..., None], np.round(away / unit), missing_code).astype("<i2")
    return whole, anchor, unit


def _rest_arrays(clip: ViewerClip) -> Arrays:
    """Return each body's joints and surface in rest, and how the surface follows the joints."""
    model, bodies = clip.model, clip.bodies
    assert model is not None  # there are bodies
    assert bodies is not None
    columns = clip.with_body
    rows = bodies.known[:, columns].argmax(axis=0)  # the shape is one per person and clip
    betas = bodies.betas[rows, columns]
    rest = model.joint_template + np.einsum("jcs,ps->pjc", model.joint_directions, betas)
    arrays: Arrays = {"rest_joints": rest.astype("<f4"), "parents": model.parents.astype("<i2")}
    if not is_open_body(model.name):
        return arrays  # the surface of a licensed body stays on this machine
    surface = model.template + np.einsum("vcs,ps->pvc", model.shape_directions, betas)
    influences = 4  # joints that move one vertex
    order = np.argsort(-model.weights, axis=1)[:, :influences]
    shares = np.take_along_axis(model.weights, order, axis=1)
    shares /= shares.sum(axis=1, keepdims=True)
    coarse_cell_m, rough_cell_m = 0.08, 0.16  # in which vertices of reduced surfaces merge
    normals = vertex_normals(model.template, model.faces)
    return arrays | {
        "surface": np.round(surface / SURFACE_UNIT).astype("<i2"),
        "normals": np.pad(np.round(127 * normals), ((0, 0), (0, 1))).astype(np.int8),
        "faces": model.faces.astype("<u2"),
        "coarse_faces": _reduce_faces(model, coarse_cell_m).astype("<u2"),
        "rough_faces": _reduce_faces(model, rough_cell_m).astype("<u2"),
        "influences": order.astype("u1"),
        "shares": np.round(255 * shares).astype("u1"),
    }


def _simplify(line: Floats) -> Floats:
    """Return a polyline (points, 3) without points that are within a centimetre of the rest."""
    kept, first = [0], 0
    line_error_m = 0.01  # largest deviation of a line, 12 cm wide, from its points
    for last in range(2, len(line)):
        along = line[last] - line[first]
        share = (line[first + 1 : last] - line[first]) @ along / max(along @ along, 1e-12)
        near = line[first] + np.clip(share, 0.0, 1.0)[:, None] * along
        if np.linalg.norm(near - line[first + 1 : last], axis=-1).max() > line_error_m:
            first = last - 1
            kept.append(first)
    return line[[*kept, len(line) - 1]]


def _reduce_faces(model: BodyModel, cell: float) -> NDArray[np.int64]:
    """Return the triangles of a reduced surface, of the same vertices (triangles, 3).

    Vertices of one joint in one cell, of this size [m], become the one nearest to their mean.
    """
    cells = np.floor(model.template / cell).astype(np.int64)
    keys = np.column_stack([model.weights.argmax(axis=1), cells])
    kept, merged = cluster_vertices(model.template, model.faces, keys)
    faces = kept[merged]
    # The same triangle twice is one.
    turned = np.stack([np.roll(face, -face.argmin()) for face in faces])
    return np.unique(turned, axis=0)


def _camera_rows(camera: Camera) -> Floats:
    """Return rotation, translation, focal lengths, principal point and image size (cameras, 18)."""
    pose = camera.cam_from_world
    count = len(pose.translation)
    size = np.broadcast_to(camera.image_size, (count, 2))
    focal = np.broadcast_to(camera.focal, (count, 2))
    middle = np.broadcast_to(camera.principal_point, (count, 2))
    rotation = pose.rotation.reshape(count, 9)
    return np.round(np.concatenate([rotation, pose.translation, focal, middle, size], axis=1), 6)
