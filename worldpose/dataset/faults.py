"""Repairs of broken conventions in a data set, each with the name of its fault."""

from __future__ import annotations

import itertools
from collections.abc import Callable, Iterable, Iterator
from dataclasses import dataclass, replace
from typing import Final, NamedTuple

import numpy as np

from data_contracts.arrays import Flags, Floats, Integers
from data_contracts.release import Finding
from worldpose.dataset.contents import CameraView, PointSource, sample_evenly
from worldpose.formats.release_cameras import CameraRows
from worldpose.geometry.cameras import Camera

LATEST: Final = 3
"""Maximum frame offset that is tested [frame]."""
_LENS: Final = "k1 k2 p1 p2 k3"


class Limits(NamedTuple):
    """Thresholds beyond which a fault is reported."""

    max_sample: int = 3000
    """Maximum number of 2D points per camera to test faults: their median is accurate to a few
    percent."""
    max_error: float = 0.06
    """Tolerated median reprojection error [height of a person in the image]: detected keypoints
    are within it; a broken convention exceeds it or has an explanation."""
    max_share_left: float = 0.7
    """A fault is named if its repair leaves at most this share of the median error [1]."""
    min_gain_px: float = 0.3
    """And removes at least this much [px]: rounded pixels must not cause a fault."""
    max_error_left: float = 0.2
    """And leaves at most this [height of a person in the image]: random data has no explanation."""
    min_ground_m: float = -0.4
    """Minimum median height of the lower foot [m]: a pitch falls by 0.2 m to its edges, and fits
    sink by some centimetres."""
    max_ground_m: float = 0.13
    """Maximum median height of the lower foot [m]: heels and toes are some cm above the ground."""
    bounds_m: tuple[float, float] = (65.0, 46.0)
    """Maximum |x| and |y| of people [m]: the pitch of 105 x 68 m and 12 m around it."""
    min_plausible_share: float = 0.9
    """Minimum share of bodies near the ground, head up, within the bounds [1]."""
    max_speed_m_s: float = 13.0
    """Maximum speed of a person's hips [m/s]; the fastest sprinters reach 12.4."""
    max_fast_share: float = 0.002
    """Tolerated share of faster steps [1]: noise of a single frame at 50 frames/s."""
    bones_m: tuple[float, float] = (0.15, 0.62)
    """Minimum and maximum length of a person's upper arm, forearm, thigh and shin [m]."""
    max_center_drift_m: float = 0.05
    """Maximum distance of a moving camera's centre from its median [m]: the release's cameras
    rotate and zoom, and never translate."""
    max_rotation_error: float = 1e-4
    """Largest element of R'R - 1 [1]: files in single precision stay far below."""
    min_visible_share: float = 0.02
    """Minimum share of people that a camera must show in some frame [1]."""


LIMITS: Final = Limits()


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

    def posed(
        name: str, says: str, pose: Callable[[Floats, Floats], tuple[Floats, Floats]]
    ) -> Fault:
        def repair(rows: CameraRows) -> CameraRows:
            rotation, translation = pose(rows.rotation, rows.translation)
            return replace(rows, rotation=rotation, translation=translation)

        return Fault(name, says, camera=repair)

    yield posed(
        "transposed_rotation",
        "R is world_from_cam, the transpose of what x_cam = R x_world + t has",
        lambda r, t: (_transpose(r), t),
    )
    yield posed(
        "translation_is_center",
        "t is the camera's centre C and not -R C",
        lambda r, t: (r, -_turn_vectors(r, t)),
    )
    yield posed(
        "camera_to_world",
        "R and t are world_from_cam: the transpose of R, and the centre for t",
        lambda r, t: (_transpose(r), -_turn_vectors(_transpose(r), t)),
    )
    yield posed("negated_translation", "t has the wrong sign", lambda r, t: (r, -t))
    yield posed(
        "camera_in_millimetres",
        "t is in millimetres and not in metres",
        lambda r, t: (r, t / 1000.0),
    )
    for order in ("k1 k2 k3 p1 p2", "p1 p2 k1 k2 k3", "k1 k2 p2 p1 k3"):
        says = f"k is {order} and not OpenCV's {_LENS}"
        yield Fault("distortion_order", says, camera=_lens_in(order))


def frame_faults(moving: bool) -> Iterator[Fault]:
    """Yield faults of frame alignment; only a moving camera has its own clock."""
    name = "frame_offset"
    for late in sorted({*range(-LATEST, LATEST + 1)} - {0}, key=abs):
        said = f"{abs(late)} frame{'s' if abs(late) > 1 else ''} {'late' if late > 0 else 'early'}"
        yield Fault(name, f"the 3D is {said} against the 2D", later_points=late)
        if moving:
            yield Fault(name, f"the camera is {said}", later_camera=late)
            says = f"the 3D and the camera are {said} against the 2D"
            yield Fault(name, says, later_points=late, later_camera=late)


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
    for whole, suffix in ((True, ""), (False, ", in transl alone")):
        for _, shipped_from_world in axis_orders():
            name, says = _axis_name(shipped_from_world)
            yield Fault(name, f"{says}{suffix}", _turn(shipped_from_world, whole))


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
    return lambda rows: replace(rows, distortion=rows.distortion[:, place])


def _transpose(rotation: Floats) -> Floats:
    return np.swapaxes(rotation, -1, -2)


def _turn_vectors(rotation: Floats, vectors: Floats) -> Floats:
    return np.asarray((rotation @ vectors[..., None])[..., 0])


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

    frame: Integers
    person: Integers
    point: Integers
    pixels: Floats


def compare_view(source: PointSource, view: CameraView) -> Agreement | None:
    """Return the residuals between a source and a view, and the fault that explains them best.

    A fault is named if its repair removes most of the error; a 2D point that the camera cannot see
    has infinite error. Frame offsets are also searched with whole bodies. None if source and view
    have no points in common.
    """
    sample = _sample(source, view, LIMITS.max_sample)
    if sample is None:
        return None
    errors = _errors(source.points, view.rows, sample, SOUND)
    shipped = _median(errors)
    best, least = SOUND, shipped
    for fault in (*camera_faults(), *frame_faults(view.is_moving), *point_faults()):
        if shipped < LIMITS.min_gain_px:
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
    explains = shipped - least > LIMITS.min_gain_px and least < LIMITS.max_share_left * shipped
    explains = explains and least <= LIMITS.max_error_left * height
    if not explains and np.isfinite(shipped) and shipped > LIMITS.min_gain_px:
        found = find_frame_offset(source, view)
        if found is not None:
            explains, best = True, found
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


def agreement_findings(found: Iterable[Agreement]) -> Iterator[Finding]:
    """Yield findings, one per fault of a source, with the cameras that show it."""
    named: dict[tuple[str, str, str], list[Agreement]] = {}
    unexplained = (
        "the projected 3D points differ from the 2D points, and no known convention explains it"
    )
    for one in found:
        if one.fault is not SOUND:
            named.setdefault((one.source, one.fault.name, one.fault.says), []).append(one)
        elif one.median_px > LIMITS.max_error * one.height_px:
            named.setdefault((one.source, "reprojection", unexplained), []).append(one)
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


def _sample(source: PointSource, view: CameraView, size: int) -> _Sample | None:
    """Sample 2D points evenly from those that the source also has."""
    shared = view.shared_points(source)
    if shared is None:
        return None
    pixels, in_source = shared
    count = min(len(pixels), len(source.points))
    pixels = pixels[:count]
    known = np.all(np.isfinite(pixels), axis=-1)
    known &= np.all(np.isfinite(source.points[:count][:, :, in_source]), axis=-1)
    if view.is_moving:
        rows = np.all(np.isfinite(view.rows.rotation), axis=(-1, -2))[:count]
        known[: len(rows)] &= rows[:, None, None]
        known[len(rows) :] = False
    frame, person, joint = np.nonzero(known)
    if not len(frame):
        return None
    picked = sample_evenly(len(frame), size)
    frame, person, joint = frame[picked], person[picked], joint[picked]
    return _Sample(frame, person, in_source[joint], pixels[frame, person, joint])


def _later(
    frame: Integers, count: int, rows: CameraRows, fault: Fault
) -> tuple[Flags, Integers, Camera]:
    """Return which frames remain when a fault shifts them, their 3D frames, and the camera there.

    The camera is a batch if it moves.
    """
    there, row = frame + fault.later_points, frame + fault.later_camera
    moving = len(rows.rotation) > 1
    within = (there >= 0) & (there < count)
    if moving:
        within &= (row >= 0) & (row < len(rows.rotation))
    camera: Camera = rows.camera()
    return within, there[within], camera[row[within]] if moving else camera[0]


def _errors(points: Floats, rows: CameraRows, sample: _Sample, fault: Fault) -> Floats:
    """Return residuals (n,) [px] between projected points and 2D; infinite for invisible points."""
    within, frame, camera = _later(sample.frame, len(points), rows, fault)
    if not within.any():
        return np.full(1, np.inf)
    here = points[frame, sample.person[within], sample.point[within]]
    pixels = camera.project(here[:, None])[:, 0] if camera.batch_shape else camera.project(here)
    away = np.linalg.norm(pixels - sample.pixels[within], axis=-1)
    errors: Floats = np.where(np.isnan(away), np.inf, away)
    # A person who enters or leaves in between is no evidence.
    return errors[np.isfinite(here).all(-1)] if fault.later_points else errors


def _median(errors: Floats) -> float:
    return float(np.sort(errors)[len(errors) // 2]) if len(errors) else np.inf


def _height(view: CameraView) -> float:
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


def find_frame_offset(source: PointSource, view: CameraView) -> Fault | None:
    """Return the frame offset that explains the errors of whole bodies in a view."""
    shared = view.shared_points(source)
    if shared is None:
        return None
    seen, in_source = shared
    points = source.points[:, :, in_source]
    known = np.isfinite(seen).all(-1).sum(-1) >= _POINTS
    frame, person = np.nonzero(known[: len(points)])
    if not len(frame):
        return None
    # Maximum number of sampled bodies.
    max_bodies = 1500
    picked = sample_evenly(len(frame), max_bodies)
    frame, person = frame[picked], person[picked]

    def error(fault: Fault) -> float:
        """Return the median length [px] of bodies' median residuals; infinite without bodies."""
        within, there, camera = _later(frame, len(points), view.rows, fault)
        pixels = camera.project(points[there, person[within]])
        away = pixels - seen[frame[within], person[within]]
        enough = np.isfinite(away).all(-1).sum(-1) >= _POINTS
        if not enough.any():
            return np.inf
        middle = np.nanmedian(away[enough], axis=1)
        return float(np.median(np.linalg.norm(middle, axis=-1)))

    shipped = least = error(SOUND)
    best = None
    for fault in frame_faults(view.is_moving):
        left = error(fault)
        if left < least - 1e-9:
            best, least = fault, left
    explains = shipped - least > LIMITS.min_gain_px
    return best if explains and least < LIMITS.max_share_left * shipped else None
