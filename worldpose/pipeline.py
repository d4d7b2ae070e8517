"""The method in the paper's order on plain arrays; `reconstruct` is the whole of it.

Each step below is one stage of `worldpose run`, which adds what a recording of a whole match needs:
checks of cameras against each other, review gates, iterations, chunks, stored results and lineage.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from data_contracts.keypoints import KeypointDetections
from data_contracts.pitch import PitchSpec
from worldpose.body.body_file import find_body
from worldpose.body_fitting.estimate import fit_bodies
from worldpose.body_fitting.ray_constraints import find_ray_constraints
from worldpose.body_fitting.results import BodyFit, ClipEvidence
from worldpose.broadcast_calibration.estimate import BroadcastClip, calibrate_broadcast
from worldpose.broadcast_calibration.players import People, boxes_of
from worldpose.broadcast_calibration.report import BroadcastCalibration
from worldpose.bundle_adjustment.clip import Clicks, Clip
from worldpose.bundle_adjustment.estimate import adjust_cameras
from worldpose.bundle_adjustment.report import BundleAdjustment
from worldpose.detection.pipeline import detect_people
from worldpose.errors import InputError
from worldpose.geometry.cameras import Camera
from worldpose.ingest.footage import image_clock, read_still, read_unit, unit_frames
from worldpose.ingest.match_folder import MatchFolder
from worldpose.pitch.template import PitchTemplate
from worldpose.static_calibration.estimate import calibrate_camera
from worldpose.static_calibration.report import StaticCalibration
from worldpose.static_calibration.sides import place_at
from worldpose.tracking.tracker import Tracking, track_people
from worldpose.triangulation.estimate import reconstruct_joints
from worldpose.triangulation.limb_lengths import undo_swaps
from worldpose.triangulation.results import Triangulation
from worldpose.triangulation.settings import TriangulationSettings
from worldpose.video.folder import grey_on_clock, open_video, pictures_at


@dataclass(frozen=True, eq=False)
class Reconstruction:
    """All results of one clip, in one world frame.

    Attributes:
        frame: (frames,) match frames.
        tracking: the person of each detection.
        adjusted: static cameras, adjusted to people and markings.
        joints: (frames, persons, 17, ...) triangulated joints.
        bodies: (frames, persons) bodies and their joints.
        broadcast: the moving camera in each image of its video, by broadcast view.
    """

    frame: NDArray[np.int64]
    tracking: Tracking
    adjusted: BundleAdjustment
    joints: Triangulation
    bodies: BodyFit
    broadcast: Mapping[str, BroadcastCalibration]


def reconstruct(match: MatchFolder, clip_id: str | None = None) -> Reconstruction:
    """Return the people and cameras of a clip with clicked static cameras.

    Args:
        match: a match folder with a pitch, clicks, and 2D poses or videos.
        clip_id: name of the clip; None = the first one.
    """
    pitch, fps = PitchTemplate.from_spec(match.pitch or PitchSpec()), match.spec.fps
    clip_id = match.clip(clip_id).id

    known = calibrate_static_cameras(match, pitch)
    cameras = Camera.stack([each.estimate.camera for each in known])
    errors = np.stack([each.estimate.covariance for each in known])

    seen = find_people(match, clip_id)
    size = (pitch.length, pitch.width)
    tracks = track_people(cameras, seen, fps, pitch_size=size, camera_covariance=errors)
    people = seen.assign_people(tracks.detection_index)
    first = reconstruct_joints(cameras, people, fps, camera_covariance=errors).triangulation

    clicks = tuple(Clicks.of(each, pitch) for each in known)
    on_lines = np.array([each.report.stage == "lines" for each in known])
    placed = (people, first.joints, first.views, TriangulationSettings(), pitch, on_lines)
    adjusted = adjust_cameras(Clip(cameras, errors, clicks, fps, *placed))
    cameras, errors = adjusted.cameras, adjusted.covariance
    joints = reconstruct_joints(cameras, people, fps, camera_covariance=errors).triangulation

    rays = find_ray_constraints(cameras, undo_swaps(people, joints.exchanged), joints.joints)
    bodies = fit_bodies(find_body(), ClipEvidence.of(joints, fps, rays), ground=pitch.height)
    views = (name for name in match.spec.views_of(clip_id) if name in match.key_frames)
    broadcast = {name: calibrate_moving_camera(match, name, pitch, bodies) for name in views}
    return Reconstruction(seen.frame, tracks, adjusted, joints, bodies, broadcast)


def calibrate_static_cameras(match: MatchFolder, pitch: PitchTemplate) -> list[StaticCalibration]:
    """Return each static camera from clicks on markings, and from painted lines in its still."""
    calibrations = []
    if not match.spec.static_cameras:
        todo = "Use `worldpose run`: it places people by a broadcast camera alone."
        raise InputError(f"{match.folder / 'match.yaml'}", "static cameras", "none", todo)
    for spec in match.spec.static_cameras:
        if spec.id not in match.clicked:
            expected, todo = f"clicks of static camera {spec.id!r}", "Add them, or use a run."
            raise InputError(str(match.folder / "annotations"), expected, "none", todo)
        size, still = (spec.width, spec.height), match.stills.get(spec.id)
        picture = None if still is None else read_still(still, size)
        clicks, lens = match.clicked[spec.id], match.lenses.get(spec.id)
        start = spec.side and place_at(spec.side)
        found = calibrate_camera(pitch, clicks, size, picture=picture, lens=lens, start=start)
        calibrations.append(found)
    return calibrations


def find_people(match: MatchFolder, clip_id: str) -> KeypointDetections:
    """Return the 2D poses (frames, cameras, detections, 17): given ones, or those of our nets."""
    clip, cameras = match.spec.clip(clip_id), []
    for camera in match.spec.static_cameras:
        if camera.id in match.detections or camera.id not in match.videos:
            seen = read_unit(match, camera.id)[0]
        else:
            clock, file = unit_frames(match.spec, camera.id), match.videos[camera.id]
            start, last = clock.numbers(clip.first_frame + np.array([0, clip.frame_count - 1]))
            number = np.arange(start, last + 1)
            with open_video(file) as video:
                at = video.index.shown(number, match.spec.fps * clock.rate, str(file))
                images = pictures_at(video, at[at >= 0])
                shown = detect_people(each for each in images if each is not None)
            seen = clock.place(file, replace(shown, frame=number[at >= 0]))
        after = seen.frame - clip.first_frame
        cameras.append(seen[np.flatnonzero((after >= 0) & (after < clip.frame_count))])
    return KeypointDetections.stack(cameras)


def calibrate_moving_camera(
    match: MatchFolder, view: str, pitch: PitchTemplate, bodies: BodyFit
) -> BroadcastCalibration:
    """Return the broadcast camera of each image: E_field + E_player, similarity and smoothness."""
    clock = image_clock(match.spec, view)
    start, fps = int(clock.images[0]), match.spec.fps
    rate = fps * clock.rate

    def pictures() -> Iterator[NDArray[np.uint8]]:
        return grey_on_clock(match.videos[view], clock.images, rate)

    seen = read_unit(match, view)[0] if view in match.detections else None
    keys = list(match.key_frames[view].key_frames)
    people = boxes = None
    if seen is not None:
        keypoints = seen.keypoints.astype(np.float64)
        people = People.in_images(bodies.joints, keypoints, fps, clock)
        boxes = boxes_of(keypoints)[clock.frame_of(clock.images)]
    weight = match.spec.broadcast_views[view].clip.broadcast_smooth_weight
    clip = BroadcastClip(keys, pictures, rate, people, boxes, view, start, smooth_weight=weight)
    return calibrate_broadcast(pitch, clip)
