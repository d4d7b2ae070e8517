"""glTF 2.0 file (.glb) of a clip: skinned bodies that move, cameras, the pitch."""

from __future__ import annotations

import colorsys
import json
import struct
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, Final

import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from data_contracts.arrays import Floats, Integers
from data_contracts.cameras import COEFFICIENTS
from worldpose.body.keypoints import SKELETONS
from worldpose.body.model import BodyModel, BodyParameters, vertex_normals
from worldpose.errors import InputError
from worldpose.formats.files import whole_file
from worldpose.geometry.cameras import Camera
from worldpose.geometry.lens_models import LensModel

_VERTICES, _INDICES = 34962, 34963
INFLUENCES: Final = 8
"""Joints of a vertex in two sets of four; viewers must read one set, and most read both."""
FACING: Final = np.diag([1.0, -1.0, -1.0])
"""Rotation from glTF's camera axes (y up, looking along -z) to OpenCV's."""


@dataclass(frozen=True, eq=False)
class AnimatedBody:
    """One person's body over the frames of a clip."""

    name: str
    """Name of the node, such as `person_003`; joints are `person_003_left_hip`."""
    poses: BodyParameters
    """(frames,), NaN where the person is missing; betas count from the first frame with a body."""
    about: Mapping[str, Any]
    """Notes of the node about the person."""


def people_with_bodies(path: Path, people: Sequence[AnimatedBody]) -> list[AnimatedBody]:
    """Return the people who have a body in a frame; InputError if no person has one."""
    present = [person for person in people if person.poses.known.any()]
    if not present:
        todo = "Run the match up to body_fitting, or export joints: --format c3d or csv."
        raise InputError(str(path), "a person with a fitted body", "none", todo)
    return present


def rest_joints(
    model: BodyModel, person: AnimatedBody
) -> tuple[NDArray[np.int64], BodyParameters, Floats]:
    """Return a person's frames with a body, the poses in them, and the joints in rest (24, 3)."""
    rows = np.flatnonzero(person.poses.known)
    poses = person.poses[rows]
    return rows, poses, model.joint_template + model.joint_directions @ poses.betas[0]


def skin_weights(model: BodyModel) -> tuple[NDArray[np.int64], NDArray[np.float32]]:
    """Return the joints that move each vertex most, and their weights (vertices, INFLUENCES)."""
    order = np.argsort(-model.weights, axis=1, kind="stable")[:, :INFLUENCES]
    weights = np.take_along_axis(model.weights, order, axis=1)
    return order, (weights / weights.sum(axis=1, keepdims=True)).astype(np.float32)


def known_frames(camera: Camera) -> tuple[NDArray[np.int64], Camera]:
    """Return the frames in which a camera is known, 0 for a single one, and the camera in them."""
    if not camera.batch_shape:
        camera = Camera.stack([camera])
    pose = camera.cam_from_world
    numbers = [camera.focal, pose.rotation.reshape(-1, 9), pose.translation]
    rows = np.flatnonzero(np.isfinite(np.concatenate(numbers, axis=-1)).all(axis=-1))
    return rows, camera[rows]


def lens_notes(known: Camera) -> tuple[str, str, Floats]:
    """Return a camera's lens model, the key of its coefficients, and these (frames or 1, n)."""
    model = LensModel(int(known[0].lens_model))
    key, values = "_".join(["distortion", *COEFFICIENTS[model.label]]), known.distortion
    values = values[:, model.columns]
    return model.label, key, values[:1] if (values == values[0]).all() else values


@dataclass
class _File:
    """A glTF document that grows."""

    content: dict[str, list[Any]] = field(default_factory=dict)
    blob: bytearray = field(default_factory=bytearray)
    channels: list[dict[str, Any]] = field(default_factory=list)
    samplers: list[dict[str, Any]] = field(default_factory=list)

    def animate(
        self, node: int, part: str, times: int, values: NDArray[Any], how: str = "LINEAR"
    ) -> None:
        """Move a node's translation, rotation or scale: a row of values for each time."""
        keys = {"input": times, "output": self.accessor(values), "interpolation": how}
        self.samplers.append(keys)
        target = {"node": node, "path": part}
        self.channels.append({"sampler": len(self.samplers) - 1, "target": target})

    def add(self, kind: str, item: Mapping[str, Any]) -> int:
        """Append an object; return its index."""
        items = self.content.setdefault(kind, [])
        items.append(dict(item))
        return len(items) - 1

    def accessor(
        self, array: NDArray[Any], target: int | None = None, *, bounds: bool = False
    ) -> int:
        """Append an array (rows, ...); return the index of its accessor.

        Types are int16 (fractions), uint8, uint16, uint32 and float32; `target` is the use of
        vertices and indices, and `bounds` states the extreme values.
        """
        self.blob += b"\0" * (-len(self.blob) % 4)
        view = {"buffer": 0, "byteOffset": len(self.blob), "byteLength": array.nbytes}
        self.blob += np.ascontiguousarray(array).tobytes()
        kinds = {"int16": 5122, "uint8": 5121, "uint16": 5123, "uint32": 5125, "float32": 5126}
        types = {(): "SCALAR", (3,): "VEC3", (4,): "VEC4", (4, 4): "MAT4"}
        item = {
            "bufferView": self.add("bufferViews", view | ({"target": target} if target else {})),
            "componentType": kinds[array.dtype.name],
            "count": len(array),
            "type": types[array.shape[1:]],
        }
        if array.dtype == np.int16:
            item["normalized"] = True
        if bounds:
            item["min"] = np.atleast_1d(array.min(axis=0)).tolist()
            item["max"] = np.atleast_1d(array.max(axis=0)).tolist()
        return self.add("accessors", item)


def write_gltf(
    path: Path,
    model: BodyModel,
    people: Sequence[AnimatedBody],
    fps: float,
    *,
    cameras: Mapping[str, Camera],
    markings: Sequence[Floats],
    notes: Mapping[str, str],
    surface: bool = True,
) -> None:
    """Write a clip as one .glb file, whole or not at all; InputError if no person has a body.

    Node `world` turns glTF's axes (y up) into the world's (z up), and all others are below it:
    `pitch`, each camera and each person, in metres. A person's 24 joints form a hierarchy; the
    pelvis has a translation, every joint a rotation relative to its parent, at every frame in which
    the person has a body. In other frames the person's node has scale 0. Rotations have 16 bits;
    each joint's compensates for the rounding of its parents, so that errors do not add up. The
    surface has the person's shape and the model's skinning weights, without pose correctives.

    Cameras have the focal length and pose, and their `extras` the rest: image size, principal point
    and distortion, and of a moving camera the focal length of every frame, and the distortion where
    it changes, since glTF cannot animate them.

    People have the same frames, of which 0 is at 0 s. Cameras are single or one per frame, NaN
    where unknown; markings are lines (points, 3) [m], world. `notes` become the file's `extras`,
    and `licence` its copyright.
    """
    file = _File()
    writer = _Writer(file, model, fps, surface=surface)
    present = people_with_bodies(path, people)
    children = [writer.add_person(person, number) for number, person in enumerate(present)]
    children += [writer.add_camera(name, camera) for name, camera in cameras.items()]
    if markings:
        children.append(writer.add_pitch(markings))
    half = np.sqrt(0.5)
    turned = {"name": "world", "rotation": [-half, 0.0, 0.0, half], "children": children}
    world = file.add("nodes", turned)
    animation = {"name": "clip", "channels": file.channels, "samplers": file.samplers}
    document: dict[str, Any] = {
        "asset": {
            "version": "2.0",
            "generator": notes.get("software", "worldpose"),
            "copyright": notes.get("licence", ""),
            "extras": dict(notes),
        },
        "scene": 0,
        "scenes": [{"nodes": [world, *writer.surfaces], "extras": {"frames_per_second": fps}}],
        "animations": [animation],
        **file.content,
        "buffers": [{"byteLength": len(file.blob)}],
    }
    with whole_file(path) as draft:
        draft.write_bytes(_pack(document, file.blob))


def _pack(document: Mapping[str, Any], blob: bytearray) -> bytes:
    """Return the two chunks of a binary glTF file with its header."""
    text = json.dumps(document, separators=(",", ":")).encode()
    text += b" " * (-len(text) % 4)
    data = bytes(blob) + b"\0" * (-len(blob) % 4)
    size = 12 + 8 + len(text) + 8 + len(data)
    return b"".join(
        [
            struct.pack("<4sII", b"glTF", 2, size),
            struct.pack("<I4s", len(text), b"JSON"),
            text,
            struct.pack("<I4s", len(data), b"BIN\0"),
            data,
        ]
    )


class _Writer:
    """Nodes of people, cameras and pitch; what all people share is written once."""

    def __init__(self, file: _File, model: BodyModel, fps: float, *, surface: bool) -> None:
        self.file, self.model, self.fps = file, model, fps
        self.attributes: dict[str, int] = {}
        self.indices = -1
        self.surfaces: list[int] = []
        self._times: dict[bytes, int] = {}
        if surface:
            self._share_surface()

    def times(self, rows: NDArray[np.integer]) -> int:
        """Return the accessor of the times of frames."""
        key = rows.astype(np.int64).tobytes()
        if key not in self._times:
            seconds = (rows / self.fps).astype(np.float32)
            self._times[key] = self.file.accessor(seconds, bounds=True)
        return self._times[key]

    def _share_surface(self) -> None:
        """Write triangles, weights, and the normals of the mean body."""
        model = self.model
        order, weights = skin_weights(model)
        joints = np.where(weights > 0.0, order, 0).astype(np.uint8)
        normals = vertex_normals(model.template, model.faces)
        add = self.file.accessor
        self.attributes = {"NORMAL": add(normals.astype(np.float32), _VERTICES)}
        for half in range(INFLUENCES // 4):
            part = slice(4 * half, 4 * half + 4)
            self.attributes[f"JOINTS_{half}"] = add(joints[:, part], _VERTICES)
            self.attributes[f"WEIGHTS_{half}"] = add(weights[:, part], _VERTICES)
        self.indices = self._add_faces(model.faces, len(model.template))

    def _add_faces(self, triangles: Integers, vertices: int) -> int:
        wide = np.uint16 if vertices < 65535 else np.uint32
        return self.file.accessor(triangles.ravel().astype(wide), _INDICES)

    def add_person(self, person: AnimatedBody, number: int) -> int:
        """Add a person's joints, motion and surface; return the node."""
        there = person.poses.known
        rows, poses, rest = rest_joints(self.model, person)
        turns = _quantize_rotations(self.model.articulate(poses).rotations, self.model.parents)
        parents = self.model.parents
        first = len(self.file.content.get("nodes", []))
        for joint, name in enumerate(SKELETONS["smpl24"]):
            place = rest[joint] - rest[parents[joint]] if joint else rest[0] + poses.transl[0]
            node: dict[str, Any] = {
                "name": f"{person.name}_{name}",
                "translation": place.tolist(),
                "rotation": _unit(turns[0, joint]).tolist(),
            }
            below = (first + np.flatnonzero(parents == joint)).tolist()
            self.file.add("nodes", node | ({"children": below} if below else {}))
        if self.attributes:
            self._add_surface(person, number, poses.betas[0], rest, first)
        node = {"name": person.name, "children": [first], "extras": dict(person.about)}
        root = self.file.add("nodes", node)
        times = self.times(rows)
        moved = (rest[0] + poses.transl).astype(np.float32)
        self.file.animate(first, "translation", times, moved)
        for joint in range(len(parents)):
            if np.ptp(turns[:, joint], axis=0).any():
                self.file.animate(first + joint, "rotation", times, turns[:, joint])
        if not there.all():
            edges = np.flatnonzero(np.diff(there)) + 1
            keys = np.concatenate([[0], edges])
            scale = np.repeat(there[keys][:, None].astype(np.float32), 3, axis=1)
            self.file.animate(root, "scale", self.times(keys), scale, "STEP")
        return root

    def _add_surface(
        self, person: AnimatedBody, number: int, betas: Floats, rest: Floats, first: int
    ) -> None:
        """Add a surface to the nodes without a parent: its joints alone place it."""
        surface = (self.model.template + self.model.shape_directions @ betas).astype(np.float32)
        colour = colorsys.hsv_to_rgb(number * 0.618 % 1.0, 0.45, 0.85)
        primitive = {
            "attributes": {
                "POSITION": self.file.accessor(surface, _VERTICES, bounds=True),
                **self.attributes,
            },
            "indices": self.indices,
            "material": self._add_material(colour, 0.9),
        }
        mesh = self.file.add("meshes", {"name": f"{person.name}_body", "primitives": [primitive]})
        bind = np.tile(np.eye(4, dtype=np.float32), (len(rest), 1, 1))
        bind[:, 3, :3] = -rest  # column by column, as the format wants it
        skin = {
            "inverseBindMatrices": self.file.accessor(bind),
            "joints": list(range(first, first + len(rest))),
            "skeleton": first,
        }
        node: dict[str, Any] = {"name": f"{person.name}_surface", "mesh": mesh}
        node["skin"] = self.file.add("skins", skin)
        self.surfaces.append(self.file.add("nodes", node))

    def _add_material(self, color: Sequence[float], roughness: float) -> int:
        surface = {
            "baseColorFactor": [*color, 1.0],
            "metallicFactor": 0.0,
            "roughnessFactor": roughness,
        }
        return self.file.add("materials", {"pbrMetallicRoughness": surface})

    def add_camera(self, name: str, camera: Camera) -> int:
        """Add a single or a moving camera; return the node."""
        near_m = 0.1  # near plane of cameras [m]
        rows, known = known_frames(camera)
        if not len(rows):
            return self.file.add("nodes", {"name": name})
        width, height = (float(n) for n in known.image_size[0])
        focal = np.median(known.focal, axis=0)
        lens = {
            "type": "perspective",
            "name": name,
            "perspective": {
                "yfov": float(2.0 * np.arctan(0.5 * height / focal[1])),
                "aspectRatio": float(width / focal[0] * focal[1] / height),
                "znear": near_m,
            },
        }
        turns = _continuous(
            Rotation.from_matrix(known.cam_from_world.rotation.swapaxes(-1, -2) @ FACING).as_quat()
        ).astype(np.float32)
        centers = known.center.astype(np.float32)
        model, key, lenses = lens_notes(known)
        about: dict[str, Any] = {
            "image_size_px": [int(width), int(height)],
            "principal_point_px": known.principal_point[0].tolist(),
            "lens_model": model,
        }
        if len(lenses) == 1:
            about[key] = lenses[0].tolist()
        else:
            of_row = dict(zip(rows.tolist(), lenses.tolist(), strict=True))
            about[f"{key}_by_frame"] = [of_row.get(row) for row in range(len(camera.focal))]
        if camera.batch_shape not in ((), (1,)):
            about["focal_px_by_frame"] = [
                None if np.isnan(one) else round(one, 3) for one in camera.focal[:, 1].tolist()
            ]
        node = {
            "name": name,
            "camera": self.file.add("cameras", lens),
            "rotation": turns[0].tolist(),
            "translation": centers[0].tolist(),
            "extras": about,
        }
        index = self.file.add("nodes", node)
        if len(rows) > 1:
            times = self.times(rows)
            self.file.animate(index, "rotation", times, turns)
            self.file.animate(index, "translation", times, centers)
        return index

    def add_pitch(self, markings: Sequence[Floats]) -> int:
        """Add the markings as flat strips, above a lawn; return the node."""
        lawn_depth_m = 0.02  # below the lowest marking, which it does not cover
        lawn_margin_m = 4.0  # width of the lawn around the markings [m]
        materials = (
            self._add_material(color, 1.0) for color in ((0.12, 0.35, 0.14), (1.0, 1.0, 1.0))
        )
        points = np.concatenate(list(markings))
        low, high = points.min(axis=0), points.max(axis=0)
        (x0, y0), (x1, y1) = low[:2] - lawn_margin_m, high[:2] + lawn_margin_m
        z = low[2] - lawn_depth_m
        corners = np.array([[x0, y0, z], [x1, y0, z], [x1, y1, z], [x0, y1, z]])
        lawn = corners, np.array([[0, 1, 2], [0, 2, 3]])
        shapes, add = [], self.file.accessor
        for (vertices, triangles), material in zip(
            (lawn, paint_strips(markings)), list(materials), strict=True
        ):
            up = np.tile(np.array([0.0, 0.0, 1.0], np.float32), (len(vertices), 1))
            attributes = {
                "POSITION": add(vertices.astype(np.float32), _VERTICES, bounds=True),
                "NORMAL": add(up, _VERTICES),
            }
            faces = self._add_faces(triangles, len(vertices))
            shapes.append({"attributes": attributes, "indices": faces, "material": material})
        mesh = self.file.add("meshes", {"name": "pitch", "primitives": shapes})
        return self.file.add("nodes", {"name": "pitch", "mesh": mesh})


def paint_strips(markings: Sequence[Floats]) -> tuple[Floats, Integers]:
    """Return strips that face up along lines (points, 3) [m]: vertices (n, 3), triangles (m, 3)."""
    marking_width_m = 0.12  # at most by the Laws; programs render no line without width
    vertices, triangles, first = [], [], 0
    for line in markings:
        way = np.gradient(line[:, :2], axis=0)
        way /= np.linalg.norm(way, axis=1, keepdims=True)
        aside = 0.5 * marking_width_m * np.column_stack([-way[:, 1], way[:, 0], 0.0 * way[:, 0]])
        vertices += [line + aside, line - aside]
        left = first + np.arange(len(line))
        right = left + len(line)
        triangles += [
            np.column_stack([left[:-1], right[:-1], right[1:]]),
            np.column_stack([left[:-1], right[1:], left[1:]]),
        ]
        first += 2 * len(line)
    return np.concatenate(vertices), np.concatenate(triangles)


def _quantize_rotations(rotations: Floats, parents: NDArray[np.int64]) -> NDArray[np.int16]:
    """Return quaternions x y z w (frames, joints, 4) relative to the parents (joints,), in 16 bits.

    A joint's rotation (frames, joints, 3, 3) relative to the world is rounded once only: the next
    one is relative to what its parent became by rounding.
    """
    rounded = np.empty((*rotations.shape[:2], 4), np.int16)
    became = np.empty_like(rotations)
    largest = 32767
    for joint, parent in enumerate(parents):
        before = became[:, parent] if joint else np.eye(3)
        turn = np.swapaxes(before, -1, -2) @ rotations[:, joint]
        unit = _continuous(Rotation.from_matrix(turn).as_quat())
        rounded[:, joint] = np.round(unit * largest)
        became[:, joint] = before @ Rotation.from_quat(_unit(rounded[:, joint])).as_matrix()
    return rounded


def _continuous(quaternions: Floats) -> Floats:
    """Return quaternions (frames, 4) of which neighbours are in one half-space."""
    flips = np.sum(quaternions[1:] * quaternions[:-1], axis=-1) < 0.0
    signs = np.concatenate([[1.0], np.where(np.cumsum(flips) % 2, -1.0, 1.0)])
    near: Floats = quaternions * signs[:, None]
    return near


def _unit(rounded: NDArray[np.int16]) -> Floats:
    plain = rounded.astype(np.float64)
    unit: Floats = plain / np.linalg.norm(plain, axis=-1, keepdims=True)
    return unit
