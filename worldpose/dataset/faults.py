"""Repairs of broken conventions in a data set, each with the name of its fault."""

from __future__ import annotations

import itertools
from collections.abc import Callable, Iterable, Iterator
from dataclasses import dataclass
from typing import Final

import numpy as np
from numpy.typing import NDArray
from pydantic import Field

from data_contracts.arrays import Floats
from data_contracts.records import Positive, Record, Share
from data_contracts.release import Finding
from worldpose.dataset.contents import PointSource, View
from worldpose.formats.challenge import CameraRows
from worldpose.geometry.cameras import Camera

LATEST: Final = 3
"""Maximum frame offset that is tested [frame]."""
_LENS: Final = "k1 k2 p1 p2 k3"


class CheckSettings(Record):
    """Thresholds beyond which a fault is reported."""

    max_sample: int = Field(default=3000, ge=100, le=1_000_000)
    """Maximum number of 2D points per camera to test faults: their median is accurate to a few
    percent."""
    max_error: float = Field(default=0.06, ge=1e-6, le=10)
    """Tolerated median reprojection error [height of a person in the image]: detected keypoints
    are within it; a broken convention exceeds it or has an explanation."""
    max_share_left: float = Field(default=0.7, gt=0, lt=1)
    """A fault is named if its repair leaves at most this share of the median error [1]."""
    min_gain_px: float = Field(default=0.3, ge=1e-6, le=100)
    """And removes at least this much [px]: rounded pixels must not cause a fault."""
    max_error_left: float = Field(default=0.2, ge=1e-6, le=100)
    """And leaves at most this [height of a person in the image]: random data has no explanation."""
    min_ground_m: float = Field(default=-0.4, ge=-100, le=0)
    """Minimum median height of the lower foot [m]: a pitch falls by 0.2 m to its edges, and fits
    sink by some centimetres."""
    max_ground_m: float = Field(default=0.13, ge=0, le=100)
    """Maximum median height of the lower foot [m]: heels and toes are some cm above the ground."""
    bounds_m: tuple[Positive, Positive] = (65.0, 46.0)
    """Maximum |x| and |y| of people [m]: the pitch of 105 x 68 m and 12 m around it."""
    min_plausible_share: Share = 0.9
    """Minimum share of bodies near the ground, head up, within the bounds [1]."""
    max_speed_m_s: Positive = 13.0
    """Maximum speed of a person's hips [m/s]; the fastest sprinters reach 12.4."""
    max_fast_share: Share = 0.002
    """Tolerated share of faster steps [1]: noise of a single frame at 50 frames/s."""
    bones_m: tuple[Positive, Positive] = (0.15, 0.62)
    """Minimum and maximum length of a person's upper arm, forearm, thigh and shin [m]."""
    max_center_drift_m: Positive = 0.05
    """Maximum distance of a moving camera's centre from its median [m]: the release's cameras
    rotate and zoom, and never translate."""
    max_rotation_error: Positive = 1e-4
    """Largest element of R'R - 1 [1]: files in single precision stay far below."""
    min_visible_share: Share = 0.02
    """Minimum share of people that a camera must show in some frame [1]."""


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
    """Yield the faults that a file of 3D poses may have: pivot, angles, units, axes."""
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
        camera=lambda c: _pose_rows(c, _transpose(c.rotation), c.translation),
    )
    yield Fault(
        "translation_is_center",
        "t is the camera's centre C and not -R C",
        camera=lambda c: _pose_rows(c, c.rotation, -_turn_vectors(c.rotation, c.translation)),
    )
    yield Fault(
        "camera_to_world",
        "R and t are world_from_cam: the transpose of R, and the centre for t",
        camera=lambda c: _pose_rows(
            c, _transpose(c.rotation), -_turn_vectors(_transpose(c.rotation), c.translation)
        ),
    )
    yield Fault(
        "negated_translation",
        "t has the wrong sign",
        camera=lambda c: _pose_rows(c, c.rotation, -c.translation),
    )
    yield Fault(
        "camera_in_millimetres",
        "t is in millimetres and not in metres",
        camera=lambda c: _pose_rows(c, c.rotation, c.translation / 1000.0),
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
    def repair(source: PointSource) -> Floats:
        if source.place is None:
            return source.points / size
        return source.points + (source.place / size - source.place)[:, :, None]

    return repair


def _axis_faults() -> Iterator[Fault]:
    """Yield all other orders and signs of the axes, for whole points, then for `transl` alone."""
    for _, shipped_from_world in axis_orders():
        name, says = _axis_name(shipped_from_world)
        yield Fault(name, says, _turn(shipped_from_world, whole=True))
    for _, shipped_from_world in axis_orders():
        name, says = _axis_name(shipped_from_world)
        yield Fault(name, f"{says}, in transl alone", _turn(shipped_from_world, whole=False))


def _turn(shipped_from_world: Floats, whole: bool) -> Callable[[PointSource], Floats | None]:
    def repair(source: PointSource) -> Floats | None:
        if whole:
            return source.points @ shipped_from_world
        if source.place is None:
            return None
        moved = source.place @ shipped_from_world - source.place
        return source.points + moved[:, :, None]

    return repair


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

    def repair(camera: CameraRows) -> CameraRows:
        lens = camera.distortion[:, place]
        return CameraRows(camera.intrinsics, lens, camera.rotation, camera.translation)

    return repair


def _pose_rows(camera: CameraRows, rotation: Floats, translation: Floats) -> CameraRows:
    return CameraRows(camera.intrinsics, camera.distortion, rotation, translation)


def _transpose(rotation: Floats) -> Floats:
    return np.swapaxes(rotation, -1, -2)


def _turn_vectors(rotation: Floats, vectors: Floats) -> Floats:
    return np.asarray((rotation @ vectors[..., None])[..., 0])


Ints = NDArray[np.int64]

SOUND = Fault("none", "as shipped")
"""No repair."""


@dataclass(frozen=True, eq=False)
class Agreement:
    """Residuals between a source's points and a view's 2D."""

    view: str
    source: str
    median_px: float
    count: int
    height_px: float
    """Median height of a person's 2D."""
    fault: Fault
    """Best explanation; `SOUND` if none is better."""
    explained_px: float
    """The median after repair of the fault."""


@dataclass(frozen=True, eq=False)
class _Sample:
    """2D points of a view, each with its frame, person and index in the source's skeleton."""

    frame: Ints
    person: Ints
    point: Ints
    pixels: Floats


def compare_view(source: PointSource, view: View, settings: CheckSettings) -> Agreement | None:
    """Return the residuals between a source and a view, and the fault that explains them best.

    A fault is named if its repair removes most of the error; a 2D point that the camera cannot see
    has infinite error. Frame offsets are also searched with whole bodies.

    Args:
        source: 3D points.
        view: a camera with 2D.
        settings: thresholds for an explanation.

    Returns:
        None if they have no points in common.
    """
    sample = _sample(source, view, settings.max_sample)
    if sample is None:
        return None
    errors = _errors(source.points, view.rows, sample, SOUND)
    shipped = _median(errors)
    best, least = SOUND, shipped
    for fault in _candidates(moving=len(view.rows.rotation) > 1):
        if shipped < settings.min_gain_px:
            break
        points = source.points if fault.points is None else fault.points(source)
        if points is None:
            continue
        rows = view.rows if fault.camera is None else fault.camera(view.rows)
        error = _median(_errors(points, rows, sample, fault))
        # A tie goes to the first fault.
        if error < least - 1e-9:
            best, least = fault, error
    # This order also works for infinity.
    height = _height(view)
    explains = shipped - least > settings.min_gain_px and least < settings.max_share_left * shipped
    explains = explains and least <= settings.max_error_left * height
    if not explains and np.isfinite(shipped) and shipped > settings.min_gain_px:
        found = find_frame_offset(source, view, settings)
        if found is not None:
            explains, best = True, found[0]
            least = _median(_errors(source.points, view.rows, sample, best))
    return Agreement(
        view=view.name,
        source=source.name,
        median_px=shipped,
        count=len(errors),
        height_px=height,
        fault=best if explains else SOUND,
        explained_px=least if explains else shipped,
    )


def agreement_findings(found: Iterable[Agreement], settings: CheckSettings) -> Iterator[Finding]:
    """Yield findings, one per fault of a source, with the cameras that show it."""
    named: dict[tuple[str, str, str], list[Agreement]] = {}
    for one in found:
        if one.fault is not SOUND:
            named.setdefault((one.source, one.fault.name, one.fault.says), []).append(one)
        elif one.median_px > settings.max_error * one.height_px:
            named.setdefault((one.source, "reprojection", _UNEXPLAINED), []).append(one)
    for (source, name, says), group in named.items():
        yield Finding(
            fault=name,
            kind="damage" if name == "reprojection" else "convention",
            where=(source, *(f"cameras/{one.view}" for one in group)),
            says=says,
            figures={
                "shipped_median_px": _capped_median([one.median_px for one in group]),
                "explained_median_px": _capped_median([one.explained_px for one in group]),
            },
        )


_UNEXPLAINED = (
    "the projected 3D points differ from the 2D points, and no known convention explains it"
)


def _candidates(moving: bool) -> Iterator[Fault]:
    yield from camera_faults()
    yield from frame_faults(moving)
    yield from point_faults()


def _sample(source: PointSource, view: View, size: int) -> _Sample | None:
    """Sample 2D points evenly from those that the source also has."""
    if view.pixels is None or view.pixels.shape[1] != source.points.shape[1]:
        return None
    shared = [name for name in view.skeleton if name in source.skeleton]
    in_view = [view.skeleton.index(name) for name in shared]
    in_source = np.array([source.skeleton.index(name) for name in shared], dtype=np.int64)
    count = min(len(view.pixels), len(source.points))
    pixels = view.pixels[:count][:, :, in_view]
    known = np.all(np.isfinite(pixels), axis=-1)
    known &= np.all(np.isfinite(source.points[:count][:, :, in_source]), axis=-1)
    if len(view.rows.rotation) > 1:
        rows = np.all(np.isfinite(view.rows.rotation), axis=(-1, -2))[:count]
        known[: len(rows)] &= rows[:, None, None]
        known[len(rows) :] = False
    frame, person, joint = np.nonzero(known)
    if not len(frame):
        return None
    picked = np.unique(np.linspace(0, len(frame) - 1, size).round().astype(np.int64))
    frame, person, joint = frame[picked], person[picked], joint[picked]
    return _Sample(frame, person, in_source[joint], pixels[frame, person, joint])


def _errors(points: Floats, rows: CameraRows, sample: _Sample, fault: Fault) -> Floats:
    """Return residuals (n,) [px] between projected points and 2D; infinite for invisible points."""
    frame = sample.frame + fault.later_points
    row = sample.frame + fault.later_camera
    moving = len(rows.rotation) > 1
    within = (frame >= 0) & (frame < len(points))
    if moving:
        within &= (row >= 0) & (row < len(rows.rotation))
    if not within.any():
        return np.full(1, np.inf)
    here = points[frame[within], sample.person[within], sample.point[within]]
    camera: Camera = rows.camera()
    pixels = (
        camera[row[within]].project(here[:, None])[:, 0] if moving else (camera[0].project(here))
    )
    away = np.linalg.norm(pixels - sample.pixels[within], axis=-1)
    errors: Floats = np.where(np.isnan(away), np.inf, away)
    # A person who enters or leaves in between is no evidence.
    return errors[np.isfinite(here).all(-1)] if fault.later_points else errors


def _median(errors: Floats) -> float:
    return float(np.sort(errors)[len(errors) // 2]) if len(errors) else np.inf


def _height(view: View) -> float:
    """Return the median height [px] of the people in a view."""
    if view.pixels is None:
        return np.nan
    y = view.pixels[..., 1]
    here = np.isfinite(y).sum(-1) >= 3
    if not here.any():
        return np.nan
    return float(np.median(np.nanmax(y[here], axis=-1) - np.nanmin(y[here], axis=-1)))


def _capped_median(values: list[float]) -> float:
    """Return the median, capped for a record: 1e6 stands for invisible points."""
    return float(min(np.sort(values)[len(values) // 2], 1e6))


_POINTS: Final = 8
"""Minimum number of points of a body: their mean has a third of the error of each."""
_BODIES: Final = 1500
"""Maximum number of sampled bodies."""


def find_frame_offset(
    source: PointSource, view: View, settings: CheckSettings
) -> tuple[Fault, float] | None:
    """Return the frame offset that explains a source and a view, and the remaining error share.

    Args:
        source: 3D points.
        view: a camera with 2D of the same people.
        settings: thresholds for an explanation, here for the errors of whole bodies.
    """
    if view.pixels is None or view.pixels.shape[1] != source.points.shape[1]:
        return None
    shared = [name for name in view.skeleton if name in source.skeleton]
    seen = view.pixels[:, :, [view.skeleton.index(name) for name in shared]]
    points = source.points[:, :, [source.skeleton.index(name) for name in shared]]
    known = np.isfinite(seen).all(-1).sum(-1) >= _POINTS
    frame, person = np.nonzero(known[: len(points)])
    if not len(frame):
        return None
    picked = np.unique(np.linspace(0, len(frame) - 1, _BODIES).round().astype(np.int64))
    frame, person = frame[picked], person[picked]
    shipped = _error(points, view, seen, frame, person, None)
    best, least = None, shipped
    for fault in frame_faults(moving=len(view.rows.rotation) > 1):
        error = _error(points, view, seen, frame, person, fault)
        if error < least - 1e-9:
            best, least = fault, error
    if best is None or shipped - least <= settings.min_gain_px:
        return None
    return (best, least / shipped) if least < settings.max_share_left * shipped else None


def _error(
    points: Floats,
    view: View,
    seen: Floats,
    frame: NDArray[np.int64],
    person: NDArray[np.int64],
    fault: Fault | None,
) -> float:
    """Return the median length [px] of bodies' median residuals; infinite without bodies."""
    there = frame + (0 if fault is None else fault.later_points)
    row = frame + (0 if fault is None else fault.later_camera)
    moving = len(view.rows.rotation) > 1
    within = (there >= 0) & (there < len(points))
    if moving:
        within &= (row >= 0) & (row < len(view.rows.rotation))
    camera = view.rows.camera()
    camera = camera[row[within]] if moving else camera[0]
    pixels = camera.project(points[there[within], person[within]])
    away = pixels - seen[frame[within], person[within]]
    enough = np.isfinite(away).all(-1).sum(-1) >= _POINTS
    if not enough.any():
        return np.inf
    middle = np.nanmedian(away[enough], axis=1)
    return float(np.median(np.linalg.norm(middle, axis=-1)))
