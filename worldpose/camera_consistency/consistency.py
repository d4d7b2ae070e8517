"""Check of a rig's cameras for faults, from the people that they detect, and its explanation."""

from __future__ import annotations

import itertools
import math
from collections.abc import Sequence

import numpy as np

from data_contracts.arrays import ClipArray, Floats
from data_contracts.camera_consistency import CameraFault
from data_contracts.keypoints import KeypointDetections
from worldpose.camera_consistency.comparison import MIN_JOINTS, Comparison
from worldpose.camera_consistency.diagnosis import Consistency, Diagnosis, Fault
from worldpose.camera_consistency.hypotheses import OFF_AXIS
from worldpose.camera_consistency.settings import ConsistencySettings
from worldpose.geometry.cameras import Camera
from worldpose.ingest.clock import offset_change
from worldpose.static_calibration.parameters import project_with_jacobian
from worldpose.tracking.diagnosis import match_pair, usable_rays
from worldpose.tracking.ray_matching import require_clip


def check_consistency(
    cameras: Camera,
    covariance: Floats | None,
    detections: KeypointDetections[ClipArray],
    fps: float,
    settings: ConsistencySettings,
    *,
    ground: bool = True,
) -> Consistency:
    """Return the inconsistent cameras, and the most probable fault of each.

    The agreement of two cameras is the number of their detections that meet in 3D, one to one,
    above chance. The largest group of cameras in agreement counts as correct. Every other camera,
    and those of the group in partial agreement, are tested against hypotheses that each correct the
    camera's calibration, images or clock. The fault is the one whose correction clearly increases
    matches, in frames that it was not fitted to.

    Cameras (cameras,) have covariances (cameras, 12, 12) of a step; NaN or None for given cameras.
    Of detections (frames, cameras, detections), a confidence of 0 or less excludes a keypoint, only
    its sign counts. On the ground, people stand on z = 0; else they may be anywhere. InputError for
    shapes that do not fit together.
    """
    min_focal_error = 0.03  # of the logarithm
    given_tilt = 0.003  # largest plausible rotation error of a given camera [rad]
    require_clip("camera consistency", cameras, detections)
    keypoints, confidence = detections.keypoints, detections.confidence
    count = int(cameras.batch_shape[0])
    part = select_busiest_frames(confidence, settings.max_chunk_frames)
    points = np.array(keypoints[part], dtype=np.float64)
    points[~(np.asarray(confidence[part]) > 0.0)] = np.nan
    if count < 2 or not len(points):
        return Consistency((), (), tuple(range(count)), np.zeros((count, count)))
    given, tilt = np.ones(count, dtype=np.bool_), np.full(count, given_tilt)
    focal_error, noise = np.full(count, min_focal_error), np.full(count, settings.pixel_noise_px)
    if covariance is not None:
        known = [bool(np.isfinite(each).all()) for each in covariance]
        given = np.logical_not(known)
        for c in (place for place in range(count) if known[place]):
            deviation = np.sqrt(np.diagonal(covariance[c]))
            tilt[c] = max(given_tilt, 3.0 * float(deviation[:3].max()))
            focal_error[c] = max(min_focal_error, 4.0 * float(deviation[6]))
            noise[c] = math.hypot(noise[c], _calibration_noise(cameras[c], covariance[c]))
    comparison = Comparison(cameras, noise, points, ground, settings)
    comparison.fit_noise()
    found = Diagnosis(comparison, fps, given, tilt, focal_error).run()
    return _judge_most(cameras, found, comparison.people_seen, detections[part])


def _judge_most(
    cameras: Camera, found: Consistency, seen: Floats, detections: KeypointDetections
) -> Consistency:
    """Return the result without faults of single cameras if most cameras fit no other one.

    A correction that lets a camera agree with others speaks for them. Else their calibration is
    another match's, where people meet by chance alone, or their world has another unit or axis, in
    which people still lie on each other's epipolar lines.
    """
    share = found.agreement / np.maximum(1.0, np.minimum(seen[:, None], seen))
    judged = np.flatnonzero(seen >= 0.5)
    explained = {fault.camera for fault in found.faults if (fault.share_corrected or 0.0) > 0.5}
    weak = [c for c in judged if share[c].max() < 0.35 and c not in explained]
    if len(judged) < 3 or 2 * len(weak) <= len(judged):
        return found
    rays = usable_rays(cameras, detections, MIN_JOINTS)
    answers: list[set[bool | None]] = [set() for _ in seen]
    for pair in itertools.combinations(judged.tolist(), 2):
        answer = _do_agree(cameras, rays, pair)
        for c in pair:
            answers[c].add(answer)
    alone = tuple(c for c in judged.tolist() if False in answers[c] and True not in answers[c])
    every = tuple(range(len(seen)))
    return Consistency(
        (), (), every, found.agreement, alone if 2 * len(alone) > len(judged) else ()
    )


def _do_agree(cameras: Camera, rays: Floats, pair: tuple[int, int]) -> bool | None:
    """Return whether people of two cameras meet more often than by chance; None if none can tell.

    By chance they meet at other moments of the clip too. Cameras share a part of their views, so
    that few can meet at all. From low cameras, or where people stand still, chance is high and
    tells nothing.
    """
    tells = 0.06  # share by chance below which it tells [1]
    least = 0.05  # of a clear difference between shares [1]
    now = match_pair(cameras, rays, pair, 0, MIN_JOINTS)
    shifts = (len(rays) * np.array([-3, -2, -1, 1, 2, 3])) // 6
    chance = [match_pair(cameras, rays, pair, s, MIN_JOINTS).share for s in shifts.tolist()]
    above = now.share - np.mean(chance) > max(least, 3.0 * float(np.std(chance)))
    if now.agrees or (above and now.count >= 4):
        return True
    return None if np.mean(chance) > tells else False


def select_busiest_frames(confidence: ClipArray, longest: int) -> slice:
    """Return the chunk of frames, of at most `longest`, with the most detections."""
    frames = confidence.shape[0]
    if frames <= longest:
        return slice(0, frames)
    starts = np.linspace(0, frames - longest, 8).astype(int)
    middles = [int(start) + longest // 2 for start in starts]
    counts = [np.count_nonzero(np.asarray(confidence[m : m + 1]) > 0.0) for m in middles]
    start = int(starts[int(np.argmax(counts))])
    return slice(start, start + longest)


def _calibration_noise(camera: Camera, covariance: Floats) -> float:
    """Return the standard deviation of people's image positions due to the calibration [px]."""
    size = camera.image_size
    grid = np.stack(np.meshgrid(*(s * np.array([0.2, 0.5, 0.8]) for s in size)), -1).reshape(-1, 2)
    rays = camera.unproject(grid)
    with np.errstate(divide="ignore", invalid="ignore"):
        way = (1.0 - rays.origins[:, 2]) / rays.directions[:, 2]
    hit = np.isfinite(way) & (way > 0.0) & (way < 200.0)
    if not hit.any():
        return 0.0
    points = rays.origins[hit] + way[hit, None] * rays.directions[hit]
    _, jacobian = project_with_jacobian(camera, points)
    variance = np.einsum("nij,jk,nik->n", jacobian, covariance, jacobian) / 2.0
    return float(np.sqrt(np.nanmedian(variance)))


def faulty_cameras(found: Consistency) -> set[int]:
    """Return the indices of cameras with a known fault.

    If two cameras contradict each other, it is unknown which one is wrong.
    """
    return {fault.camera for fault in found.faults if fault.kind != "contradiction"}


def describe_faults(
    found: Consistency,
    cameras: Sequence[str],
    offset_frames: Sequence[int | None],
    rates: Floats,
    fps: float,
) -> tuple[CameraFault, ...]:
    """Return the faults with the cameras' names and a reason that says what to do.

    `offset_frames` is the stated offset of each camera's video [frame], None if it changes; `rates`
    (cameras,) are frames of it per match frame.
    """
    return tuple(
        CameraFault(
            camera=cameras[fault.camera],
            kind=fault.kind,
            reason=_reason(fault, cameras, offset_frames[fault.camera], rates[fault.camera], fps),
            value=fault.value,
            other=None if fault.other is None else cameras[fault.other],
            share_now=fault.share_now,
            share_corrected=fault.share_corrected,
        )
        for fault in found.faults
    )


def _reason(
    fault: Fault, cameras: Sequence[str], offset: int | None, rate: float, fps: float
) -> str:
    """Return one sentence: the fault, the correction, and the share of detections in support."""
    other = "" if fault.other is None else cameras[fault.other]
    if fault.kind == "contradiction":
        source = "" if fault.source is None else cameras[fault.source]
        cause = _cause(fault, fault.cause or "pose", fault.detail, source, offset, rate, fps)
        return (
            f"it contradicts camera {other}, and no majority tells which of them is wrong. "
            f"They agree if this holds for camera {cameras[fault.camera]}: {cause}"
        )
    said = _cause(fault, fault.kind, fault.detail, other, offset, rate, fps)
    if fault.share_corrected:
        said += (
            f". With that corrected, the other cameras agree about {fault.share_corrected:.0%} of "
            f"the people in its images, now about {fault.share_now:.0%}"
        )
    return said


def _cause(
    fault: Fault, kind: str, detail: str, other: str, offset: int | None, rate: float, fps: float
) -> str:
    """Return the fault and its correction in words."""
    value = fault.value or 1.0
    if detail == OFF_AXIS:
        return f"{OFF_AXIS}: calibrate it again"
    if kind == "clock":
        late = "later" if value < 0 else "earlier"
        change = round(float(offset_change(-value, rate)))
        todo = (
            f"add {change} to its clock offset"
            if offset is None
            else f"set its clock offset to {offset + change}"
        )
        late = f"it shows {abs(value):.0f} match frames {late} than the others"
        return f"{late}: {todo} (offset_frames in match.yaml)"
    if kind == "frame_rate":
        return (
            f"its video has about {value * fps * rate:.3g} frames per second, not "
            f"{fps * rate:g}: convert it, or correct its frame numbers"
        )
    return {
        "flipped": "its calibration is turned by half a turn about the centre spot: its clicks "
        "have the names of the other end, or its side is stated wrongly",
        "mirrored": f"it is mirrored: {detail}. Correct its clicks, calibration or images",
        "focal": f"its focal length (zoom) is {value:.3g} times that which the people show: "
        "correct its calibration",
        "lens": f"the distortion of its lens is wrong: {detail}. worldpose reads k1 k2 p1 p2 k3, "
        "and k1 to k4 of a lens that the file calls a fisheye",
        "swapped": f"its video is that of camera {other}: exchange the two files",
        "duplicate": f"its video is the same as that of camera {other}: give its own",
        "pose": f"its calibration is wrong: {detail}"
        if detail
        else "it does not show people where the other cameras see them: check its calibration, "
        "clock and video",
    }[kind]
