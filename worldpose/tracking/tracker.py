"""The tracker: follows a clip's people, joins their tracks, assigns identities."""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from data_contracts.arrays import ClipArray, Floats, Integers, Singles
from data_contracts.conventions import COCO17
from data_contracts.keypoints import KeypointDetections
from data_contracts.records import Record
from data_contracts.tracking import Join, Track
from worldpose.compiled import compile_kernel, map_in_threads
from worldpose.geometry.cameras import Camera, Cameras
from worldpose.ingest.clock import row_rate
from worldpose.static_calibration.parameters import project_with_jacobian
from worldpose.tracking.frame_tracker import FrameTracker
from worldpose.tracking.joins import Candidate, Takeover, lasting_takeovers
from worldpose.tracking.people_selection import join_people
from worldpose.tracking.person import Person
from worldpose.tracking.plane.feet import PIXEL_SHARE, PIXEL_STD
from worldpose.tracking.ray_matching import require_clip
from worldpose.tracking.settings import TrackingSettings


class TrackingReport(Record):
    """Summary of a tracking run."""

    people: int
    """People found [1]."""
    births: int
    """Tracks begun [1]."""
    dropped: int
    """Tracks that were dropped: too short, shadows, bystanders, or beyond the roster's limit
    [1]."""
    merged: int
    """Tracks that ended as duplicates of another track [1]."""
    joined: int
    """Tracks that continue an earlier person's [1]."""
    undecided: int
    """Joins left to review [1]."""
    takeovers: int
    """Frames in which a track may have passed to another person [1]."""
    losses: int
    """People whose track ended before the clip did [1]."""
    detections: int
    """Detections with enough joints to be matched [1]."""
    unmatched_share: float | None
    """Share of them that belong to no tracked person; None without any."""
    mean_ray_distance_m: float | None
    """Mean of `ray_distance` [m]; None without matches."""


@dataclass(frozen=True)
class Tracking:
    """Detections assigned to people.

    Attributes:
        person: (persons,) int32 ids from 0, in the order of first appearance.
        detection_index: (frames, cameras, persons) int16, index among the detections of this frame
            and camera; -1 = not seen.
        ray_distance: (frames, cameras, persons) float32, mean distance of the detection's rays to
            the person when matched [m]; NaN = not seen.
        joints: (frames, persons, 17, 3) float32 quick joints [m], world; NaN where fewer than two
            views determine one.
        tracks: one summary per person.
        joins: decided and possible joins of tracks: the undecided first, then by falling cost.
        takeovers: frames in which a track may have passed to another person.
        report: metrics of the whole clip.
    """

    person: NDArray[np.int32]
    detection_index: NDArray[np.int16]
    ray_distance: Singles
    joints: Singles
    tracks: tuple[Track, ...]
    joins: tuple[Join, ...]
    takeovers: tuple[Takeover, ...]
    report: TrackingReport


def track_people(
    cameras: Cameras,
    detections: KeypointDetections[ClipArray],
    fps: float,
    settings: TrackingSettings = TrackingSettings(),  # noqa: B008
    *,
    pitch_size: tuple[float, float] | None = None,
    people: int | None = None,
    camera_covariance: Floats | None = None,
) -> Tracking:
    """Return the person to which every camera's detections belong, in all frames.

    In every frame, known people take detections by ray distance, confirmed people before new ones;
    remaining detections are associated across views and start people.

    Args:
        cameras: batch (cameras,), each camera, or the cameras of `read_cameras`.
        detections: (frames, cameras, detections), read in blocks of frames, whose numbers rise in
            equal steps; a confidence of NaN, 0 or less excludes a keypoint.
        fps: frame numbers per second [1/s].
        settings: gates, least views and times.
        pitch_size: length and width of the pitch around the origin [m], on which people stand at
            z = 0; None = they may be anywhere.
        people: most people at once; None = any number.
        camera_covariance: (cameras, 12, 12) covariance of the calibration on a pitch, by
            `static_calibration.parameters.PARAMETERS`; None = all cameras are equally accurate.

    Raises:
        InputError: the shapes do not fit together, or frames or `fps` are invalid.

    Note:
        Constant velocity between frames departs from the paper (`predict_motion`).
    """
    cameras = Camera.batch(cameras)
    require_clip("tracking", cameras, detections)
    fps = row_rate("tracking", fps, detections.frame)
    keypoints, confidence = detections.keypoints, detections.confidence
    tracker = FrameTracker(cameras, fps, pitch_size is not None, people, settings)
    frames = confidence.shape[0]
    # The accuracy of an angle is a pixel over the focal length.
    precision = (cameras.focal**2).mean(axis=-1)[:, None, None]
    if camera_covariance is not None and pitch_size is not None:
        precision = precision * pixel_weights(cameras, camera_covariance)

    block = 64  # Frames read and converted to rays at a time: bounds memory, not the result.

    def read(start: int) -> tuple[int, Floats, Floats]:
        """Return the first frame of a block, and its rays and their weights."""
        image = np.array(keypoints[start : start + block], dtype=np.float64, order="C")
        weights = np.array(confidence[start : start + block], dtype=np.float64, order="C")
        directions = cameras.unproject(image.reshape(*image.shape[:2], -1, 2)).directions
        directions = np.array(directions.reshape(*image.shape[:-1], 3))
        _weigh(weights, directions, image, cameras.image_size, precision)
        return start, directions, weights

    # The next blocks are read while the frames of one are tracked.
    for start, directions, weights in map_in_threads(read, range(0, frames, block)):
        is_empty = ~np.asarray((weights > 0.0).any(axis=(1, 2, 3)))
        for offset in range(len(weights)):
            if not (is_empty[offset] and tracker.is_idle):
                tracker.step(start + offset, directions[offset], weights[offset])
    return _build_result(tracker, frames, pitch_size)


@compile_kernel
def _weigh(
    weights: Floats, directions: Floats, image: Floats, size: Integers, precision: Floats
) -> None:
    """Multiply confidences by the precision in the part of the image where the person is.

    Weights are (frames, cameras, detections, joints), directions (..., 3) of these: where not seen
    afterwards, they are 0 and NaN. `image` has places (..., 2) [px], `size` is (cameras, 2) [px],
    and the precision of angles (cameras, rows, columns).
    """
    frames, cameras, detections, joints = weights.shape
    _, rows, columns = precision.shape
    for frame in range(frames):
        for c in range(cameras):
            for detection in range(detections):
                x, y, count = 0.0, 0.0, 0
                for joint in range(joints):
                    place = (frame, c, detection, joint)
                    # Also False for NaN.
                    if weights[place] > 0.0 and directions[place][0] >= -1.0:
                        x, y = x + image[place][0], y + image[place][1]
                        count += 1
                    else:
                        weights[place] = 0.0
                        directions[place][:] = math.nan
                if count:
                    column = int(x / count / size[c, 0] * columns)
                    row = int(y / count / size[c, 1] * rows)
                    column = min(max(column, 0), columns - 1)
                    row = min(max(row, 0), rows - 1)
                    for joint in range(joints):
                        weights[frame, c, detection, joint] *= precision[c, row, column]


def pixel_weights(cameras: Camera, covariance: Floats) -> Floats:
    """Return the weight (cameras, rows, columns) of people's keypoints in parts of the images [1].

    It is the inverse of a keypoint's variance: its own (`feet.PIXEL_STD`, `feet.PIXEL_SHARE`) and
    the calibration's (cameras, 12, 12), by `static_calibration.parameters.PARAMETERS`.
    """
    cells = (32, 18)  # Columns and rows of the parts of an image with one weight.
    columns, rows = cells
    grid = np.stack(np.meshgrid(np.arange(columns) + 0.5, np.arange(rows) + 0.5), axis=-1)
    weights = np.empty((len(covariance), rows, columns))
    # Distance of a person in a pixel whose ray does not meet that height before [m].
    farthest = 150.0
    # Height of an adult, and of the middle of a body, over the pitch [m].
    adult_height, middle_height = 1.75, 1.0
    for c in range(len(covariance)):
        camera = cameras[c]
        rays = camera.unproject((grid / cells * camera.image_size).reshape(-1, 2))
        with np.errstate(divide="ignore", invalid="ignore"):
            along = (middle_height - rays.origins[:, 2]) / rays.directions[:, 2]
        along = np.where((along > 0.0) & (along < farthest), along, farthest)
        _, by_step = project_with_jacobian(camera, rays.origins + along[:, None] * rays.directions)
        # The mean over both axes of the image.
        moved = 0.5 * np.einsum("nij,jk,nik->n", by_step, covariance[c], by_step)
        own = (PIXEL_STD + PIXEL_SHARE * adult_height * camera.focal.mean() / along) ** 2
        variance = own + np.where(np.isfinite(moved), moved, 0.0)
        weights[c] = (PIXEL_STD**2 / variance).reshape(rows, columns)
    return weights


def _build_result(
    tracker: FrameTracker, frames: int, pitch_size: tuple[float, float] | None
) -> Tracking:
    """Return the people with enough evidence, over `frames` frames."""
    causal = tracker.settings.causal
    all_people = tracker.all_people()
    if causal:
        lasting = [person for person in all_people if person.shown_from >= 0]
        candidates, chains = tracker.joins, [[person] for person in lasting]
    else:
        needed = min(max(1, tracker.confirmed_after), frames)
        lasting = [person for person in all_people if person.evidence >= needed - 1e-9]
        candidates, chains = join_people(lasting, tracker, pitch_size)
    chains.sort(key=lambda chain: (min(chain[0].sightings), chain[0].number))
    cameras = len(tracker.centers)
    index = np.full((frames, cameras, len(chains)), -1, dtype=np.int16)
    distance = np.full(index.shape, np.nan, dtype=np.float32)
    joints = np.full((frames, len(chains), len(COCO17), 3), np.nan, dtype=np.float32)
    tracks = []
    for n, chain in enumerate(chains):
        for person in chain:
            # Matches in single views after the last fix may show any person.
            first, last = (person.shown_from, frames) if causal else (0, person.last_fixed)
            frame, seen, apart, pose = person.sightings.stack()
            kept = (first <= frame) & (frame <= last)
            index[frame[kept], :, n] = seen[kept]
            distance[frame[kept], :, n] = apart[kept]
            joints[frame[kept], n] = pose[kept]
        tracks.append(_summarize_track(n, index[:, :, n]))
    matched = np.isfinite(distance)
    count = int(np.count_nonzero(matched))
    joins = _final_joins(candidates, chains, all_people)
    takeovers = lasting_takeovers(tracker.takeovers, lasting, chains)
    report = TrackingReport(
        people=len(chains),
        births=len(all_people),
        dropped=len(all_people) - sum(map(len, chains)),
        merged=tracker.merged,
        joined=sum(join.decided for join in joins),
        undecided=sum(not join.decided for join in joins),
        takeovers=len(takeovers),
        losses=sum(track.last_frame < frames - 1 for track in tracks),
        detections=tracker.detections,
        unmatched_share=1.0 - count / tracker.detections if tracker.detections else None,
        mean_ray_distance_m=float(distance[matched].mean(dtype=np.float64)) if count else None,
    )
    ids = np.arange(len(chains), dtype=np.int32)
    return Tracking(ids, index, distance, joints, tuple(tracks), joins, takeovers, report)


def _summarize_track(person: int, index: NDArray[np.int16]) -> Track:
    """Return the summary of one person's detections (frames, cameras)."""
    views = np.count_nonzero(index >= 0, axis=1)
    present = np.flatnonzero(views)
    return Track(
        person=person,
        first_frame=int(present[0]),
        last_frame=int(present[-1]),
        frames_seen=len(present),
        views=float(views[present].mean()),
    )


def _final_joins(
    candidates: list[Candidate], chains: list[list[Person]], all_people: list[Person]
) -> tuple[Join, ...]:
    """Return the joins in terms of final people, without those of dropped tracks."""
    final = {person.number: n for n, chain in enumerate(chains) for person in chain}
    joins = [
        Join(
            before=final[join.before],
            after=final.get(join.after, final[join.before]),
            last_frame=join.last_frame,
            first_frame=join.first_frame,
            cost=join.cost,
            margin=join.margin if math.isfinite(join.margin) else None,
            decided=join.decided,
        )
        for join in candidates
        if join.before in final and (join.decided or join.after in final)
    ]
    return tuple(sorted(joins, key=lambda join: (join.decided, -join.cost, join.first_frame)))
