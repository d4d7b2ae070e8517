"""Calibration of key frames: each alone, then all with one center and principal point."""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass

import numpy as np

from data_contracts.arrays import Floats, Image, Integers
from data_contracts.broadcast_calibration import KeyFrame
from data_contracts.keypoints import KeypointDetections
from data_contracts.match import Side
from data_contracts.static_calibration import DrawnMarking
from worldpose.broadcast_calibration.clip_problem import ClipProblem, TermWeights
from worldpose.broadcast_calibration.evidence import (
    CLICK,
    FlowEvidence,
    PointEvidence,
    join_evidence,
    whiten_across,
    whiten_points,
)
from worldpose.broadcast_calibration.line_evidence import FieldSamples, find_lines
from worldpose.broadcast_calibration.moving_camera import MovingCamera, join_cameras
from worldpose.broadcast_calibration.pitch_errors import PitchErrors
from worldpose.broadcast_calibration.priors import build_prior
from worldpose.broadcast_calibration.settings import BroadcastCalibrationSettings
from worldpose.broadcast_calibration.solver import solve
from worldpose.errors import DegenerateError, InputError
from worldpose.geometry.cameras import Camera
from worldpose.pitch.template import PitchTemplate
from worldpose.static_calibration.estimate import calibrate_camera
from worldpose.static_calibration.from_paint.proposal import propose_camera
from worldpose.static_calibration.parameters import CameraEstimate
from worldpose.static_calibration.report import StaticCalibration
from worldpose.static_calibration.residuals import nearest_on_markings
from worldpose.static_calibration.sides import (
    INDEPENDENT_S,
    MIN_EVIDENCE,
    SeenPeople,
    compare_sides,
    tells_side,
)
from worldpose.tracking.plane.feet import locate_feet


@dataclass(frozen=True, eq=False)
class KnownPeople:
    """People detected in a clip, and where cameras with known sides see them.

    Attributes:
        detections: (frames, detections) of the clip.
        xy: (frames, people, 2) places of the same people on the pitch [m], world; NaN where
            missing.
        fps: frames per second.
        first: number of the clip's first frame in its video.
    """

    detections: KeypointDetections
    xy: Floats
    fps: float
    first: int = 0


def propose_key_frames(
    pictures: Iterable[tuple[int, Image]],
    pitch: PitchTemplate,
    *,
    side: Side | None,
    where: str,
    people: KnownPeople | None = None,
) -> list[KeyFrame]:
    """Return key frames proposed from images of a clip, without a click.

    Only clear proposals count, and only those that agree on the center with most of the others.
    Images (height, width, 3) RGB have numbers of frames. If `side` of the camera is None, people of
    known places decide it; else they confirm it. InputError if fewer than two frames have a clear
    proposal with one center, or people do not decide the side, or contradict the stated one.
    """
    min_proposals = 2
    clear, seen = [], 0
    for number, picture in pictures:
        seen += 1
        with suppress(InputError):  # a frame without a pitch, or with too little paint
            place = f"{where}: frame {number}"
            proposal = propose_camera(picture, pitch, side=side or "near", where=place)
            if proposal.is_clear:
                clear.append((number, proposal))
    centers = np.array([each.camera.center for _, each in clear]).reshape(-1, 3)
    middle = np.median(centers, axis=0) if len(clear) else np.zeros(3)
    # From one frame alone the distance trades with the focal length.
    reach = 0.1 * float(np.linalg.norm(middle))
    agreed = np.linalg.norm(centers - middle, axis=1) <= reach
    if np.count_nonzero(agreed) < max(min_proposals, len(clear) // 2 + 1):
        raise InputError(
            where,
            expected=f"{min_proposals} frames or more whose markings show one camera position",
            found=f"{len(clear)} clear frames of {seen}, {np.count_nonzero(agreed)} with one "
            "position",
            todo="Click four or more named points in three frames of the clip.",
        )
    chosen = {
        number: proposal for (number, proposal), kept in zip(clear, agreed, strict=True) if kept
    }
    cameras = {number: each.camera for number, each in chosen.items()}
    if must_turn(cameras, pitch, side, people, where):
        chosen = {number: each.turn() for number, each in chosen.items()}
    return [KeyFrame(frame=number, markings=each.drawn) for number, each in chosen.items()]


def must_turn(
    cameras: Mapping[int, Camera],
    pitch: PitchTemplate,
    side: Side | None,
    people: KnownPeople | None,
    where: str,
) -> bool:
    """Return whether the people stand where they are only after half a turn of the cameras.

    InputError if the people do not decide the side that is not stated, or contradict a stated one,
    which camera data state, too.
    """
    same, turned = (0.0, 0.0) if people is None else _compare_people(cameras, pitch, people)
    if side is None and abs(same - turned) < MIN_EVIDENCE:
        raise InputError(
            where,
            expected="people of the static cameras in the clip, who decide the camera's side",
            found=f"no agreement that decides between two sides (evidence "
            f"{abs(same - turned):.0f}, {MIN_EVIDENCE:g} needed)",
            todo="State the broadcast camera's side (near, far, left, right) in match.yaml.",
        )
    if side is not None and turned - same >= MIN_EVIDENCE:
        raise InputError(
            where,
            expected="people at the places where the static cameras see them",
            found="agreement only after half a turn about the centre spot: the stated side is "
            "wrong, or that of the static cameras",
            todo="State the opposite side in match.yaml, take `side` out of this camera, or turn "
            "its camera data.",
        )
    return side is None and turned > same


def _compare_people(
    cameras: Mapping[int, Camera], pitch: PitchTemplate, people: KnownPeople
) -> tuple[float, float]:
    """Return how well people agree if the cameras stand as assumed, and after half a turn."""
    place_std = 0.1  # of people's places by static cameras [m]
    total = np.zeros(2)
    for number, camera in cameras.items():
        here = slice(number - people.first, number - people.first + 1)
        found = KeypointDetections.stack([people.detections[here]])
        feet = locate_feet(Camera.stack([camera]), found, pitch)
        places = people.xy[here]
        noise = np.broadcast_to(place_std**2 * np.eye(2), (*places.shape, 2))
        total += compare_sides(
            SeenPeople(camera, feet.xy[:, 0], feet.noise[:, 0]),
            SeenPeople(None, places, noise),
            pitch,
            np.zeros(1),
        )
    # Frames closer together than this show the people at the same places.
    moments = 1.0 + (max(cameras) - min(cameras)) / people.fps / INDEPENDENT_S
    same, turned = min(1.0, moments / len(cameras)) * total
    return float(same), float(turned)


@dataclass(frozen=True, eq=False)
class Keys:
    """Key frames with one center.

    Attributes:
        frames: (k,) indices in the clip, from 0, rising.
        camera: cameras (k,).
        surface: (2,) crown and end fall of the pitch that they show [m].
        clicks: evidence of points and drawn markings; `frame` counts key frames.
        refused: unusable frames and the reasons.
        wrong: names of outliers among clicks and markings, by frame.
    """

    frames: Integers
    camera: MovingCamera
    surface: Floats
    clicks: PointEvidence
    refused: Mapping[int, str]
    wrong: Mapping[int, tuple[str, ...]]


def calibrate_keys(
    pitch: PitchTemplate,
    key_frames: Sequence[KeyFrame],
    image_size: tuple[int, int],
    pictures: Mapping[int, Image],
    settings: BroadcastCalibrationSettings,
    where: str,
    first: int = 0,
) -> Keys:
    """Return the key frames' cameras with one center and principal point.

    The images (height, width) are grey; frames without one use their clicks alone. Key frames have
    the numbers of the video, whose frame `first` is the clip's first. InputError, with the reason
    for each, if no key frame is usable.
    """
    clicked = {key.frame - first: key for key in sorted(key_frames, key=lambda each: each.frame)}
    found, refused = _calibrate_each(pitch, clicked, image_size, settings, where)
    wrong = {frame: each.report.wrong for frame, each in found.items() if each.report.wrong}
    estimates = [each.estimate for each in found.values()]
    camera = _share_center(estimates)
    errors = PitchErrors.of(pitch, settings)
    surface = pitch.surface
    clicks = PointEvidence.none()
    for _ in range(3):
        samples = FieldSamples.of(pitch, errors, surface)
        parts, lines = [], []
        for index, frame in enumerate(found):
            single = camera.frames(slice(index, index + 1))
            parts.append(
                _click_evidence(
                    pitch,
                    clicked[frame],
                    index,
                    single,
                    found[frame].report.wrong,
                    settings,
                    errors,
                )
            )
            if frame in pictures:
                seen = find_lines(single, samples, pictures[frame], None, settings)[0]
                lines.append(seen.in_frame(index))
        clicks = join_evidence(parts)
        problem = ClipProblem(
            points=join_evidence([clicks, *lines]),
            flow=FlowEvidence.none(),
            prior=build_prior(settings.prior, camera.focal, camera.image_size),
            weights=TermWeights(field=settings.field_weight),
        )
        solution = solve(camera, problem, settings.max_iterations)
        camera = solution.camera
        shown = problem.of_size(solution.paint_offsets)
        surface = pitch.surface + (errors.size_m * shown)[2:]
    return Keys(np.array(list(found)), camera, surface, clicks, refused, wrong)


def _calibrate_each(
    pitch: PitchTemplate,
    clicked: Mapping[int, KeyFrame],
    image_size: tuple[int, int],
    settings: BroadcastCalibrationSettings,
    where: str,
) -> tuple[dict[int, StaticCalibration], dict[int, str]]:
    """Return each key frame's camera from its clicks alone, and why others have none, by frame.

    Where clicks do not tell the side of the pitch, other key frames do, or else the prior.
    """
    found: dict[int, StaticCalibration] = {}
    refused: dict[int, str] = {}
    prior = settings.prior
    near: Floats | None = None  # nearer than its own deviation, a mean tells no side
    if np.hypot(*prior.center_m[:2]) > max(prior.center_std_m[:2]):
        near = np.array(prior.center_m)

    def tells_no_side(frame: int) -> bool:
        markings = clicked[frame].markings
        names = [*(each.name for each in markings.points), *(each.name for each in markings.drawn)]
        return not any(map(tells_side, names))

    for frame in sorted(clicked, key=tells_no_side):
        key = clicked[frame]
        if found:
            near = np.median([each.estimate.camera.center for each in found.values()], axis=0)
        try:
            found[frame] = calibrate_camera(
                pitch,
                key.markings,
                image_size,
                settings=settings.key_frame,
                where=f"{where}: frame {key.frame}",
                start=near,
            )
        except (InputError, DegenerateError) as error:
            refused[frame] = f"{error}"
    if not found:
        raise InputError(
            where,
            expected="a key frame that determines a camera",
            found="; ".join(refused.values()) or "no key frame",
            todo="Click points in frames that show an area's corners or the centre circle.",
        )
    return dict(sorted(found.items())), refused


def _share_center(estimates: Sequence[CameraEstimate]) -> MovingCamera:
    """Return cameras with the covariance-weighted mean of centers and principal points."""
    information, right = np.zeros((5, 5)), np.zeros(5)
    for estimate in estimates:
        camera = estimate.camera
        rotation = camera.cam_from_world.rotation
        # The center moves by -R^T d with a step's shift d.
        by_step = np.zeros((5, 12))
        by_step[:3, 3:6] = -rotation.T
        by_step[3:, 7:9] = np.eye(2)
        own = np.linalg.inv(by_step @ estimate.covariance @ by_step.T)
        information += own
        right += own @ np.concatenate([camera.center, camera.principal_point])
    shared = np.linalg.solve(information, right)
    parts = []
    for estimate in estimates:
        camera = estimate.camera
        batch = type(camera).stack([camera])
        single = MovingCamera.of(batch, shared[:3], shared[3:])
        parts.append(_keep_aim(single, camera.center, camera.principal_point))
    return join_cameras(parts)


def _keep_aim(camera: MovingCamera, center: Floats, principal_point: Floats) -> MovingCamera:
    """Return a single frame with rotation and focal length changed to show the same ground."""
    before = camera.rotation[0]
    ray = np.append((camera.image_size - 1.0 - 2.0 * principal_point) / 2.0 / camera.focal[0], 1.0)
    down = before.T @ ray
    # A camera that does not look down shows no ground; assume a distant aim.
    reach = -center[2] / down[2] if down[2] < -0.02 else 100.0
    aim = center + reach * down
    old, new = aim - center, aim - camera.center
    off = np.append(
        (camera.image_size - 1.0 - 2.0 * camera.principal_point) / 2.0 / camera.focal[0], 1.0
    )
    turned = _rotation_between(before.T @ off, new)
    zoom = np.linalg.norm(new) / np.linalg.norm(old)
    return MovingCamera(
        camera.center,
        camera.principal_point,
        (before @ turned.T)[None],
        camera.focal * zoom,
        camera.distortion,
        camera.image_size,
    )


def _rotation_between(one: Floats, other: Floats) -> Floats:
    """Return the shortest rotation (3, 3) from one direction to another."""
    a, b = one / np.linalg.norm(one), other / np.linalg.norm(other)
    axis, cos = np.cross(a, b), float(a @ b)
    cross = np.array([[0.0, -axis[2], axis[1]], [axis[2], 0.0, -axis[0]], [-axis[1], axis[0], 0.0]])
    return np.asarray(np.eye(3) + cross + cross @ cross / (1.0 + cos))


def _click_evidence(
    pitch: PitchTemplate,
    key: KeyFrame,
    index: int,
    camera: MovingCamera,
    wrong: Sequence[str],
    settings: BroadcastCalibrationSettings,
    errors: PitchErrors,
) -> PointEvidence:
    """Return the evidence of one key frame's clicks without outliers."""
    points = [point for point in key.markings.points if point.name not in wrong]
    template = {name: number for number, name in enumerate(pitch.points)}
    own = np.array([[template[point.name], -1] for point in points], dtype=np.int64).reshape(-1, 2)
    at_points = PointEvidence.observe(
        CLICK,
        np.full(len(points), index),
        pitch.positions([point.name for point in points]),
        np.array([point.xy for point in points]).reshape(-1, 2),
        whiten_points(np.full(len(points), settings.click_noise_px)),
        loss=settings.loss_scale,
    )
    at_points = errors.apply(at_points, own, np.ones(own.shape))
    drawn = [
        _drawn_evidence(pitch, marking, index, camera, settings, errors)
        for marking in key.markings.drawn
        if marking.name not in wrong
    ]
    return join_evidence([at_points, *drawn])


def _drawn_evidence(
    pitch: PitchTemplate,
    marking: DrawnMarking,
    index: int,
    camera: MovingCamera,
    settings: BroadcastCalibrationSettings,
    errors: PitchErrors,
) -> PointEvidence:
    """Return the evidence of a drawn marking: its pixels, across the nearest place on it."""
    pixels = np.array(marking.xy).reshape(-1, 2)
    samples = pitch.marking_points(marking.name, settings.key_frame.sample_spacing_m)
    place, normal = np.empty((len(pixels), 3)), np.empty((len(pixels), 2))
    nearest_on_markings(
        camera.camera[0].numbers,
        0.5 * float(np.hypot(*camera.image_size)),
        samples,
        np.array([0, len(samples)]),
        pixels,
        np.zeros(len(pixels), dtype=np.int64),
        place,
        normal,
    )
    known = np.isfinite(place).all(axis=-1)
    pixels, place, normal = pixels[known], place[known], normal[known]
    names, shares = _locate_on_marking(pitch, marking.name, place)
    points = list(pitch.points)
    ends = np.tile([points.index(name) for name in names], (len(pixels), 1))
    seen = PointEvidence.observe(
        CLICK,
        np.full(len(pixels), index),
        place,
        pixels,
        whiten_across(normal, np.full(len(pixels), settings.key_frame.drawn_noise_px)),
        loss=settings.loss_scale,
    )
    return errors.apply(seen, ends, shares)


def _locate_on_marking(
    pitch: PitchTemplate, marking: str, places: Floats
) -> tuple[tuple[str, str], Floats]:
    """Return the two points that define a marking, and their shares (n, 2) of places on it."""
    if marking in pitch.arcs:
        center = pitch.arcs[marking].center
        return (center, center), np.tile([1.0, 0.0], (len(places), 1))
    line = {**pitch.lines, **pitch.goals, **pitch.unpainted}[marking]
    start, way = pitch.points[line.start], pitch.points[line.end] - pitch.points[line.start]
    share = np.clip((places - start) @ way / (way @ way), 0.0, 1.0)
    return (line.start, line.end), np.stack([1.0 - share, share], axis=-1)
