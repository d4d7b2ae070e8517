"""Repairs of broken conventions in a data set, each with the name of its fault."""

from __future__ import annotations

import itertools
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from typing import Final

import numpy as np

from data_contracts.arrays import Floats
from worldpose.dataset.contents import PointSource
from worldpose.formats.camera_file import CameraRows

LATEST: Final = 3
"""Maximum frame offset that is tested [frame]."""
_LENS: Final = "k1 k2 p1 p2 k3"


@dataclass(frozen=True)
class Fault:
    """A broken convention and its repair."""

    name: str
    says: str
    points: Callable[[PointSource], Floats | None] | None = None
    """Returns the repaired points; None if this fault is impossible."""
    camera: Callable[[CameraRows], CameraRows] | None = None
    """Returns the repaired camera."""
    later_points: int = 0
    """The 2D of frame f shows the points of frame f + this."""
    later_camera: int = 0
    """The 2D and points of frame f belong to the camera row of frame f + this."""


def point_faults() -> Iterator[Fault]:
    """Yield faults of 3D positions."""
    yield Fault(
        "root_about_origin",
        "global_orient turns about the model's origin and not about the pelvis joint",
        points=lambda s: None if s.pivot is None else s.points + s.pivot[:, :, None],
    )
    yield Fault(
        "degrees",
        "angles are in degrees and not in radians",
        points=lambda source: source.in_degrees,
    )
    for unit, size in (("millimetres", 1000.0), ("centimetres", 100.0)):
        yield Fault(unit, f"places of people are in {unit} and not in metres", _shrink(size))
    yield from _axis_faults()


def camera_faults() -> Iterator[Fault]:
    """Yield faults of the camera format."""
    yield Fault(
        "transposed_rotation",
        "R is world_from_cam, the transpose of what x_cam = R x_world + t has",
        camera=lambda c: _posed(c, _transposed(c.rotation), c.translation),
    )
    yield Fault(
        "translation_is_center",
        "t is the camera's centre C and not -R C",
        camera=lambda c: _posed(c, c.rotation, -_turned(c.rotation, c.translation)),
    )
    yield Fault(
        "camera_to_world",
        "R and t are world_from_cam: the transpose of R, and the centre for t",
        camera=lambda c: _posed(
            c, _transposed(c.rotation), -_turned(_transposed(c.rotation), c.translation)
        ),
    )
    yield Fault(
        "negated_translation",
        "t has the wrong sign",
        camera=lambda c: _posed(c, c.rotation, -c.translation),
    )
    yield Fault(
        "camera_in_millimetres",
        "t is in millimetres and not in metres",
        camera=lambda c: _posed(c, c.rotation, c.translation / 1000.0),
    )
    for order in ("k1 k2 k3 p1 p2", "p1 p2 k1 k2 k3", "k1 k2 p2 p1 k3"):
        yield Fault(
            "distortion_order",
            f"k is {order} and not OpenCV's {_LENS}",
            camera=_lens_in(order),
        )


def frame_faults(moving: bool) -> Iterator[Fault]:
    """Yield faults of frame alignment; only a moving camera has its own clock."""
    for late in sorted({*range(-LATEST, LATEST + 1)} - {0}, key=abs):
        frames = f"{abs(late)} frame{'s' if abs(late) > 1 else ''}"
        order = "late" if late > 0 else "early"
        yield Fault("frame_offset", f"the 3D is {frames} {order} against the 2D", None, None, late)
        if moving:
            yield Fault(
                "frame_offset", f"the camera is {frames} {order}", None, None, later_camera=late
            )
            yield Fault(
                "frame_offset",
                f"the 3D and the camera are {frames} {order} against the 2D",
                later_points=late,
                later_camera=late,
            )


def axis_orders() -> Iterator[tuple[str, Floats]]:
    """Yield all other orders and signs of three axes: description, and shipped-from-true (3, 3)."""
    for order in itertools.permutations(range(3)):
        for signs in itertools.product((1.0, -1.0), repeat=3):
            axes = np.eye(3)[list(order)] * np.array(signs)[:, None]
            if not np.array_equal(axes, np.eye(3)):
                yield ", ".join(_axis_words(axes)), axes


def _shrink(size: float) -> Callable[[PointSource], Floats]:
    def repaired(source: PointSource) -> Floats:
        if source.place is None:
            return source.points / size
        return source.points + (source.place / size - source.place)[:, :, None]

    return repaired


def _axis_faults() -> Iterator[Fault]:
    """Yield all other orders and signs of the axes, for whole points, then for `transl` alone."""
    for _, shipped_from_world in axis_orders():
        name, says = _axis_name(shipped_from_world)
        yield Fault(name, says, _turn(shipped_from_world, whole=True))
    for _, shipped_from_world in axis_orders():
        name, says = _axis_name(shipped_from_world)
        yield Fault(name, f"{says}, in transl alone", _turn(shipped_from_world, whole=False))


def _turn(shipped_from_world: Floats, whole: bool) -> Callable[[PointSource], Floats | None]:
    def repaired(source: PointSource) -> Floats | None:
        if whole:
            return source.points @ shipped_from_world
        if source.place is None:
            return None
        moved = source.place @ shipped_from_world - source.place
        return source.points + moved[:, :, None]

    return repaired


def _axis_name(shipped_from_world: Floats) -> tuple[str, str]:
    """Return the fault's name for these axes, and a description."""
    axes = _axis_words(shipped_from_world)
    says = f"x, y, z are the world's {', '.join(axes)}"
    if axes == ["x", "-z", "y"]:
        return "y_down_world", f"the world is y down: {says}"
    if axes == ["x", "z", "-y"]:
        return "y_up_world", f"the world is y up: {says}"
    if not any(axis.startswith("-") for axis in axes):
        return "swapped_axes", f"axes are swapped: {says}"
    if np.count_nonzero(np.diag(shipped_from_world)) == 3:
        if np.linalg.det(shipped_from_world) < 0.0:
            return "mirrored_world", f"the world is mirrored: {says}"
        return "turned_world", f"the world is turned by half a turn: {says}"
    return "other_axes", f"the world has other axes: {says}"


def _axis_words(axes: Floats) -> list[str]:
    """Return the description of each axis, such as -y."""
    return [f"{'-' if row.sum() < 0 else ''}{'xyz'[int(np.abs(row).argmax())]}" for row in axes]


def _lens_in(order: str) -> Callable[[CameraRows], CameraRows]:
    """Return a repair for a camera whose coefficients were written in another order."""
    place = [order.split().index(name) for name in _LENS.split()]

    def repaired(camera: CameraRows) -> CameraRows:
        lens = camera.distortion[:, place]
        return CameraRows(camera.intrinsics, lens, camera.rotation, camera.translation)

    return repaired


def _posed(camera: CameraRows, rotation: Floats, translation: Floats) -> CameraRows:
    return CameraRows(camera.intrinsics, camera.distortion, rotation, translation)


def _transposed(rotation: Floats) -> Floats:
    return np.swapaxes(rotation, -1, -2)


def _turned(rotation: Floats, vectors: Floats) -> Floats:
    return np.asarray((rotation @ vectors[..., None])[..., 0])
