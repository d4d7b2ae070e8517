"""Bodies of people that one camera alone sees: monocular poses, placed on the pitch by the feet.

No view determines the distance of such a person. The feet give it, since they stand on the pitch; a
monocular method gives the pose, turned into the world by the calibrated camera; the image's
keypoints correct both across the line of sight. The fit is that of triangulated people with
other evidence: lines of sight, and places on the pitch with their covariance.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, replace
from typing import Final

import numpy as np
from numpy.typing import NDArray

from data_contracts.arrays import Flags, Floats
from data_contracts.conventions import COCO17, COCO17_HIPS
from worldpose.body.jacobian import ChainedKeypoints
from worldpose.body.keypoints import fold_keypoints
from worldpose.body.model import BodyModel
from worldpose.body_fitting.bones import DEFINITION_STD_M, shorten_limbs
from worldpose.body_fitting.evidence import (
    ANKLES,
    JOINT_SPREAD,
    MIN_INFORMATION,
    Ground,
    PersonEvidence,
    ankle_height,
)
from worldpose.body_fitting.monocular import (
    CORRELATION_S,
    PRIOR_SPREAD,
    MonocularEstimates,
    MonocularPoses,
    MonocularPrior,
    place_monocular_poses,
    smooth_poses,
)
from worldpose.body_fitting.pose_space import SIZE, load_pose_prior, nearest_known
from worldpose.body_fitting.poses import PoseSolver, pose_covariance
from worldpose.body_fitting.ray_constraints import constrain_to_rays
from worldpose.body_fitting.residuals import PersonObjective, Pose
from worldpose.body_fitting.results import BodyFit, FittedArrays
from worldpose.body_fitting.settings import BodyFittingSettings
from worldpose.body_fitting.shapes import Piece, Shapes, solve_shapes, spread_intervals
from worldpose.body_fitting.standing import find_standing_distance, stand_on_ground
from worldpose.geometry.cameras import Camera
from worldpose.geometry.rigid import Rigid
from worldpose.tracking.plane.feet import PIXEL_STD
from worldpose.tracking.plane.kalman import CORRELATION_S as PLACE_CORRELATION_S

MIN_KEYPOINTS: Final = 6
"""Minimum keypoints of a frame to judge an estimate [1]."""
MAX_MISFIT: Final = 0.85
"""An estimate whose keypoints miss the detected ones by more contradicts them, after alignment of
position and size [root mean square, relative to that of the keypoints about their middle]. In two
simulated worlds 0.2 to 0.6 with angles off by 8 degrees, up to 0.8 with 15 degrees, 0.9 to 1 for
bodies that lie or stand on their heads."""


@dataclass(frozen=True, eq=False)
class PlaneEvidence:
    """Observations of people by one camera, static or moving, and their places on the pitch.

    Attributes:
        camera: batch (frames,), each with a pose; the focal length is NaN where unknown.
        number: (frames,), numbers of the images in the camera's video, as the estimates have them.
        keypoints: (frames, persons, 17, 2) [px], COCO-17; NaN where not seen.
        confidence: (frames, persons, 17) in (0, 1]; NaN where not seen.
        place: (frames, persons, 2) [m], world, below the mid-hip; NaN where unknown.
        place_covariance: (frames, persons, 2, 2) [m^2].
        calibration: (frames, persons, 2, 2) [m^2], part of it that the camera's calibration causes,
            which all frames share.
        fps: [1/s].
    """

    camera: Camera
    number: NDArray[np.int64]
    keypoints: Floats
    confidence: Floats
    place: Floats
    place_covariance: Floats
    calibration: Floats
    fps: float


@dataclass(frozen=True, eq=False)
class PlaneBodies:
    """Bodies of people on the plane.

    Attributes:
        fit: the bodies, of all persons; NaN for a person or frame without a body.
        placed: (frames, persons, 17, 3) [m], world: joints of the mean body in the monocular pose,
            with its lower ankle on the ground at the person's place; the input of the fit.
        views: (frames, persons, 17), 1 where the image shows the joint of a body.
        missing: (persons,), why a person has no body; None = the person has one.
        misfit: (frames, persons), distance of an estimate from the keypoints, relative to the
            person's size [1]; NaN without an estimate.
    """

    fit: BodyFit
    placed: Floats
    views: NDArray[np.int64]
    missing: tuple[str | None, ...]
    misfit: Floats


def fit_bodies_on_plane(
    model: BodyModel, evidence: PlaneEvidence, estimates: MonocularEstimates, ground: Ground
) -> PlaneBodies:
    """Return the bodies of people that one camera alone sees without triangulation.

    The covariance contains the distance that the feet leave open, the foot's bias over the slope of
    the line of sight, and a lean. Joints in depth are as uncertain as the monocular angles.
    """
    frames, persons = evidence.place.shape[:2]
    # Gauss-Newton steps: a start from monocular poses is farther away than one from joints.
    settings = BodyFittingSettings(steps=10)
    keypoints = fold_keypoints(model, COCO17)
    solver = PoseSolver(ChainedKeypoints.of(keypoints), load_pose_prior(), settings, ground)
    lifted = _lift_keypoints(evidence)
    poses = place_monocular_poses(estimates, evidence.camera, evidence.number, lifted)
    still = np.zeros((frames, 3))
    mean = Pose(still, still, np.zeros((frames, SIZE)), np.zeros(model.shapes))
    placed = np.full((frames, persons, 17, 3), np.nan)
    for person in range(persons):
        known = Rigid(poses.orient[:, person], np.zeros(3))
        pose = replace(mean, orient=known.rotvec, angles=poses.angles[:, person])
        standing = stand_on_ground(solver, pose, evidence.place[:, person])
        placed[:, person] = keypoints(standing.parameters())
    misfit, _ = _misfit(placed, evidence)
    missing = [_find_contradiction(misfit[:, person]) for person in range(persons)]
    clip = _Clip(solver, evidence, lifted, poses, misfit <= MAX_MISFIT)
    people = {
        person: clip.open_person(person) for person in range(persons) if missing[person] is None
    }
    pieces = [piece for person, own in people.items() for piece in clip.sample_pieces(person, own)]
    shapes = solve_shapes(solver, people, pieces, {})
    clip, people = clip.stand(people, shapes)
    result = FittedArrays.empty(model, frames, persons)
    turned = np.full(placed.shape, np.nan)
    for person, own in people.items():
        span = own.span
        start = replace(own.start, betas=shapes.people[person].betas)
        start = stand_on_ground(solver, start, own.place)
        rows = np.arange(span.start, span.stop)
        track = clip.track(person, rows, evidence.fps, for_shape=False)
        pose, solved = solver.search(track, start, shapes.offsets)
        joints, spread = pose_covariance(solved, pose, shapes.offsets)
        bias = np.full(17, DEFINITION_STD_M**2)[:, None, None] * np.eye(3)
        result.put(solver, person, span, pose, (joints, spread + bias), shapes)
        result.covariance[span, person] += clip.depth_covariance(
            person, own, result.joints[span, person]
        )
        result.guided[span, person] = clip.agreeing[span, person]
        result.drop(person, span, own.gone)
        turned[span, person] = clip.turn_round(track, start, shapes.offsets)
    fitted, noise = _misfit(result.joints, evidence)
    other, _ = _misfit(turned, evidence)
    for person in people:
        missing[person] = _judge_fit(
            fitted[:, person] / noise[:, person], other[:, person] / noise[:, person]
        )
        if missing[person] is not None:
            result.betas[person], result.betas_covariance[person] = np.nan, np.nan
            result.drop(person, slice(0, frames), np.ones(frames, dtype=np.bool_))
    body = np.isfinite(result.joints[..., 0, 0])
    seen = np.isfinite(evidence.keypoints).all(axis=-1) & body[..., None]
    result.filled[:] = body & ~seen.any(axis=-1)
    fit = BodyFit.of(result, shapes)
    return PlaneBodies(fit, placed, seen.astype(np.int64), tuple(missing), misfit)


@dataclass(frozen=True, eq=False)
class _Person:
    """A person to fit.

    Attributes:
        span: frames of the person's bodies.
        gone: (frames of `span`,), without a place, or too far from any estimate.
        place: (frames of `span`, 2) [m], without gaps.
        start: monocular poses, smoothed, on the ground at the places.
    """

    span: slice
    gone: Flags
    place: Floats
    start: Pose


@dataclass(frozen=True, eq=False)
class _Clip:
    """PersonEvidence and monocular poses of a clip.

    Attributes:
        solver: body, prior, settings and ground.
        lifted: (frames, persons, 17, 3) [m], keypoints at the distance of the places.
        agreeing: (frames, persons), poses that agree with the keypoints.
    """

    solver: PoseSolver
    evidence: PlaneEvidence
    lifted: Floats
    poses: MonocularPoses
    agreeing: Flags

    def open_person(self, person: int) -> _Person:
        """Return a person's frames, and the poses to start from."""
        fps = self.evidence.fps
        place = self.evidence.place[:, person]
        known, at = np.isfinite(place).all(axis=-1), np.flatnonzero(self.agreeing[:, person])
        frames = np.arange(len(place))
        # Frames farther than this from any monocular pose of the person have no body [s].
        covered = known & (np.abs(frames - nearest_known(at, frames)) <= 0.5 * fps)
        first, last = np.flatnonzero(covered)[[0, -1]]
        span = slice(int(first), int(last) + 1)
        own = frames[span]
        place = np.stack([np.interp(own, frames[known], axis[known]) for axis in place.T], axis=-1)
        # Monocular poses so near in time make a start [s]: single wrong poses drop out.
        orient, angles = smooth_poses(self.poses, person, at, own, 0.2 * fps)
        betas = np.zeros(self.solver.chained.model.shapes)
        start = stand_on_ground(
            self.solver, Pose(np.zeros_like(orient), orient, angles, betas), place
        )
        return _Person(span, ~covered[span], place, start)

    def stand(
        self, people: Mapping[int, _Person], shapes: Shapes
    ) -> tuple[_Clip, dict[int, _Person]]:
        """Return clip and people with places at which the fitted bodies' feet stand.

        The ankles in the image give a place without regard to the pose, and a foot in the air makes
        it too far. Bodies fitted without ground tell how high the feet are at such a place.
        """
        evidence, ground, settings = self.evidence, self.solver.ground, self.solver.settings
        assert ground is not None
        place, covariance = evidence.place.copy(), evidence.place_covariance.copy()
        free, moved = replace(self.solver, ground=None), {}
        for person, own in people.items():
            start = replace(own.start, betas=shapes.people[person].betas)
            start = stand_on_ground(self.solver, start, own.place)
            rows = np.arange(own.span.start, own.span.stop)
            track = self.track(person, rows, evidence.fps, for_shape=False)
            pose, _ = free.search(track, start, shapes.offsets)
            joints = self.solver.chained.place(pose.parameters())
            center = evidence.camera.center[own.span]
            hips = joints[:, COCO17_HIPS, :2].mean(axis=1)
            sight = hips - center[:, :2]
            distance = np.linalg.norm(sight, axis=-1)
            sight /= distance[:, None]
            ankles = joints[:, ANKLES]
            floor = ground(ankles[..., 0], ankles[..., 1])
            height = ankle_height(self.solver.chained.model, pose.betas)
            slope = (center[:, 2] - floor.mean(axis=1)) / distance
            seen = np.asarray(
                np.isfinite(evidence.keypoints[own.span, person][:, ANKLES]).all(axis=-1)
            )
            low = np.where(seen, ankles[..., 2] - floor - height, np.inf).min(axis=1)
            low[~seen.any(axis=1)] = np.nan
            _, given, weight = self._sight(person, rows, evidence.fps)
            given = np.nan_to_num(np.linalg.norm((given - center)[:, :2], axis=-1))
            found, variance = find_standing_distance(
                distance + low / slope, slope, evidence.fps, settings.contact_std_m, given, weight
            )
            new = hips + (found - distance)[:, None] * sight
            moved[person] = replace(own, place=new)
            known = np.isfinite(place[own.span, person, 0])
            place[own.span, person][known] = new[known]
            # Across the line of sight, or without an ankle, it is no surer than the tracked place.
            along = sight[..., :, None] * sight[..., None, :]
            across = np.eye(2) - along
            spread = across @ evidence.place_covariance[own.span, person] @ across
            spread = spread + variance[:, None, None] * along
            known &= seen.any(axis=1)
            covariance[own.span, person][known] = spread[known]
        evidence = replace(evidence, place=place, place_covariance=covariance)
        return replace(self, evidence=evidence, lifted=_lift_keypoints(evidence)), moved

    def track(
        self, person: int, rows: NDArray[np.int64], fps: float, *, for_shape: bool
    ) -> PersonObjective:
        """Return the evidence of a person in some frames, `rows`, at the rate `fps` [1/s].

        For the shape, smoothness and pose prior hardly count, and limbs are shortened by the
        contribution of the keypoints' noise, as those of triangulated people are.
        """
        settings = self.solver.settings
        prior = MonocularPrior(
            self.poses.orient[rows, person],
            self.poses.angles[rows, person],
            self.agreeing[rows, person],
            np.eye(3 + SIZE) / PRIOR_SPREAD**2,
            1.0 + CORRELATION_S * fps,
        )
        return PersonObjective(
            self.solver.chained,
            self._observe(person, rows, fps, shorten=for_shape),
            self.solver.prior,
            settings,
            fps,
            settings.shape_acceleration_m_s2 if for_shape else settings.acceleration_m_s2,
            settings.shape_pose_weight if for_shape else settings.pose_weight(fps),
            monocular_prior=prior,
        )

    def _observe(
        self, person: int, rows: NDArray[np.int64], fps: float, *, shorten: bool
    ) -> PersonEvidence:
        """Return lines of sight of the keypoints, and the distance of the hips by the place."""
        evidence, settings = self.evidence, self.solver.settings
        camera = evidence.camera[rows]
        keypoints, expected = evidence.keypoints[rows, person], self.lifted[rows, person]
        rays = constrain_to_rays(camera, keypoints[:, None], expected[:, None])
        points, across = rays.points[:, 0], rays.across[:, 0]
        reach = np.linalg.norm(points - camera.center[:, None], axis=-1)
        pixel = PIXEL_STD * reach / camera.focal.mean(axis=-1)[:, None]
        variance = (settings.ray_std_m * JOINT_SPREAD) ** 2 + settings.min_joint_std_m**2 + pixel**2
        variance = variance / np.clip(evidence.confidence[rows, person], 1e-3, 1.0)
        seen = np.isfinite(points).all(axis=-1) & np.isfinite(variance)
        variance = np.where(seen, variance, 1.0)
        if shorten:
            points = shorten_limbs(points, across * variance[..., None, None])
        variance *= settings.repeated(fps)
        by_ray = np.where(seen[..., None, None], across / variance[..., None, None], 0.0)

        sight, place, weight = self._sight(person, rows, fps)
        by_place = np.zeros_like(by_ray)
        outer = np.nan_to_num(sight[:, :, None] * sight[:, None])
        # Two hips share the distance.
        by_place[:, COCO17_HIPS] = (0.5 * weight[:, None, None] * outer)[:, None]
        joints = np.where(seen[..., None], points, np.nan)
        hips = joints[:, COCO17_HIPS]
        target = np.broadcast_to(place[:, None], hips.shape)
        hips = np.where(np.isfinite(hips), hips, target)
        information = by_ray + by_place
        moved = np.linalg.solve(
            information[:, COCO17_HIPS] + MIN_INFORMATION * np.eye(3),
            by_place[:, COCO17_HIPS] @ np.nan_to_num(target - hips)[..., None],
        )[..., 0]
        joints[:, COCO17_HIPS] = hips + moved
        information[~np.isfinite(joints).all(axis=-1)] = 0.0
        return PersonEvidence(joints, information)

    def _sight(
        self, person: int, rows: NDArray[np.int64], fps: float
    ) -> tuple[Floats, Floats, Floats]:
        """Return the horizontal directions of sight (rows, 3), places (rows, 3) [m], and weights.

        A weight (rows,) [1/m^2] is the information along the line of sight; 0 without a place.
        """
        xy = self.evidence.place[rows, person]
        assert self.solver.ground is not None
        place = np.concatenate([xy, self.solver.ground(xy[:, 0], xy[:, 1])[:, None]], axis=1)
        sight = place - self.evidence.camera[rows].center
        sight[:, 2] = 0.0
        sight /= np.linalg.norm(sight, axis=-1, keepdims=True)
        covariance = self.evidence.place_covariance[rows, person]
        spread = np.einsum("fa,fab,fb->f", sight[:, :2], covariance, sight[:, :2])
        return sight, place, np.nan_to_num(1.0 / (spread * (1.0 + PLACE_CORRELATION_S * fps)))

    def sample_pieces(self, person: int, own: _Person) -> list[Piece]:
        """Return intervals of a person's track for shape estimation, with initial bodies."""
        settings, fps = self.solver.settings, self.evidence.fps
        stride = max(1, int(fps / settings.shape_rate_hz))
        pieces = []
        for part in spread_intervals(len(own.place), fps, settings):
            rows = np.arange(part.start, part.stop)[::stride]
            track = self.track(person, rows + own.span.start, fps / stride, for_shape=True)
            start = own.start
            pose = Pose(start.transl[rows], start.orient[rows], start.angles[rows], start.betas)
            pieces.append(Piece(person, track, pose))
        return pieces

    def turn_round(self, track: PersonObjective, start: Pose, offsets: Floats) -> Floats:
        """Return joints (frames, 17, 3) [m] of the body fitted to estimates turned half round."""
        assert track.monocular_prior is not None
        half = Rigid.from_rotvec([0.0, np.pi, 0.0], np.zeros(3)).rotation
        prior = replace(track.monocular_prior, orient=track.monocular_prior.orient @ half)
        orient = Rigid.from_rotvec(start.orient, np.zeros(3)).rotation @ half
        pose = replace(start, orient=Rigid(orient, np.zeros(3)).rotvec)
        pose, _ = self.solver.search(replace(track, monocular_prior=prior), pose, offsets)
        return np.asarray(self.solver.chained.place(pose.parameters()))

    def depth_covariance(self, person: int, own: _Person, joints: Floats) -> Floats:
        """Return the covariance (frames, 17, 3, 3) [m^2] that all frames of a person share.

        It is the calibration's, the foot's bias over the slope of the line of sight, and that of a
        lean of the whole body. By the lean, joints (frames, 17, 3) [m], world, in the span's frames
        move along their lines of sight.
        """
        rows = np.arange(own.span.start, own.span.stop)
        sight, place, _ = self._sight(person, rows, self.evidence.fps)
        centers = self.evidence.camera[rows].center
        offset = place - centers
        slope = -offset[:, 2] / np.linalg.norm(offset[:, :2], axis=-1)
        # Error of a foot's height that lasts for a clip [m]: where the detector sees the ankle, and
        # the height of the ankle above the pitch.
        shared = (0.03 / slope)[:, None, None] ** 2 * sight[:, :, None] * sight[:, None]
        shared[:, :2, :2] += self.evidence.calibration[rows, person]
        line = joints - centers[:, None]
        line /= np.linalg.norm(line, axis=-1, keepdims=True)
        # Error of a whole body's lean along the line of sight that lasts for a clip [rad]: 5
        # degrees.
        line *= 0.08 * (joints[..., 2:] - place[:, None, 2:])
        return np.asarray(shared[:, None] + line[..., :, None] * line[..., None, :])


def _lift_keypoints(evidence: PlaneEvidence) -> Floats:
    """Return the keypoints (frames, persons, 17, 3) [m] at the distance of their person's place."""
    frames, persons = evidence.place.shape[:2]
    rays = evidence.camera.unproject(evidence.keypoints.reshape(frames, -1, 2))
    directions = rays.directions.reshape(frames, persons, 17, 3)
    origins = np.broadcast_to(rays.origins, rays.directions.shape).reshape(directions.shape)
    reach = np.linalg.norm(evidence.place[:, :, None] - origins[..., :2], axis=-1)
    with np.errstate(invalid="ignore", divide="ignore"):
        along = reach / np.linalg.norm(directions[..., :2], axis=-1)
    return np.asarray(origins + along[..., None] * directions)


def _misfit(joints: Floats, evidence: PlaneEvidence) -> tuple[Floats, Floats]:
    """Return the distance (frames, persons) of bodies from the keypoints, and that of noise [1].

    Both are root mean squares relative to that of the keypoints about their middle. Position and
    size in the image do not count, as the place and the mean body are not exact.
    """
    frames = len(joints)
    image = evidence.camera.project(joints.reshape(frames, -1, 3)).reshape(*joints.shape[:3], 2)
    both = np.asarray(
        np.isfinite(image).all(axis=-1) & np.isfinite(evidence.keypoints).all(axis=-1)
    )
    count = both.sum(axis=-1)
    ours, seen = (_center_points(points, both) for points in (image, evidence.keypoints))
    with np.errstate(invalid="ignore", divide="ignore"):
        size = (ours * seen).sum(axis=(-1, -2)) / (ours**2).sum(axis=(-1, -2))
        away = seen - np.maximum(size, 0.0)[..., None, None] * ours
        extent = np.sqrt((seen**2).sum(axis=(-1, -2)))
        misfit = np.sqrt((away**2).sum(axis=(-1, -2))) / extent
        # Standard deviation of a keypoint per axis in the same measure [1]: 2 % of the person's
        # height, as keypoints lie 0.28 heights from their middle.
        noise = np.sqrt(2.0 * (0.07**2 + count * (PIXEL_STD / extent) ** 2))
    return np.where(count >= MIN_KEYPOINTS, misfit, np.nan), noise


def _center_points(points: Floats, counted: Flags) -> Floats:
    """Return points (frames, persons, 17, 2) relative to the middle of those counted, else 0."""
    kept = np.where(counted[..., None], points, 0.0)
    middle = kept.sum(axis=2) / np.maximum(counted.sum(axis=2), 1)[..., None]
    return np.where(counted[..., None], kept - middle[:, :, None], 0.0)


def _find_contradiction(misfit: Floats) -> str | None:
    """Return why the misfit (frames,) of the estimates rules out a body; None if it does not."""
    compared = misfit[np.isfinite(misfit)]
    if not len(compared):
        return "no monocular estimate lies at the person's keypoints"
    share = float(np.mean(compared <= MAX_MISFIT))
    # Minimum share of a person's estimates that agree with the keypoints [1].
    if share < 0.5:
        return (
            f"the monocular estimates contradict the keypoints in {1.0 - share:.0%} of their "
            f"{len(compared)} frames"
        )
    return None


def _judge_fit(misfit: Floats, turned: Floats) -> str | None:
    """Return why a person's fitted body is refused; None if it is accepted."""
    # Maximum misfit of a fitted body, median over frames, relative to the keypoints' noise
    # [1]. In the two worlds 0.7 to 1.1, also for poor estimates, and 1.6 to 5 for bodies the
    # wrong way round.
    max_fitted_misfit = 2.0
    compared = np.isfinite(misfit) & np.isfinite(turned)
    if not compared.any():
        return f"no frame has a body and {MIN_KEYPOINTS} keypoints"
    middle, other = float(np.median(misfit[compared])), float(np.median(turned[compared]))
    if middle > max_fitted_misfit:
        return (
            f"the body fitted to the monocular estimates misses the keypoints by {middle:.1f} "
            f"times their noise (at most {max_fitted_misfit:g})"
        )
    # A body turned half round contradicts the estimates if it misses the keypoints by less than
    # this share of what the body as estimated does [1].
    if other < 0.75 * middle:
        return (
            "the monocular estimates contradict the keypoints, which show the person turned half "
            f"round (misfit {middle:.1f} times their noise, turned {other:.1f})"
        )
    return None
