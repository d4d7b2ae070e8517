"""Bodies of all people from 2D poses of calibrated cameras, in one call."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from data_contracts.arrays import Integers
from data_contracts.keypoints import KeypointDetections
from worldpose.body.body_file import find_body
from worldpose.body.model import BodyModel
from worldpose.body_fitting.estimate import fit_bodies
from worldpose.body_fitting.evidence import Ground
from worldpose.body_fitting.ray_constraints import find_ray_constraints
from worldpose.body_fitting.results import BodyFit, ClipEvidence
from worldpose.errors import InputError
from worldpose.formats.joints_file import JointTracks
from worldpose.geometry.cameras import Camera, Cameras
from worldpose.ingest.clock import row_rate
from worldpose.tracking.ray_matching import require_clip, require_layout
from worldpose.tracking.tracker import track_people
from worldpose.triangulation.estimate import reconstruct_joints
from worldpose.triangulation.limb_lengths import undo_swaps
from worldpose.triangulation.results import Reconstruction


@dataclass(frozen=True, eq=False)
class ReconstructedBodies:
    """People of a clip, with `frame` (frames,) numbers and `person` (persons,) identities.

    `joints` are triangulated, smoothed over time, with the cameras' clock offsets; `bodies` are
    (frames, persons).
    """

    frame: NDArray[np.int64]
    person: NDArray[np.int64]
    joints: Reconstruction
    bodies: BodyFit

    @property
    def tracks(self) -> JointTracks:
        """The bodies' joints, as `write_joints` and `evaluate_joints` take them."""
        return JointTracks(self.frame, self.person, self.bodies.joints, self.bodies.covariance)


def reconstruct_bodies(
    cameras: Cameras,
    detections: KeypointDetections | Sequence[KeypointDetections],
    fps: float,
    *,
    body: BodyModel | None = None,
    ground: Ground | None = None,
    camera_covariance: NDArray[np.float64] | None = None,
) -> ReconstructedBodies:
    """Return the bodies of all people whom calibrated, static cameras see.

    People are tracked over all cameras, unless the detections say who they are; their joints are
    triangulated, and a body is fitted to every person in every frame.

    Args:
        cameras: batch (cameras,), each camera, or the cameras of `read_cameras`; at least two.
        detections: of all cameras (frames, cameras, detections), or of each camera in this order.
            Their frame numbers rise; frames that are missing between others show nobody. Numbers
            0, 5, 10, ... are every fifth frame of the recording.
        fps: frame numbers per second [1/s].
        body: None = the body of `find_body`.
        ground: height [m] of the ground at x, y (n,) [m]; None where unknown.
        camera_covariance: (cameras, 12, 12) of the calibration on a pitch; None = unknown.

    Raises:
        InputError: numbers of cameras differ, the shapes do not fit together, frames or `fps` are
            invalid, or the cameras are not in metres.
    """
    cameras = Camera.batch(cameras)
    if not isinstance(detections, KeypointDetections):
        for camera in detections:
            require_layout("reconstruct_bodies", camera)
            _require_rising(camera.frame)
        detections = KeypointDetections.stack(list(detections))
    require_clip("reconstruct_bodies", cameras, detections, least=2)
    _require_rising(detections.frame)
    _require_metres(float(np.ptp(cameras.center, axis=0).max()), 0.0, 500.0, "cameras within")
    detections = _fill_frames(detections)
    rate = row_rate("reconstruct_bodies", fps, detections.frame)
    person = np.arange(detections.detection_index.shape[2], dtype=np.int64)
    if not len(person):
        tracks = track_people(cameras, detections, fps, camera_covariance=camera_covariance)
        person = tracks.person.astype(np.int64)
        detections = detections.assign_people(tracks.detection_index)
    joints = reconstruct_joints(cameras, detections, fps, camera_covariance=camera_covariance)
    placed = joints.triangulation
    sides = placed.joints[..., [5, 6], :] - placed.joints[..., [11, 12], :]
    torsos = np.linalg.norm(sides[np.isfinite(sides).all(-1)], axis=-1)
    if len(torsos):
        _require_metres(float(np.median(torsos)), 0.1, 1.5, "torsos of")
    rays = find_ray_constraints(cameras, undo_swaps(detections, placed.exchanged), placed.joints)
    bodies = fit_bodies(body or find_body(), ClipEvidence.of(placed, rate, rays), ground=ground)
    return ReconstructedBodies(detections.frame, person, joints, bodies)


def _require_metres(size: float, least: float, most: float, what: str) -> None:
    """Raise InputError if a size can be no metres."""
    if not least <= size <= most:
        raise InputError(
            "reconstruct_bodies: cameras",
            expected=f"metres: {what} {least:g} to {most:g} m",
            found=f"{size:.4g}",
            todo="Give t of x_cam = R x_world + t in metres: divide millimetres by 1000.",
        )


def _require_rising(frame: Integers) -> None:
    most = 200_000  # frames of a clip, as match.yaml has at most
    if len(frame) and (np.diff(frame) < 1).any():
        found = "numbers that repeat or fall"
    elif len(frame) and frame[-1] - frame[0] >= most:
        found = f"{frame[0]} to {frame[-1]}"
    else:
        return
    raise InputError(
        "reconstruct_bodies: frame",
        expected=f"frame numbers that rise, at most {most} from first to last",
        found=found,
        todo="Give each row the number of its frame, not a time.",
    )


def _fill_frames(detections: KeypointDetections) -> KeypointDetections:
    """Return the detections with the frames between others, in which nobody was seen."""
    frame = detections.frame
    if not len(frame):
        return replace(detections, frame=detections.numbers)
    every = np.arange(frame[0], frame[-1] + 1, max(1, np.gcd.reduce(np.diff(frame))))
    return detections if len(every) == len(frame) else detections.reindex(every)
