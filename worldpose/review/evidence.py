"""Evidence for a reviewer: open detections, metrics per frame, other views, calibration preview.

Other views check a correction in one image against all: the epipolar curve contains the
possible pixels of a keypoint in another camera, the prediction is its pixel if the other keypoints
are correct. The preview shows the pitch as clicks calibrate it, and proposes next clicks.
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from dataclasses import dataclass
from functools import cached_property

import numpy as np
from numpy.typing import ArrayLike, NDArray

from data_contracts.arrays import Floats, find_runs
from data_contracts.cameras import LensCalibration
from data_contracts.match import Side
from data_contracts.review import Acceptance
from data_contracts.static_calibration import ClickedMarkings
from worldpose.geometry.cameras import Camera
from worldpose.geometry.rays import Rays, intersect_rays
from worldpose.pitch.template import PitchTemplate
from worldpose.review.detections import DetectionEdit
from worldpose.static_calibration.estimate import calibrate_camera
from worldpose.static_calibration.report import CalibrationReport
from worldpose.static_calibration.settings import StaticCalibrationSettings
from worldpose.static_calibration.sides import place_at


@dataclass(frozen=True, eq=False)
class OpenDetections:
    """Detections without acceptance or correction, by rising confidence.

    Attributes:
        frame: (n,) match frames.
        detection: (n,) indices of the detections in the frame.
        score: (n,) the detector's confidence [1].
        people: number of all detections, reviewed or not.
    """

    frame: NDArray[np.int64]
    detection: NDArray[np.int64]
    score: NDArray[np.float64]
    people: int


def open_detections(
    frame: NDArray[np.int64],
    score: NDArray[np.floating],
    acceptances: Iterable[Acceptance],
    edits: Iterable[DetectionEdit],
) -> OpenDetections:
    """Return the detections of one camera's result that await review.

    Match frames (frames,) rise without gaps; scores (frames, detections) are without corrections,
    NaN = no detection. Acceptances are of this result; a corrected detection counts as reviewed.
    """
    there = np.isfinite(score)
    waits = there.copy()
    first = int(frame[0]) if len(frame) else 0
    looked_at = [(edit.frame, edit.detection) for edit in edits]
    for acceptance in acceptances:
        looked_at += acceptance.people
        if acceptance.at_least is not None:
            # The store has scores in single precision, and a person enters the displayed value.
            waits &= ~(score >= np.float32(acceptance.at_least))
    for number, detection in looked_at:
        row = number - first
        if 0 <= row < score.shape[0] and 0 <= detection < score.shape[1]:
            waits[row, detection] = False
    rows, places = np.nonzero(waits)
    values = score[rows, places].astype(np.float64)
    order = np.argsort(values, kind="stable")
    return OpenDetections(
        frame=frame[rows[order]],
        detection=places[order].astype(np.int64),
        score=values[order],
        people=int(np.count_nonzero(there)),
    )


@dataclass(frozen=True, eq=False)
class Curve:
    """One metric over a clip's frames: a title with unit, values (frames,), NaN where undefined."""

    title: str
    values: Floats


def clip_curves(
    bodies: Floats, covariance: Floats, filled: NDArray[np.bool_], placed: Floats
) -> tuple[Curve, ...]:
    """Return the number of people and their uncertainty per frame.

    Keypoints (frames, persons, 17, 3) of bodies [m], world, NaN = no body, have a covariance
    (frames, persons, 17, 3, 3) [m^2]; `filled` (frames, persons) are from the motion model alone.
    `placed` are triangulated joints of the same shape [m], NaN where missing.
    """
    there = np.isfinite(bodies).all(axis=-1)
    people = there.any(axis=-1)
    variance = np.einsum("...ii", covariance) / 3.0
    square = ((bodies - placed) ** 2).sum(axis=-1) / 3.0
    measured = np.isfinite(square)
    total = np.where(measured, square, 0.0).sum(axis=(1, 2))
    count = measured.sum(axis=(1, 2))
    with np.errstate(invalid="ignore", divide="ignore"):
        apart = np.sqrt(total / count)
        share = (filled & people).sum(axis=1) / people.sum(axis=1)
    return (
        Curve("people", people.sum(axis=1).astype(np.float64)),
        Curve("share filled by motion alone [1]", share),
        Curve("standard deviation of a joint along an axis, median [m]", _medians(variance) ** 0.5),
        Curve("bodies from the joints that cameras placed, rms along an axis [m]", apart),
    )


def _medians(values: Floats) -> Floats:
    """Return the median of finite values per frame; NaN without any."""
    found = np.full(len(values), np.nan)
    for frame, row in enumerate(values):
        there = row[np.isfinite(row)]
        if len(there):
            found[frame] = np.median(there)
    return found


@dataclass(frozen=True, eq=False)
class ViewCheck:
    """Multi-view consistency of one person's keypoints.

    Attributes:
        joints: (joints, 3) [m], world: triangulated from all views; NaN with fewer than two.
        expected: (cameras, joints, 2) [px]: prediction in each camera of the joint triangulated
            from the others; NaN with fewer than two others.
        error: (cameras, joints) [px]: from each keypoint to the joint from all views.
    """

    joints: Floats
    expected: Floats
    error: Floats


def epipolar_curves(source: Camera, target: Camera, pixel: ArrayLike) -> list[Floats]:
    """Return the epipolar curves in `target` of a pixel (2,) [px] in `source`, single cameras.

    The function projects the part of the pixel's ray where joints can be into the other image, with
    lens distortion, and clips it to the image. They are polylines (n, 2) [px]; none if the ray is
    not visible.
    """
    edge_halvings = 12  # bisections to the border of the image: 12 px become 0.003 px
    halvings = 8  # maximum number of subdivisions
    # Maximum spacing of a curve's points [px]: arc and chord differ by less than a hundredth
    # of a pixel in a lens that bends a line by 10 px over 400.
    max_spacing_px = 12.0
    initial_samples = 33  # initial samples along a ray
    rays = source.unproject(np.asarray(pixel, dtype=np.float64)[None])
    span = _span(rays)
    if span is None:
        return []
    origin, direction = rays.origins[0], rays.directions[0]

    def project_along(along: Floats) -> Floats:
        return target.project(origin + along[:, None] * direction)

    def is_inside(places: Floats) -> NDArray[np.bool_]:
        return _is_in_or_near(places, target.image_size, 0.0)

    along = np.linspace(span[0], span[1], initial_samples)
    places = project_along(along)
    for _ in range(halvings):
        gap = np.linalg.norm(np.diff(places, axis=0), axis=1)
        inside = is_inside(places)
        wide = np.flatnonzero((gap > max_spacing_px) & (inside[1:] | inside[:-1]))
        # One end may be behind the camera, or outside the valid range of its lens model.
        cut = np.flatnonzero(np.isfinite(places[1:, 0]) != np.isfinite(places[:-1, 0]))
        halved = np.union1d(wide, cut)
        if not len(halved):
            break
        middle = (along[halved] + along[halved + 1]) / 2
        along = np.insert(along, halved + 1, middle)
        places = np.insert(places, halved + 1, project_along(middle), axis=0)
    # The last point within the image, found by bisection: else a curve ends up to 12 px too early.
    inside = is_inside(places)
    edges = np.flatnonzero(inside[1:] != inside[:-1])
    inner = np.where(inside[edges], along[edges], along[edges + 1])
    outer = np.where(inside[edges], along[edges + 1], along[edges])
    for _ in range(edge_halvings):
        middle = (inner + outer) / 2
        is_seen = is_inside(project_along(middle))
        inner, outer = np.where(is_seen, middle, inner), np.where(is_seen, outer, middle)
    moved = ~np.isin(inner, along)
    places = np.insert(places, edges[moved] + 1, project_along(inner[moved]), axis=0)
    return _runs(places, is_inside(places))


def check_views(cameras: Camera, keypoints: ArrayLike) -> ViewCheck:
    """Return the multi-view consistency of one person in one frame of cameras (cameras,).

    A joint is the nearest point to its rays, with weights from the size of a pixel at its distance.
    Keypoints are (cameras, joints, 2) [px]; NaN where not seen.
    """
    places = np.asarray(keypoints, dtype=np.float64)
    rays = cameras.unproject(places)
    count = len(places)
    joints = _joints(cameras, rays, np.ones((1, count)))[0]
    without = _joints(cameras, rays, 1.0 - np.eye(count))
    expected = cameras.project(without)
    error = np.linalg.norm(cameras.project(np.broadcast_to(joints, without.shape)) - places, axis=2)
    return ViewCheck(joints, expected, error)


def _joints(cameras: Camera, rays: Rays, chosen: Floats) -> Floats:
    """Return joints (choices, joints, 3) [m] from the cameras of each choice (choices, cameras)."""
    origins = np.broadcast_to(rays.origins, rays.directions.shape).swapaxes(0, 1)
    share = np.broadcast_to(chosen[:, None, :], (len(chosen), *origins.shape[:2]))
    many = Rays(
        origins=np.broadcast_to(origins, (*share.shape, 3)),
        directions=np.broadcast_to(rays.directions.swapaxes(0, 1), (*share.shape, 3)),
        status=np.broadcast_to(rays.status.swapaxes(0, 1), share.shape),
    )
    near, _ = intersect_rays(many, share)
    distance = np.linalg.norm(near[..., None, :] - cameras.center, axis=-1)
    with np.errstate(divide="ignore", invalid="ignore"):
        weight = share * (cameras.focal.mean(axis=-1) / distance) ** 2
    return intersect_rays(many, np.nan_to_num(weight, posinf=0.0))[0]


def _span(rays: Rays) -> tuple[float, float] | None:
    """Return the interval of possible joints along the ray [m]; None if empty."""
    camera_distances_m = (0.5, 300.0)  # to people: across the largest stadium
    # Range of joint heights above the ground [m]: the ground may be lower at its edges, and
    # arms are raised in a jump.
    joint_heights_m = (-0.3, 3.2)
    if not rays.valid[0]:
        return None
    height, slope = float(rays.origins[0, 2]), float(rays.directions[0, 2])
    low, high = joint_heights_m
    if abs(slope) < 1e-9:
        return camera_distances_m if low <= height <= high else None
    ends = sorted(((low - height) / slope, (high - height) / slope))
    span = max(ends[0], camera_distances_m[0]), min(ends[1], camera_distances_m[1])
    return span if span[0] < span[1] else None


@dataclass(frozen=True, eq=False)
class PitchDrawing:
    """A pitch, the stadium's template, with cached sample points for repeated drawing."""

    template: PitchTemplate

    @cached_property
    def markings(self) -> dict[str, NDArray[np.float64]]:
        """Points (n, 3) [m], world, along every marking, by name."""
        marking_spacing_m = 0.5  # chords of a curved marking are a few pixels long
        names = self.template.marking_names
        return {name: self.template.marking_points(name, marking_spacing_m) for name in names}

    @cached_property
    def points(self) -> NDArray[np.float64]:
        """The named points (n, 3) [m], world."""
        return self.template.positions(tuple(self.template.points))

    def project_markings(self, camera: Camera) -> dict[str, list[NDArray[np.float64]]]:
        """Return polylines (n, 2) [px] of every marking in or near the image, by name."""
        stacked = camera.project(np.concatenate(list(self.markings.values())))
        found, begin = {}, 0
        # Margin beyond the image for drawn markings, relative to its size [1]: far outside,
        # unconstrained distortion may fold them back.
        margin = 0.25
        for name, points in self.markings.items():
            end = begin + len(points)
            near = _is_in_or_near(stacked[begin:end], camera.image_size, margin)
            pieces = _runs(stacked[begin:end], near)
            begin = end
            if pieces:
                found[name] = pieces
        return found

    def project_points(self, camera: Camera) -> dict[str, NDArray[np.float64]]:
        """Return the projections of the named points inside the image (2,) [px], by name."""
        pixels = camera.project(self.points)
        inside = _is_in_or_near(pixels, camera.image_size, 0.0)
        names = self.template.points
        return {name: pixels[k] for k, name in enumerate(names) if inside[k]}


@dataclass(frozen=True, eq=False)
class Preview:
    """Camera, its report, and the pitch projected from the current clicks.

    Markings are polylines (n, 2) [px], points (2,) [px], by name.
    """

    camera: Camera
    report: CalibrationReport
    markings: Mapping[str, list[NDArray[np.float64]]]
    points: Mapping[str, NDArray[np.float64]]


def preview(
    drawing: PitchDrawing,
    clicked: ClickedMarkings,
    image_size: tuple[int, int],
    *,
    picture: NDArray[np.uint8] | None = None,
    settings: StaticCalibrationSettings = StaticCalibrationSettings(),  # noqa: B008
    lens: LensCalibration | None = None,
    side: Side | None = None,
) -> Preview:
    """Return the camera from the current clicks, and the projected pitch.

    With the image (height, width, 3), the calibration refines the camera on the painted lines,
    which takes seconds and not milliseconds. InputError says which clicks to add if they do not
    determine a camera.
    """
    found = calibrate_camera(
        drawing.template,
        clicked,
        image_size,
        picture=picture,
        settings=settings,
        where="so far",
        lens=lens,
        start=side and place_at(side),
    )
    camera = found.estimate.camera
    return Preview(
        camera, found.report, drawing.project_markings(camera), drawing.project_points(camera)
    )


def _runs(points: NDArray[np.float64], chosen: NDArray[np.bool_]) -> list[NDArray[np.float64]]:
    """Return the runs of two or more chosen points in a row."""
    return [points[run] for run in find_runs(chosen) if run.stop - run.start > 1]


def _is_in_or_near(
    pixels: NDArray[np.float64], image_size: NDArray[np.int64], margin: float
) -> NDArray[np.bool_]:
    """Return a mask (n,) of pixels (n, 2) in the image or within a margin relative to its size."""
    room = margin * np.asarray(image_size)
    with np.errstate(invalid="ignore"):
        inside = (pixels >= -0.5 - room) & (pixels <= image_size - 0.5 + room)
    return np.asarray(inside.all(axis=1))
