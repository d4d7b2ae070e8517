"""Errors of estimated cameras: parameter, ground and reprojection errors."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np
from pydantic import Field

from data_contracts.arrays import Floats
from data_contracts.evaluation import CameraErrors, CameraEvaluation
from data_contracts.records import Record
from worldpose.errors import InputError
from worldpose.geometry.cameras import Camera
from worldpose.geometry.rays import Rays
from worldpose.pitch.template import PitchTemplate


class CameraErrorSettings(Record):
    """Grid of test points for camera errors."""

    spacing_m: float = Field(default=2.5, ge=1e-6, le=1000)
    """Spacing of the grid over the pitch [m]: some 1200 points, of which a tight broadcast frame
    shows about a hundred."""
    player_height_m: float = Field(default=1.0, ge=1e-6, le=100)
    """Height above the surface of the points for the reprojection error [m]: a player's middle,
    since cameras that are accurate on the grass can be wrong above it."""


class CameraScore(Record):
    """Errors of one camera, over all its frames."""

    camera_id: str
    kind: str
    """`broadcast` if the true camera has several rows, else `static`."""
    errors: CameraErrors


@dataclass(frozen=True, eq=False)
class CameraSamples:
    """Individual errors of one camera, the input of its metrics."""

    center: Floats
    """(frames,) distance of the centres [m]; here and below, NaN without an estimate."""
    rotation: Floats
    """(frames,) angle between the orientations [rad]."""
    focal: Floats
    """(frames,) error over true focal length, mean of x and y [1]."""
    ground: Floats
    """(points,) on the pitch surface [m], of all frames."""
    reprojection: Floats
    """(points,) at player height [px], of all frames."""


def evaluate_cameras(
    estimated: Mapping[str, Camera],
    true: Mapping[str, Camera],
    pitch: PitchTemplate | None,
    settings: CameraErrorSettings | None = None,
) -> tuple[CameraEvaluation | None, tuple[CameraScore, ...]]:
    """Return errors of all static and all broadcast cameras, and of each camera.

    Cameras are single or batches (frames,), by id; ids that only one side has are skipped. Without
    a pitch there are neither ground nor reprojection errors. InputError for other numbers of
    frames.
    """
    settings = settings or CameraErrorSettings()
    names = [name for name in true if name in estimated]
    if not names:
        return None, ()
    samples = {
        name: camera_samples(name, estimated[name], true[name], pitch, settings) for name in names
    }
    kinds = {name: "broadcast" if _frames(true[name]) > 1 else "static" for name in names}
    cameras = tuple(
        CameraScore(camera_id=name, kind=kinds[name], errors=_figures([samples[name]]))
        for name in names
    )
    groups = {
        kind: _figures([samples[name] for name in names if kinds[name] == kind])
        for kind in sorted(set(kinds.values()))
    }
    return CameraEvaluation(**groups), cameras


def camera_samples(
    name: str,
    estimated: Camera,
    true: Camera,
    pitch: PitchTemplate | None,
    settings: CameraErrorSettings,
) -> CameraSamples:
    """Return the errors of one camera per frame and per point that the true camera sees.

    Each camera is single, or a batch (frames,); the estimated one is NaN in frames without an
    estimate. Without a pitch there are no points. The name of the camera or clip is for messages.
    InputError if the cameras have different numbers of frames.
    """
    frames = max(_frames(estimated), _frames(true))
    if {_frames(estimated), _frames(true)} - {1, frames}:
        raise InputError(
            f"camera {name}",
            expected=f"{_frames(true)} frames, as the true camera has",
            found=f"{_frames(estimated)}",
            todo="Evaluate the clip that the reference belongs to.",
        )
    center = np.linalg.norm(estimated.center - true.center, axis=-1)
    turn = estimated.cam_from_world @ true.cam_from_world.inverse()
    focal = np.abs(estimated.focal / true.focal - 1.0).mean(-1)
    known = np.isfinite(center) & np.isfinite(focal)
    angle = np.where(known, _angle(turn.rotation), np.nan)
    ground: list[Floats] = []
    reprojection: list[Floats] = []
    if pitch is not None:
        surface, raised = _points(pitch, settings)
        reach = float(np.hypot(pitch.length, pitch.width))
        for frame in np.flatnonzero(np.atleast_1d(known)):
            one, exact = _at(estimated, int(frame)), _at(true, int(frame))
            # A point that the estimated camera misses is off by the pitch, or by the image.
            seen, pixels = _select_visible(exact, surface)
            away = surface_points(one.unproject(pixels), pitch) - seen
            ground.append(_capped_lengths(away, reach))
            seen, pixels = _select_visible(exact, raised)
            diagonal = float(np.linalg.norm(exact.image_size))
            reprojection.append(_capped_lengths(one.project(seen) - pixels, diagonal))
    return CameraSamples(
        center=np.broadcast_to(np.where(known, center, np.nan), (frames,)),
        rotation=np.broadcast_to(angle, (frames,)),
        focal=np.broadcast_to(np.where(known, focal, np.nan), (frames,)),
        ground=np.concatenate([*ground, np.empty(0)]),
        reprojection=np.concatenate([*reprojection, np.empty(0)]),
    )


def surface_points(rays: Rays, pitch: PitchTemplate) -> Floats:
    """Return the first intersections of rays from above with the pitch surface (..., 3) [m], world.

    NaN if a ray is missing or passes above the horizon. The surface goes on beyond the touch lines.
    """
    newton_steps = 8  # each step squares the error; the surface is within 0.2 m of the start plane
    origins, directions = rays.origins, rays.directions

    def height(along: Floats) -> Floats:
        """Return the height of the rays above the surface [m]."""
        points = origins + along[..., None] * directions
        return np.asarray(points[..., 2] - pitch.height(points[..., 0], points[..., 1]))

    down = directions[..., 2] < 0.0
    with np.errstate(divide="ignore", invalid="ignore", over="ignore"):
        # The surface lies below z = 0 and curves away, so Newton's steps never pass it.
        along = np.where(down, -origins[..., 2] / directions[..., 2], np.nan)
        for _ in range(newton_steps):
            along = along - height(along) / (height(along + 0.5) - height(along - 0.5))
        # A tenth of a millimetre: points that have not converged by now never will.
        met = (along > 0.0) & (np.abs(height(along)) < 1e-4)
        return np.where(met[..., None], origins + along[..., None] * directions, np.nan)


def _capped_lengths(vectors: Floats, most: float) -> Floats:
    """Return the lengths of vectors; at most, and for a missing vector, `most`."""
    lengths = np.linalg.norm(vectors, axis=-1)
    return np.minimum(np.where(np.isnan(lengths), most, lengths), most)


def _select_visible(camera: Camera, points: Floats) -> tuple[Floats, Floats]:
    """Return the points inside the camera's image, and their pixels."""
    pixels = camera.project(points)
    with np.errstate(invalid="ignore"):
        inside = ((pixels >= -0.5) & (pixels <= camera.image_size - 0.5)).all(-1)
    return points[inside], pixels[inside]


def _points(pitch: PitchTemplate, settings: CameraErrorSettings) -> tuple[Floats, Floats]:
    """Return a grid (n, 3) on the surface, and the same grid at player height [m]."""
    along, across = (
        np.linspace(-0.5 * side, 0.5 * side, int(np.ceil(side / settings.spacing_m)) + 1)
        for side in (pitch.length, pitch.width)
    )
    x, y = (values.ravel() for values in np.meshgrid(along, across, indexing="ij"))
    surface = np.stack([x, y, pitch.height(x, y)], axis=-1)
    return surface, surface + np.array([0.0, 0.0, settings.player_height_m])


def _figures(samples: Sequence[CameraSamples]) -> CameraErrors:
    """Return the metrics over all frames and points of some cameras."""
    center, rotation, focal, ground, reprojection = (
        np.concatenate([getattr(each, name) for each in samples])
        for name in ("center", "rotation", "focal", "ground", "reprojection")
    )
    known = np.isfinite(center)
    figures: dict[str, float] = {}
    if known.any():
        figures["center_error_m"] = float(center[known].mean())
        figures["rotation_error_deg"] = float(np.degrees(rotation[known].mean()))
        figures["focal_error_percent"] = float(100.0 * focal[known].mean())
    if len(ground):
        figures["ground_error_median_m"] = float(np.median(ground))
        figures["ground_error_p95_m"] = float(np.percentile(ground, 95.0))
    if len(reprojection):
        figures["reprojection_error_median_px"] = float(np.median(reprojection))
        figures["reprojection_error_p95_px"] = float(np.percentile(reprojection, 95.0))
    return CameraErrors(cameras=len(samples), coverage=float(known.mean()), **figures)


def _angle(rotation: Floats) -> Floats:
    """Return the angle of rotation matrices (...) [rad], accurate also for small angles."""
    trace = np.trace(rotation, axis1=-2, axis2=-1)
    skew = rotation - np.swapaxes(rotation, -1, -2)
    # The skew part's norm is 2 sqrt(2) sin(angle), the trace 1 + 2 cos(angle).
    sine = np.linalg.norm(skew, axis=(-1, -2)) / np.sqrt(2.0)
    return np.asarray(np.arctan2(sine, trace - 1.0))


def _frames(camera: Camera) -> int:
    return int(np.prod(camera.batch_shape))


def _at(camera: Camera, frame: int) -> Camera:
    """Return the camera of one frame; a static camera is the same in all frames."""
    if not camera.batch_shape:
        return camera
    return camera[frame if _frames(camera) > 1 else 0]
