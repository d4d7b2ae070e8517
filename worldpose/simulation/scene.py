"""A complete synthetic scene: people, cameras, detections and ground truth."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Final

import numpy as np
from numpy.typing import NDArray

from data_contracts.arrays import Flags, Floats, Integers
from data_contracts.keypoints import KeypointDetections
from data_contracts.pitch import PitchSpec
from worldpose.body.model import BodyParameters
from worldpose.formats.joints_file import JointTracks
from worldpose.geometry.cameras import Camera
from worldpose.geometry.rigid import Rigid
from worldpose.ingest.clock import camera_frames
from worldpose.pitch.template import PitchTemplate
from worldpose.simulation.annotations import Clicks, add_calibration_errors, click, every, survey
from worldpose.simulation.crowd import Crowd, gather
from worldpose.simulation.detector_errors import Detector
from worldpose.simulation.paths import Clip, GroundPath, drift
from worldpose.simulation.reference import CLIP_ID, Report
from worldpose.simulation.settings import BroadcastSettings, RigSettings, Scenario


def place_camera(
    rig: RigSettings, index: int, target: Floats, pitch: PitchSpec, rng: np.random.Generator
) -> Camera:
    """Return the static camera with this number: in its seat, or else in a ring beyond the border.

    A seat's place, aim and focal length have small random offsets. Roll, principal point and barrel
    distortion (k1, k2) are those of a stadium lens. `target` (3,) [m], world, is the aim of the
    ring.
    """
    if index < len(rig.seats):
        seat = rig.seats[index]
        center = np.array(seat.place_m) + rig.seat_std_m * rng.uniform(-1.0, 1.0, 3)
        aim = np.array([*seat.aim_m, 0.0])
        aim[:2] += rig.seat_std_m * rng.uniform(-1.0, 1.0, 2)
        focal = seat.focal_px * rng.uniform(0.99, 1.01)
    else:
        center, aim, focal = _place_in_ring(rig, index, target, pitch, rng)
    width, tall = rig.image_size_px
    middle = np.array([width - 1.0, tall - 1.0]) / 2.0
    return Camera(
        focal=np.array([focal, focal]),
        principal_point=middle + 0.004 * width * rng.standard_normal(2),
        distortion=np.array([rng.uniform(-0.12, -0.02), rng.uniform(0.0, 0.03), 0.0, 0.0, 0.0]),
        cam_from_world=look_at(center, aim, np.radians(0.5) * rng.standard_normal()),
        image_size=np.array([width, tall]),
    )


def _place_in_ring(
    rig: RigSettings, index: int, target: Floats, pitch: PitchSpec, rng: np.random.Generator
) -> tuple[Floats, Floats, float]:
    """Return center and aim (3,) [m], world, and focal length [px]."""
    standard_person = 1.8  # body height for `RigSettings.person_height_px` [m]
    # Steps of this share of a turn spread any number of cameras, and an additional one moves none.
    golden = (np.sqrt(5.0) - 1.0) / 2.0
    azimuth = 2.0 * np.pi * (index * golden + rng.uniform(-0.02, 0.02)) - 0.5 * np.pi
    way = np.array([np.cos(azimuth), np.sin(azimuth)])
    border = 0.5 * np.array([pitch.length, pitch.width])
    to_border = float(np.min((border - np.sign(way) * target[:2]) / np.abs(way)))
    distance = to_border + rng.uniform(*rig.distance_m)
    center = target + np.array([*(distance * way), rng.uniform(*rig.height_m)])
    aim = target + np.array([*rng.uniform(-1.5, 1.5, 2), 0.5 * standard_person])
    # An upright person far below the camera is foreshortened by the cosine of the tilt.
    far = float(np.linalg.norm(aim - center))
    return center, aim, rig.person_height_px * far / (standard_person * distance / far)


def look_at(center: Floats, aim: Floats, roll: float) -> Rigid:
    """Return the pose of a camera at `center` that looks at `aim`, rolled by an angle [rad]."""
    forward = (aim - center) / np.linalg.norm(aim - center)
    right = np.cross(forward, [0.0, 0.0, 1.0])
    right /= np.linalg.norm(right)
    level = np.stack([right, np.cross(forward, right), forward])
    cos, sin = np.cos(roll), np.sin(roll)
    rotation = np.array([[cos, -sin, 0.0], [sin, cos, 0.0], [0.0, 0.0, 1.0]]) @ level
    return Rigid(rotation, -rotation @ center)


CALM: Final = 0.02
"""Time step of the operator's motion [s]: one frame at 50 per second."""


def move_broadcast_camera(
    settings: BroadcastSettings,
    times: Floats,
    action: Floats,
    action_times: Floats,
    image_size: tuple[int, int],
    rng: np.random.Generator,
) -> Camera:
    """Return the broadcast camera of every frame, a batch (frames,), with one center.

    Pan and tilt follow a smoothed action through two equal first-order lags, like a damped head.
    Radial distortion grows with the focal length, as in released clips: k1 0.1 to 1, k2 0.6 to 4.3.

    `times` (frames,) [s] are those of its images, `action` (samples, 2) [m], world, is the place of
    the action at `action_times` (samples,) [s], from 1.5 s before the first frame to the last.
    """
    center = np.array(
        [
            rng.uniform(-settings.aside_m, settings.aside_m),
            -rng.uniform(67.0, 88.0),
            rng.uniform(*settings.height_m),
        ]
    )
    lag = 0.5  # with which the operator follows the action: a reaction, and a damped head [s]
    sway = 4.0  # drift of the aim off the action along x: operators lead and trail play [m]
    warm_up = 1.5  # for which the operator follows the action before the first frame [s]
    hand = np.arange(times[0] - warm_up, times[-1] + 2.0 * CALM, CALM)
    aim = np.stack([np.interp(hand, action_times, axis) for axis in action.T], axis=-1)
    aim[:, 0] += sway * _smooth(drift(hand.shape, 2.5, 1.0 / CALM, rng), 0.6)
    aim[:, 0] += settings.sweep_m * np.sin(2.0 * np.pi * (hand / 8.0 + rng.random()))
    # The image centre stays within the pitch, nearer to the camera than the action's far side.
    aim = np.clip(0.9 * aim, [-40.0, -22.0], [40.0, 26.0])
    aim = _smooth(_smooth(aim, 0.5 * lag), 0.5 * lag)
    aim = np.stack([np.interp(times, hand, axis) for axis in aim.T], axis=-1)

    width, scale = np.array(image_size, dtype=np.float64), image_size[0] / 1920.0
    low, high = settings.focal_px
    period = rng.uniform(*settings.zoom_period_s)
    wave = np.sin(2.0 * np.pi * (times / period + rng.random()))
    focal = scale * low * (high / low) ** (0.5 + 0.5 * wave)
    roll = np.radians(0.15) * rng.standard_normal()
    poses = [look_at(center, np.array([*point, 1.0]), roll) for point in aim]
    glass = rng.uniform(0.85, 1.15, 2)
    zoomed = focal / (4200.0 * scale)
    k1 = np.clip(0.42 * glass[0] * zoomed**1.6, 0.0, 1.0)
    k2 = np.clip(1.6 * glass[1] * zoomed, 0.0, 4.3)
    offset = np.array([rng.uniform(-16.0, 12.0), rng.uniform(-60.0, -3.0)])
    return Camera(
        focal=np.stack([focal, focal], axis=-1),
        principal_point=np.broadcast_to((width - 1.0) / 2.0 + scale * offset, (len(times), 2)),
        distortion=np.stack([k1, k2, *np.zeros((3, len(times)))], axis=-1),
        cam_from_world=Rigid(
            np.stack([pose.rotation for pose in poses]),
            np.stack([pose.translation for pose in poses]),
        ),
        image_size=np.array(image_size),
    )


def _smooth(signal: Floats, time: float) -> Floats:
    """Return a first-order lag along the first axis."""
    smoothed = np.empty_like(signal)
    keep = float(np.exp(-CALM / time))
    smoothed[0] = signal[0]
    for i in range(1, len(signal)):
        smoothed[i] = keep * smoothed[i - 1] + (1.0 - keep) * signal[i]
    return smoothed


Seed = np.random.SeedSequence


@dataclass(frozen=True, eq=False)
class MovingView:
    """A moving camera.

    Attributes:
        camera: a batch (images,).
        fps: images per second.
        number: (frames,) image that is nearest to each frame of the match.
    """

    camera: Camera
    fps: float
    number: Integers

    @property
    def times(self) -> Floats:
        """Times of the images [s]."""
        return np.arange(len(self.camera.focal)) / self.fps


@dataclass(frozen=True, eq=False)
class StaticViews:
    """Detections of static cameras per frame, the input of tracking.

    Attributes:
        detections: (frames, cameras, detections); NaN where there is none.
        person: (frames, cameras, detections) index into the truth's `person_ids`; -1 for false
            positives and padding.
        displaced: (frames, cameras, detections, 17) bool, keypoints with deliberate gross errors.
    """

    detections: KeypointDetections
    person: NDArray[np.int16]
    displaced: Flags

    def index(self, persons: int) -> NDArray[np.int16]:
        """Return each person's detection index (frames, cameras, persons); -1 = not found."""
        index = np.full((*self.person.shape[:2], persons), -1, np.int16)
        frame, camera, place = np.nonzero(self.person >= 0)
        index[frame, camera, self.person[frame, camera, place]] = place
        return index


@dataclass(frozen=True, eq=False)
class Scene:
    """A match's ground truth and its detections.

    Attributes:
        truth: `views` counts the static cameras that have the joint in their image without an
            occluding person.
        defined: (frames, persons, 17, 3) [m], world, joints where the detector takes them to be,
            the same for all views.
        crowd: the people, at any time.
        poses: the bodies (persons, frames) whose keypoints the truth's joints are.
        cameras: the true static cameras by id, in the order of the rig.
        given: the same cameras with the errors of calibration.toml.
        broadcast: the moving cameras by name of their broadcast view.
        observations: detections by id of a static camera or name of a broadcast view.
        identities: identities of the detections, by the same ids.
        clocks: offset of a static camera behind its stated clock, by id [frame].
        clicks: a person's clicks in the first frame of every static camera, by id.
        surveyed: the pitch of pitch.json; the scenario has the painted one.
    """

    truth: JointTracks
    defined: Floats
    crowd: Crowd
    poses: BodyParameters
    cameras: dict[str, Camera]
    given: dict[str, Camera]
    broadcast: dict[str, MovingView]
    observations: dict[str, KeypointDetections]
    identities: dict[str, Report]
    clocks: dict[str, float]
    clicks: dict[str, Clicks]
    surveyed: PitchSpec

    def static_views(self) -> StaticViews:
        """Return the detections of static cameras in one array."""
        names = list(self.cameras)
        seen = KeypointDetections.stack([self.observations[name] for name in names])
        shape = seen.score.shape
        person, displaced = np.full(shape, -1, np.int16), np.zeros((*shape, 17), np.bool_)
        for c, name in enumerate(names):
            found = self.identities[name]
            rows, last = (
                np.searchsorted(seen.frame, found.observations.frame),
                found.person.shape[1],
            )
            person[rows, c, :last] = found.person
            displaced[rows, c, :last] = found.displaced
        points, sure = seen.keypoints.astype(np.float64), seen.confidence.astype(np.float64)
        detections = KeypointDetections.from_keypoints(points, sure, frame=seen.frame)
        return StaticViews(detections, person, displaced)


def simulate_scene(
    scenario: Scenario,
    seed: int,
    *,
    driven: Sequence[GroundPath] | None = None,
    clip: Clip | None = None,
) -> Scene:
    """Return a scene; the same scenario and seed give the same numbers.

    Every person and every camera draws from a separate stream: an additional camera changes no
    existing number, and an additional person no motion of those who wander. People are `driven`
    along paths instead of the scenario's movement; one of them plays `clip`.
    """
    people_seed, rig_seed, systematic_seed, broadcast_seed, error_seed, survey_seed, click_seed = (
        Seed(seed).spawn(7)
    )
    pitch = PitchTemplate.from_spec(scenario.pitch)
    crowd = gather(scenario, pitch, people_seed, driven, clip)
    common, *own = systematic_seed.spawn(1 + len(crowd.paths))
    own_bias = np.array([_rng(each).standard_normal((17, 3)) for each in own]).reshape(-1, 17, 3)
    detector = Detector.draw(scenario, pitch, own_bias, _rng(common))
    times = np.arange(round(scenario.duration * scenario.fps)) / scenario.fps
    joints = crowd.joints(times)
    x, y = scenario.crowd.area_center_m
    target = np.array([x, y, float(pitch.height(x, y))])

    cameras, reports = dict[str, Camera](), dict[str, Report]()
    clocks, clicks = dict[str, float](), dict[str, Clicks]()
    views = np.zeros(joints.shape[:3], dtype=np.int64)
    from_wrong, from_clustered = _rng(click_seed).random(2)
    for index, camera_seed in enumerate(rig_seed.spawn(scenario.rig.cameras)):
        name = f"cam{index:02d}"
        place, clock, detections, hand = camera_seed.spawn(4)
        camera = place_camera(scenario.rig, index, target, scenario.pitch, _rng(place))
        clocks[name] = scenario.rig.clock_std_frames * float(_rng(clock).standard_normal())
        late = clocks[name] / scenario.fps
        seen = joints if late == 0.0 else crowd.joints(times + late)
        reports[name], visible = detector.film(camera, seen, crowd.heights, _rng(detections))
        views += visible
        clicks[name] = click(
            camera,
            pitch,
            joints[0],
            scenario.clicks,
            clustered=every(scenario.clicks.clustered, index, from_clustered),
            mistaken=every(scenario.clicks.wrong, index, from_wrong),
            rng=_rng(hand),
        )
        cameras[name] = camera
    broadcast = dict[str, MovingView]()
    for number, settings in enumerate(scenario.broadcast):
        place, detections = broadcast_seed.spawn(2)
        name = CLIP_ID if len(scenario.broadcast) == 1 else f"{CLIP_ID}.{broadcast_id(number)}"
        fps = settings.fps or scenario.fps
        size = settings.image_size_px or scenario.rig.image_size_px
        nearest = camera_frames(np.arange(len(times)), 0.0, fps / scenario.fps)
        own_times = np.arange(nearest[-1] + 1) / fps
        camera = move_broadcast_camera(
            settings, own_times, crowd.action, crowd.action_times, size, _rng(place)
        )
        broadcast[name] = view = MovingView(camera, fps, nearest)
        seen = joints if view.fps == scenario.fps else crowd.joints(view.times)
        faster = replace(detector, scenario=scenario.model_copy(update={"fps": view.fps}))
        reports[name], _ = faster.film(view.camera, seen, crowd.heights, _rng(detections))
    return Scene(
        truth=JointTracks(np.arange(len(times)), np.arange(len(own)), joints, views=views),
        defined=joints + detector.perceive(joints),
        crowd=crowd,
        poses=crowd.poses(times),
        cameras=cameras,
        given=add_calibration_errors(cameras, scenario.calibration, _rng(error_seed)),
        broadcast=broadcast,
        observations={name: each.observations for name, each in reports.items()},
        identities=reports,
        clocks=clocks,
        clicks=clicks,
        surveyed=survey(scenario.pitch, scenario.survey_error, _rng(survey_seed)),
    )


def broadcast_id(number: int) -> str:
    """Return the id of a broadcast camera."""
    return f"broadcast{number + 1}" if number else "broadcast"


def _rng(seed: Seed) -> np.random.Generator:
    return np.random.default_rng(seed)
