"""Simulated results of image-based methods: a camera's detections, and monocular bodies."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Final

import numpy as np
from numpy.typing import NDArray
from pydantic import Field

from data_contracts.arrays import Flags, Floats
from data_contracts.conventions import COCO17, COCO17_FLIP, COCO17_SPREAD, COCO17_TORSO
from data_contracts.records import Record
from worldpose.body.model import BodyModel, BodyParameters
from worldpose.body.occlusions import facing_axes, find_hiders
from worldpose.geometry.cameras import Camera
from worldpose.geometry.rigid import Rigid, shortest_rotation
from worldpose.pitch.template import PitchTemplate
from worldpose.simulation.crowd import walk
from worldpose.simulation.paths import STEP, GroundPath, bursts, drift, sample_times
from worldpose.simulation.reference import Report, list_detections
from worldpose.simulation.settings import Scenario
from worldpose.simulation.skeletons import draw_body


@dataclass(frozen=True, eq=False)
class Projections:
    """People, or false positives, in one camera's image, and their occlusions.

    Attributes:
        keypoints: (frames, persons, 17, 2) [px]; NaN outside the image.
        bias: (frames, persons, 17, 2) [px], from a joint to the detector's joint.
        hider: (frames, persons, 17) int16, the nearest of the persons before a joint, -1 = none.
        size: (frames, persons) height of a standing person there [px].
        azimuth: (frames, persons) direction of the camera seen from the body [rad]: 0 in front,
            a quarter turn to the left.
    """

    keypoints: Floats
    bias: Floats
    hider: NDArray[np.int16]
    size: Floats
    azimuth: Floats

    @property
    def seen(self) -> Flags:
        """Return the joints in the image that are not occluded (frames, persons, 17)."""
        return np.asarray(np.isfinite(self.keypoints[..., 0]) & (self.hider < 0))


def project_bodies(
    camera: Camera, joints: Floats, heights: Floats, bias: Floats | None = None
) -> Projections:
    """Return the exact pixels of bodies, and the occlusions of joints by nearer bodies.

    `joints` (frames, persons, 17, 3) [m], world, are NaN where absent; `heights` (persons,) [m];
    `bias` [m], world, leads from each joint to the detector's; None = zero. The camera is single,
    or a batch (frames,).
    """
    frames, persons = joints.shape[:2]

    def project(places: Floats) -> Floats:
        return camera.project(places.reshape(frames, -1, 3)).reshape(frames, persons, 17, 2)

    pixels = project(joints)
    inside = (pixels >= -0.5) & (pixels <= camera.image_size.reshape(-1, 1, 1, 2) - 0.5)
    middle = joints[..., COCO17_TORSO, :].mean(axis=-2)
    depth = camera.cam_from_world.apply(middle)[..., 2]
    focal = camera.focal.mean(axis=-1)[..., None]
    size = focal * heights / np.where(depth > 0.0, depth, np.nan)
    front, left = facing_axes(joints)
    away = camera.center.reshape(-1, 1, 3) - middle
    return Projections(
        keypoints=np.where(np.all(inside, axis=-1, keepdims=True), pixels, np.nan),
        bias=np.zeros(pixels.shape) if bias is None else project(joints + bias) - pixels,
        hider=find_hiders(pixels, depth, size),
        size=size,
        azimuth=np.arctan2((away * left).sum(-1), (away * front).sum(-1)),
    )


FLOOR: Final = 0.5
"""Added to white errors in squares [px]: the limit of a heatmap's grid."""
POSTURES: Final = 12.0
"""Length of the walk that supplies postures of false positives [s]."""
_SIDE: Final = np.array([("left" in name) - ("right" in name) for name in COCO17], dtype=float)


@dataclass(frozen=True, eq=False)
class Detector:
    """A detector with the systematic errors of one match, the same in all cameras.

    Attributes:
        scenario: people, rates, spreads and frame rate.
        pitch: the ground under false positives.
        joint_bias: (17, 3) forward, left, up [standard deviations], a mirror image of itself.
        view_bias: (17, 2, 2) of the cosine and the sine of twice the azimuth, along the image
            axes [standard deviations].
        own_bias: (persons, 17, 3) as `joint_bias`, of each person.
    """

    scenario: Scenario
    pitch: PitchTemplate
    joint_bias: Floats
    view_bias: Floats
    own_bias: Floats

    @classmethod
    def draw(
        cls, scenario: Scenario, pitch: PitchTemplate, own_bias: Floats, rng: np.random.Generator
    ) -> Detector:
        """Return a detector whose systematic errors are drawn."""
        joint_bias = rng.standard_normal((17, 3))
        for joint, mirror in enumerate(COCO17_FLIP):
            if _SIDE[joint] < 0.0:
                joint_bias[joint] = joint_bias[mirror] * [1.0, -1.0, 1.0]
        joint_bias[_SIDE == 0.0, 1] = 0.0
        return cls(scenario, pitch, joint_bias, rng.standard_normal((17, 2, 2)), own_bias)

    def perceive(self, joints: Floats) -> Floats:
        """Return offsets (frames, persons, 17, 3) [m], world, to the detector's joints."""
        noise = self.scenario.noise
        front, left = facing_axes(joints)
        up = np.broadcast_to([0.0, 0.0, 1.0], front.shape)
        offsets = noise.shared_bias_m * self.joint_bias + noise.own_bias_m * self.own_bias
        return np.asarray(offsets @ np.stack([front, left, up], axis=-2))

    def film(
        self, camera: Camera, joints: Floats, heights: Floats, rng: np.random.Generator
    ) -> tuple[Report, Flags]:
        """Return a camera's detections of people (frames, persons, 17, 3) [m] and false positives.

        The second value tells the joints in the image that no other person occludes.
        """
        noise, persons = self.scenario.noise, joints.shape[1]
        people = project_bodies(camera, joints, heights, self.perceive(joints))
        keypoints, confidence, displaced, merged_into = self._detect(people, rng)
        figures = project_bodies(camera, *self._draw_false_positives(len(joints), rng))
        others = self._detect(figures, rng)
        dropped = bursts(noise.dropped_share, 0.06, (len(joints),), self.scenario.fps, rng)
        keypoints = np.concatenate([keypoints, others[0]], axis=1)
        # A detector is less sure of false positives.
        confidence = np.concatenate([confidence, 0.6 * others[1]], axis=1)
        displaced = np.concatenate([displaced, others[2]], axis=1)
        size = np.concatenate([people.size, figures.size], axis=1)
        boxes = _bounding_boxes(keypoints, merged_into, size)
        found = list_detections(
            keypoints,
            np.where(dropped[:, None, None], np.nan, confidence),
            displaced,
            np.concatenate([np.arange(persons), np.full(keypoints.shape[1] - persons, -1)]),
            lambda order, keypoints, found: np.take_along_axis(boxes, order[..., None], axis=1),
            rng,
        )
        return found, people.seen

    def _detect(
        self, projections: Projections, rng: np.random.Generator
    ) -> tuple[Floats, Floats, Flags, NDArray[np.int16]]:
        """Return keypoints [px], confidence, gross errors, and who has whose box, by body.

        The first two are NaN where not found. The last (frames, persons) is the person whose box
        includes this lost one, -1 for none.
        """
        drop = 8.0  # a joint with error e [person height] has confidence exp(-drop e)
        far_off = (4.0, 10.0)  # offset of displaced joints, in standard deviations of their error
        mostly_hidden = 0.7  # share of hidden joints above which a person is mostly hidden
        few_joints = 5  # fewer joints in the image are no body
        noise, fps = self.scenario.noise, self.scenario.fps
        pixels, size, hider = projections.keypoints, projections.size, projections.hider
        hidden, shape = hider >= 0, hider.shape
        spread = size[..., None] * np.array(COCO17_SPREAD)
        error = self._draw_errors(pixels, spread, rng)
        error *= (1.0 + hidden)[..., None]  # guessed from the rest of the body
        far = np.linalg.norm(error, axis=-1) / size[..., None]
        # Confidence reflects random errors, not systematic ones.
        confidence = np.exp(-drop * far) * (1.0 + 0.05 * rng.standard_normal(shape))
        confidence = np.clip(confidence * (1.0 - 0.5 * hidden), 0.01, 1.0)
        twice = 2.0 * projections.azimuth
        waves = np.stack([np.cos(twice), np.sin(twice)], axis=-1)
        view = np.einsum("fpw,jwa->fpja", waves, self.view_bias)
        error = error + projections.bias + noise.view_bias * spread[..., None] * view

        thrown = rng.random(shape) < noise.displaced
        angle = 2.0 * np.pi * rng.random(shape)
        sigma = np.hypot(np.hypot(noise.white, noise.slow) * spread, FLOOR)
        throw = rng.uniform(*far_off, shape) * sigma * thrown
        error = error + throw[..., None] * np.stack([np.cos(angle), np.sin(angle)], axis=-1)
        keypoints = pixels + error
        stolen = bursts(noise.stolen, 0.15, shape, fps, rng) & hidden
        frame, person, joint = np.nonzero(stolen)
        theirs = pixels[frame, hider[frame, person, joint], joint]
        there = np.isfinite(theirs[:, 0])
        at = (frame[there], person[there], joint[there])
        keypoints[at] = theirs[there] + error[at]

        lost = rng.random(shape) < np.where(hidden, noise.hidden_joint_missed, 0.02)
        small = size < 60.0  # [px]
        missed = _draw_bursts_by_size(0.03, 0.2, small, fps, rng)
        overlapped = hidden.mean(axis=-1) >= mostly_hidden
        overlapped &= rng.random(small.shape) < 0.9  # two boxes with that much overlap become one
        merges = overlapped & (rng.random(small.shape) < noise.merged)
        outside = np.isnan(pixels[..., 0])
        few = (~outside).sum(axis=-1) < few_joints
        lost |= outside | (missed | overlapped | few)[..., None]
        swapped = _draw_bursts_by_size(noise.swapped, 0.15, small, fps, rng)
        for array in (keypoints, lost, confidence, thrown):
            array[swapped] = array[swapped][:, COCO17_FLIP]
        keypoints[lost], confidence[lost] = np.nan, np.nan
        return keypoints, confidence, thrown & ~lost, np.where(merges, hider.max(axis=-1), -1)

    def _draw_errors(self, pixels: Floats, spread: Floats, rng: np.random.Generator) -> Floats:
        """Return errors of zero mean (frames, persons, 17, 2) [px]: white, slow and by motion."""
        slow_time = 0.3  # time constant of the slow part [s]: a fraction of a stride
        noise, fps = self.scenario.noise, self.scenario.fps
        white = rng.standard_normal(pixels.shape)
        slow = drift(pixels.shape, slow_time, fps, rng)
        along = rng.standard_normal((*spread.shape, 1))
        error: Floats = np.hypot(noise.white * spread, FLOOR)[..., None] * white
        error += (noise.slow * spread)[..., None] * slow
        if len(pixels) > 1 and noise.blur_s > 0.0:
            motion = np.gradient(pixels, axis=0) * fps
            # At the image border the motion is unknown; blur is negligible there.
            error += noise.blur_s * np.where(np.isfinite(motion), motion, 0.0) * along
        return error

    def _draw_false_positives(self, frames: int, rng: np.random.Generator) -> tuple[Floats, Floats]:
        """Return joints (frames, n, 17, 3) and heights (n,) [m] of motionless false positives.

        They appear and vanish at random places on and around the area of the scenario.
        """
        most = 2  # maximum number of false positives at a time in one camera
        crowd, share = self.scenario.crowd, self.scenario.noise.false_people / most
        on = bursts(share, 0.3, (frames, most), self.scenario.fps, rng)
        body = draw_body(crowd.height_m, rng)
        # Any moment of a walk serves as a posture; every appearance draws another.
        path = _walk_in_circle(rng)
        appeared = on & ~np.concatenate([np.zeros_like(on[:1]), on[:-1]])
        times = rng.uniform(0.0, POSTURES, appeared.shape)
        joints, _ = walk(body, path, times.ravel(), lambda x, y: 0.0 * x, rng)
        joints = joints.reshape(*appeared.shape, 17, 3)
        joints[..., :2] -= joints[..., 11:13, :2].mean(axis=2, keepdims=True)
        place = rng.uniform(-1.0, 1.0, (*appeared.shape, 2))
        place = np.array(crowd.area_center_m) + np.array(crowd.area_size_m) * place
        joints[..., :2] += place[:, :, None]
        joints[..., 2] += self.pitch.height(place[..., 0], place[..., 1])[..., None]
        # A false person keeps the posture of its appearance.
        since = np.maximum.accumulate(np.where(appeared, np.arange(frames)[:, None], 0), axis=0)
        joints = np.take_along_axis(joints, since[..., None, None], axis=0)
        joints[~on] = np.nan
        return joints, np.full(most, body.height)


def _draw_bursts_by_size(
    share: float, time: float, small: Flags, fps: float, rng: np.random.Generator
) -> Flags:
    """Return bursts (frames, persons); small people have them from two sources."""
    both = bursts(share, time, (*small.shape, 2), fps, rng)
    return np.asarray(both[..., 0] | (both[..., 1] & small))


def _bounding_boxes(keypoints: Floats, merged_into: NDArray[np.int16], size: Floats) -> Floats:
    """Return boxes (frames, bodies, 4) [px]; a merged one includes the lost person's width."""
    room = 0.06 * size[..., None]  # for head, hands and feet
    missing = np.isnan(keypoints)
    low = np.where(missing, np.inf, keypoints).min(axis=2) - room
    high = np.where(missing, -np.inf, keypoints).max(axis=2) + room
    frame, lost = np.nonzero(merged_into >= 0)
    into = merged_into[frame, lost]
    # Most of the lost person is hidden: half the person's width shows on the far side.
    half = 0.2 * size[frame, lost]
    low[frame, into, 0] -= np.where(lost % 2 == 0, 0.0, half)
    high[frame, into, 0] += np.where(lost % 2 == 0, half, 0.0)
    return np.concatenate([low, high], axis=-1)


def _walk_in_circle(rng: np.random.Generator) -> GroundPath:
    """Return a path in all directions, from a stroll to a run."""
    time = sample_times(POSTURES)
    speed = 2.5 + 1.5 * np.sin(2.0 * np.pi * (3.0 * time / POSTURES + rng.random()))
    heading = 2.0 * np.pi * (time / POSTURES + rng.random())
    way = np.stack([np.cos(heading), np.sin(heading)], axis=-1)
    return GroundPath(time, np.cumsum(speed[:, None] * way, axis=0) * STEP, heading, speed)


class MonocularErrors(Record):
    """Errors of monocular methods: a PA-MPJPE of 80 mm in total (mean distance after alignment)."""

    turn: float = Field(default=0.135, ge=0, le=100)
    """Error of every joint's rotation, standard deviation about each axis [rad]."""
    facing: float = Field(default=0.2, ge=0, le=100)
    """Error of the pelvis' rotation, about each axis [rad]."""
    time: float = Field(default=0.4, gt=0, le=100)
    """Time constant of the errors' correlation [s]: images hardly change."""
    white: float = Field(default=0.3, ge=0, le=1)
    """Share of the errors' variance that is independent per frame [1]."""
    size: float = Field(default=0.1, ge=0, le=10)
    """Error of the scale in the crop, relative [1]: children look like adults far away."""
    place: float = Field(default=0.03, ge=0, le=10)
    """Error of a box's centre, along each image axis [box side]."""
    missed: float = Field(default=0.1, ge=0, lt=1)
    """Share of bodies in the image that are not found [1]."""


def estimate_bodies(
    model: BodyModel,
    bodies: BodyParameters,
    camera: Camera,
    fps: float,
    errors: MonocularErrors,
    rng: np.random.Generator,
) -> dict[str, NDArray[np.generic]]:
    """Return estimates of a clip's bodies in 4DHumans' format, a row for each found body.

    Arrays: `frame`, `global_orient` (rows, 1, 3, 3) relative to a camera that looks at the crop's
    middle, `body_pose` (rows, 23, 3, 3), `betas` (rows, shapes) without person-specific shape,
    `pred_cam` (rows, 3), the crop's weak perspective: scale and offset [1], `box_center` (rows, 2)
    [px], `box_size` (rows,) [px], `img_size` (rows, 2) [px]. The order of rows identifies nobody.

    `bodies` (frames, persons) are in the world, NaN where missing; `camera` is a batch (frames,).
    """
    frames, persons = bodies.batch_shape
    given = np.concatenate([bodies.global_orient, bodies.body_pose], axis=-1)
    turns = Rigid.from_rotvec(given.reshape(frames, persons, -1, 3), np.zeros(3)).rotation
    slow = drift((frames, persons, *turns.shape[2:3], 3), errors.time, fps, rng)
    white = rng.standard_normal(slow.shape)
    off = np.sqrt(1.0 - errors.white) * slow + np.sqrt(errors.white) * white
    off[:, :, 0] *= errors.facing
    off[:, :, 1:] *= errors.turn
    size = 1.0 + errors.size * drift((frames, persons), errors.time, fps, rng)
    shifted = errors.place * drift((frames, persons, 2), errors.time, fps, rng)
    missed = rng.random((frames, persons)) < errors.missed
    order = rng.permuted(np.broadcast_to(np.arange(persons), (frames, persons)), axis=1)

    joints = model.articulate(bodies).joints + bodies.transl[..., None, :]
    image = camera.project(joints.reshape(frames, -1, 3)).reshape(frames, persons, -1, 2)
    low, high = image.min(axis=2), image.max(axis=2)
    side = 1.2 * (high - low).max(axis=-1)
    center = 0.5 * (low + high) + shifted * side[..., None]
    inside = (center >= 0.0).all(-1) & (center < camera.image_size[:, None] - 1.0).all(-1)
    there = inside & ~missed & np.isfinite(side)
    frame, place = np.nonzero(np.take_along_axis(there, order, axis=1))
    person = order[frame, place]

    found = turns[frame, person] @ Rigid.from_rotvec(off[frame, person], np.zeros(3)).rotation
    seen_at = camera[frame].normalize(center[frame, person][:, None])[:, 0]
    ray = np.insert(seen_at, 2, 1.0, axis=-1)
    ray /= np.linalg.norm(ray, axis=-1, keepdims=True)
    to_crop = shortest_rotation(ray, np.array([0.0, 0.0, 1.0]))
    found[:, 0] = to_crop @ camera.cam_from_world.rotation[frame] @ found[:, 0]
    # Scale 2 / (1.7 m) is a crop as high as an adult of 1.7 m.
    scale = 2.0 * size[frame, person] / (1.2 * 1.7)
    offset = (image[frame, person, 0] - center[frame, person]) / (0.5 * side[frame, person, None])
    pelvis = model.joint_template[0, :2] * [1.0, -1.0]
    return {
        "frame": frame,
        "global_orient": found[:, :1],
        "body_pose": found[:, 1:],
        "betas": np.zeros((len(frame), model.shapes)),
        "pred_cam": np.concatenate([scale[:, None], offset / scale[:, None] - pelvis], axis=-1),
        "box_center": center[frame, person],
        "box_size": side[frame, person],
        "img_size": camera.image_size[frame],
    }
