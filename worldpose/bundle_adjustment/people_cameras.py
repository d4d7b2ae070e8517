"""Static cameras from the people who walk through their views, without any marking.

The first poses are those of `people_views`; bundle adjustment with free joints follows. A person's
stature or the distance of two cameras gives the scale, and the feet and the bodies of those who
walk give the vertical.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np

from data_contracts.arrays import Floats, Integers
from data_contracts.cameras import LensCalibration
from data_contracts.keypoints import KeypointDetections
from worldpose.bundle_adjustment.clip import Observations
from worldpose.bundle_adjustment.people_views import (
    JOINTS,
    LOSS_SCALE,
    Start,
    Views,
    adjust_poses,
    find_walkers,
    refusal,
)
from worldpose.bundle_adjustment.residuals import (
    AdjustmentSolution,
    KeypointNoise,
    estimate_noise,
    keypoint_information,
    player_residuals,
)
from worldpose.bundle_adjustment.uncertainty import relative_covariance
from worldpose.errors import InputError
from worldpose.geometry.cameras import Camera
from worldpose.static_calibration.boards import image_coverage
from worldpose.triangulation.noise_model import PERSONAL
from worldpose.triangulation.world import Walkers, move_cameras


@dataclass(frozen=True, eq=False)
class CamerasFromPeople:
    """Cameras by the people in their views, with what tells how good they are.

    The world has its origin on the ground below the people, z up, and x along the way that most of
    them walk.

    Attributes:
        cameras: (cameras,) batch.
        std: (cameras, 3) standard deviation of position [m], orientation [rad] and the logarithm of
            the focal length [1], relative to the other cameras and the people.
        scale_std: relative standard deviation of all lengths [1].
        up_std: standard deviation of the vertical, the larger of two axes [rad].
        on_feet: whether standing feet determine the vertical; else people are assumed upright.
        stature_m: median stature of the people by the limbs [m].
        people: number of people [1].
        keypoints: (cameras,) keypoints used [1].
        residual_px: (cameras,) median distance of a keypoint from its joint [px].
        held_out_px: (cameras,) the same in frames that are left out of the adjustment; NaN where
            half of the frames do not determine the cameras.
        coverage: (cameras,) share of a grid of 8 x 8 fields of the image that has keypoints [1].
        noise: scale and correlation of the keypoints' errors, relative to `NOISE`.
    """

    cameras: Camera
    std: Floats
    scale_std: float
    up_std: float
    on_feet: bool
    stature_m: float
    people: int
    keypoints: Integers
    residual_px: Floats
    held_out_px: Floats
    coverage: Floats
    noise: KeypointNoise


class KnownLength(NamedTuple):
    """A measured length, which gives the scale."""

    length_m: float
    """Stature of the people, or distance of the two cameras [m]."""
    cameras: tuple[int, int] | None = None
    """The two cameras; None = stature."""
    std_m: float = 0.01
    """Standard deviation of the length [m]."""


def locate_cameras(
    lenses: Sequence[LensCalibration],
    detections: KeypointDetections,
    fps: float,
    known: KnownLength,
) -> CamerasFromPeople:
    """Return static cameras by the 2D poses of people who walk, all in one metric world.

    Focal length and principal point of each lens are adjusted within their deviations; where the
    focal length is known to 10 % or less, several are tried. Detections (frames, cameras,
    detections) are in memory, before tracking, on a common clock; `known` gives the scale. The
    relative pose is by the five-point algorithm (Nister, IEEE PAMI 26(6), 2004).

    InputError for fewer than two cameras, people who stand still, two cameras that show no person
    together for long enough, or people who do not determine a camera, which the error names.
    """
    max_std = 0.1  # by the distance from the people
    names = [lens.id for lens in lenses]
    if len(names) < 2 or detections.confidence.shape[1:2] != (len(names),):
        raise refusal(names, "two cameras or more, each with 2D poses", f"{len(names)} with a lens")
    tracks = find_walkers(detections, fps, names)
    start = _search(lenses, tracks)
    frames = start.observed.frame_of
    adjusted, observed, noise = _adjust_with_noise(start, lenses)
    relative = _relative_std(adjusted, observed)
    distance = np.linalg.norm(adjusted.cameras.center - np.median(observed.points, axis=0), axis=1)
    for name, std, far in zip(names, relative[:, 0], distance, strict=True):
        if not std <= max_std * far:
            raise refusal(
                [name],
                f"people who determine its position within {100 * max_std:.0f} % of their distance",
                f"{100 * std / far:.0f} %",
            )
    people = _walkers(observed, detections.frame if len(detections.frame) else None, fps)
    scale, scale_std = _scale(people, adjusted.cameras, known)
    world, vertical_std, on_feet = people.orient(scale)
    shown = [observed.image[observed.camera_of == c] for c in range(len(names))]
    std = relative * [scale, 1.0, 1.0]
    off = np.linalg.norm(player_residuals(adjusted.cameras, observed.points, observed), axis=1)
    return CamerasFromPeople(
        cameras=move_cameras(world, adjusted.cameras),
        std=std,
        scale_std=scale_std,
        # A rig that is bent tilts the vertical, too.
        up_std=float(np.hypot(vertical_std, np.median(std[:, 1]))),
        on_feet=on_feet,
        stature_m=scale * float(np.median(people.statures())),
        people=len(np.unique(observed.person_of)),
        keypoints=np.bincount(observed.camera_of, minlength=len(names)),
        residual_px=_by_camera(off, observed.camera_of, len(names)),
        held_out_px=_held_out(adjusted, observed, lenses, noise, frames),
        coverage=np.array(list(map(image_coverage, shown, adjusted.cameras.image_size))),
        noise=noise,
    )


def _search(lenses: Sequence[LensCalibration], tracks: list[list[Floats]]) -> Start:
    """Return the first poses that explain most keypoints best."""
    unknown = [one.focal_std_px > 0.1 * one.focal_px for one in lenses]
    found: list[tuple[float, int, Start]] = []
    errors: list[InputError] = []
    for factor in (1.0, 0.7, 1.4, 2.0, 0.5) if any(unknown) else (1.0,):
        tried = [
            one.model_copy(update={"focal_px": factor * one.focal_px}) if free else one
            for one, free in zip(lenses, unknown, strict=True)
        ]
        try:
            starts = Views(tried, tracks).starts()
        except InputError as error:
            errors.append(error)
            continue
        for start in starts:
            rough = adjust_poses(start.cameras, start.observed, tried, KeypointNoise())
            count = len(start.observed.image)
            adjusted = start.observed._replace(points=rough.points)
            found.append((rough.cost / count, count, Start(rough.cameras, adjusted)))
    if not found:
        raise errors[0]
    most = max(count for _, count, _ in found)
    enough = [one for one in found if one[1] >= 0.8 * most]
    return min(enough, key=lambda one: one[0])[2]


def _adjust_with_noise(
    start: Start, lenses: Sequence[LensCalibration]
) -> tuple[AdjustmentSolution, Observations, KeypointNoise]:
    """Return the adjustment with the noise that the keypoints have."""
    cameras, observed, noise = start.cameras, start.observed, KeypointNoise()
    for _ in range(3):
        adjusted = adjust_poses(cameras, observed, lenses, noise)
        observed = observed._replace(points=adjusted.points)
        noise = estimate_noise(adjusted.cameras, adjusted.points, observed, LOSS_SCALE)
    try:
        adjusted = adjust_poses(cameras, observed, lenses, noise, covariance=True)
    except InputError as error:
        names = [lens.id for lens in lenses]
        raise refusal(names, "people who determine the cameras", error.found) from error
    return adjusted, observed, noise


def _relative_std(adjusted: AdjustmentSolution, observed: Observations) -> Floats:
    """Return the deviations (cameras, 3) of position, orientation and focal length.

    Relative to all cameras and people together: no keypoint tells their common place and size.
    """
    information = keypoint_information(adjusted.cameras, observed._replace(points=adjusted.points))
    origin = np.median(adjusted.points, axis=0)
    own, _ = relative_covariance(adjusted.camera_covariance, adjusted.cameras, information, origin)
    variance = np.diagonal(own, axis1=1, axis2=2)
    parts = [variance[:, 3:6].sum(axis=1), variance[:, :3].sum(axis=1), variance[:, 6]]
    return np.asarray(np.sqrt(np.stack(parts, axis=1)))


def _by_camera(off: Floats, camera_of: Integers, count: int) -> Floats:
    """Return the median of each camera (cameras,); NaN without any."""
    parts = [off[camera_of == c] for c in range(count)]
    return np.array([np.median(part) if len(part) else np.nan for part in parts])


def _held_out(
    adjusted: AdjustmentSolution,
    observed: Observations,
    lenses: Sequence[LensCalibration],
    noise: KeypointNoise,
    frames: Integers,
) -> Floats:
    """Return median distances (cameras,) in frames by cameras of the other frames [px].

    Joints of the held-out frames come from all cameras, which are not adjusted to them.
    """
    intervals = 2  # of time, each held out once
    count = len(lenses)
    edges = np.quantile(np.unique(frames), np.linspace(0.0, 1.0, intervals + 1)[1:-1])
    group = np.searchsorted(edges, frames, side="right")
    off, camera_of = [], []
    observed = observed._replace(points=adjusted.points)
    for held in range(intervals):
        try:
            other, judged = observed.select(group != held), observed.select(group == held)
            cameras = adjust_poses(adjusted.cameras, other, lenses, noise).cameras
            joints = adjust_poses(cameras, judged, lenses, noise, fixed=True)
        except InputError:
            return np.full(count, np.nan)
        off.append(np.linalg.norm(player_residuals(joints.cameras, joints.points, judged), axis=1))
        camera_of.append(judged.camera_of)
    return _by_camera(np.concatenate(off), np.concatenate(camera_of), count)


def _walkers(observed: Observations, frame: Integers | None, fps: float) -> Walkers:
    """Return the people of adjusted observations, in the unit of the adjustment."""
    rows, row_of = np.unique(observed.frame_of, return_inverse=True)
    persons = int(observed.person_of.max()) + 1
    joints = np.full((len(rows), persons, 17, 3), np.nan)
    joints[row_of, observed.person_of, JOINTS[observed.joint_of]] = observed.points[
        observed.point_of
    ]
    return Walkers(joints, rows if frame is None else frame[rows], fps)


def _scale(people: Walkers, cameras: Camera, known: KnownLength) -> tuple[float, float]:
    """Return metres per unit and their relative deviation."""
    if known.cameras is not None:
        a, b = known.cameras
        apart = float(np.linalg.norm(cameras.center[a] - cameras.center[b]))
        return known.length_m / apart, known.std_m / known.length_m
    statures = people.statures()
    return known.length_m / float(np.median(statures)), float(
        np.hypot(PERSONAL, known.std_m / known.length_m) / np.sqrt(len(statures))
    )
