"""Task of stage `tracking`: identities of the detections in one clip."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Any, Final

import numpy as np
from numpy.typing import NDArray
from pydantic import TypeAdapter

from data_contracts.arrays import ClipArray, Floats, Singles
from data_contracts.keypoints import KeypointDetections
from data_contracts.pitch import PitchSpec
from data_contracts.tracking import TRACKING
from data_contracts.triangulation import CameraChange
from tasks.clip_inputs import ClipInputs, camera_rates, open_clip
from tasks.unit import UnitInputs, figures_of, unit_task
from worldpose.compiled import map_in_threads
from worldpose.ingest.clock import offset_change
from worldpose.pitch.template import PitchTemplate
from worldpose.review.identities import (
    Identities,
    TrackEdit,
    add_plane_tracks,
    replay_identities,
    stored_identities,
)
from worldpose.store.writer import ResultWriter
from worldpose.tracking.absences import measure_absences
from worldpose.tracking.diagnosis import diagnose_no_people
from worldpose.tracking.joins import describe_doubts
from worldpose.tracking.plane.clocks import PlaneClocks, estimate_plane_clocks
from worldpose.tracking.plane.feet import (
    FrameBlocks,
    GroundPositions,
    count_covering_cameras,
    locate_feet,
)
from worldpose.tracking.plane.tracker import (
    TriangulatedPeople,
    locate_tracks,
    track_on_plane,
    triangulated_places,
)
from worldpose.tracking.settings import TrackingSettings
from worldpose.tracking.tracker import Tracking, track_people
from worldpose.triangulation.camera_changes import describe_change
from worldpose.triangulation.change_search import follow_changes
from worldpose.triangulation.lost_views import find_lone_views
from worldpose.triangulation.world import People, doubt_world

BLOCK: Final = 256
"""Frames of detections in memory at a time."""


@unit_task
def tracking(inputs: UnitInputs, result: ResultWriter) -> None:
    """Write the person of each detection, with people's corrections."""
    corrections = inputs.sources.get("identities") or []
    edits = TypeAdapter(list[TrackEdit]).validate_python(corrections)
    found, figures, warnings = (_open_uncorrected if edits else _track_people)(inputs)
    result.warnings += warnings
    replay = replay_identities(found, edits)
    corrected = replay.identities
    if edits:
        figures["undecided"] = float(sum(not join.decided for join in corrected.joins))
    figures["corrections_refused"] = float(sum(map(bool, replay.objections)))
    present = np.asarray((corrected.detection_index >= 0).any(axis=1), np.bool_)
    people = corrected.person.tolist()
    fps = float(inputs.sources["fps"])
    figures = {name: value for name, value in figures.items() if not name.startswith("absent_")}
    figures |= measure_absences(present, np.asarray(corrected.frame, np.int64), people, fps)
    result.write(
        TRACKING,
        arrays={
            "detection_index": corrected.detection_index,
            "ray_distance": corrected.ray_distance,
            "joints": corrected.joints,
            **_ground_arrays(inputs, corrected),
        },
        coordinates={"frame": corrected.frame, "person": corrected.person},
        attributes={
            "camera": list(corrected.cameras),
            "tracks": [track.model_dump(mode="json") for track in corrected.tracks],
            "joins": [join.model_dump(mode="json") for join in corrected.joins],
            "objections": list(replay.objections),
            "changes": [change.model_dump(mode="json") for change in corrected.changes],
        },
    )
    result.figures.update(figures)


def _ground_arrays(inputs: UnitInputs, people: Identities) -> dict[str, NDArray[Any]]:
    """Return the stored places of people on the pitch; empty if all are triangulated."""
    pitch = _pitch(inputs)
    if pitch is None or not people.on_plane.any():
        return {}
    clip = open_clip(inputs)
    index = np.where(people.on_plane[:, None], people.detection_index, -1)
    # Without triangulated people, all feet tell the clocks.
    is_placed = np.isfinite(people.joints).any()
    feet = _locate_feet(clip, pitch, _mark(index, clip) if is_placed else None)
    middle = triangulated_places(people.joints)
    clocks = _estimate_clocks(feet.positions, clip, pitch, people.joints)
    tracks = locate_tracks(feet.positions, feet.places_of(index), clip.fps, clocks.seconds, middle)
    arrays = {
        "ground": tracks.xy,
        "ground_velocity": tracks.velocity,
        "ground_covariance": tracks.covariance,
    }
    for array in arrays.values():
        array[~people.on_plane] = np.nan
    arrays["ground_height"] = tracks.height
    return {name: array.astype(np.float32) for name, array in arrays.items()}


Tracked = tuple[Identities, dict[str, float], tuple[str, ...]]
"""The tracker's output, its metrics, and its warnings."""


def _open_uncorrected(inputs: UnitInputs) -> Tracked:
    """Return the published tracks without corrections; if there are none, track."""
    published = inputs.open_uncorrected("identities")
    if published is None:
        return _track_people(inputs)
    stored, manifest = published
    return stored_identities(stored), dict(manifest.figures), manifest.warnings


def _track_people(inputs: UnitInputs) -> Tracked:
    pitch = _pitch(inputs)
    settings = inputs.settings(TrackingSettings)
    pitch_size = None if pitch is None else (pitch.length, pitch.width)

    clip = open_clip(inputs)

    def track(detections: KeypointDetections[ClipArray]) -> Tracking:
        return track_people(
            clip.cameras,
            detections,
            clip.fps,
            settings,
            pitch_size=pitch_size,
            people=inputs.sources["people"],
            camera_covariance=clip.camera_covariance,
        )

    followed = follow_changes(
        clip.camera_ids,
        clip.cameras,
        clip.fps,
        lambda changes: open_clip(inputs, further=changes).detections,
        track,
    )
    clip = replace(clip, detections=followed.detections)
    tracks, changes = followed.tracks, followed.changes
    found = Identities(
        frame=clip.detections.frame,
        cameras=tuple(clip.camera_ids),
        person=tracks.person,
        detection_index=tracks.detection_index,
        ray_distance=tracks.ray_distance,
        joints=tracks.joints,
        on_plane=np.zeros(tracks.joints.shape[:2], dtype=np.bool_),
        names={},
        joins=(*tracks.joins, *(each.join for each in tracks.takeovers)),
        changes=changes,
    )
    figures = figures_of(tracks.report, clip.camera_ids)
    said = ""
    if not len(tracks.person):
        reason = diagnose_no_people(
            clip.cameras,
            clip.camera_ids,
            clip.detections,
            clip.fps,
            settings,
            pitch_size=pitch_size,
            births=tracks.report.births,
            rates=camera_rates(inputs),
        )
        said = f"{inputs.recipe.name} found no person: {reason.message}"
    plane = None if pitch is None else _track_on_plane(clip, pitch, found, camera_rates(inputs))
    if plane is not None:
        found, further, clocks = plane
        if not len(tracks.person):
            figures |= further
            said = (
                f"{inputs.recipe.name} could place no person in 3D: {reason.message} "
                f"{len(found.person)} people are placed on the pitch from their feet, without "
                f"joints and bodies.{clocks}"
            )
        elif found.on_plane.any():
            figures |= {name: number for name, number in further.items() if "plane" in name}
    more, doubts = _doubts(inputs, clip, tracks)
    moved = _describe_changes(clip, tracks, changes)
    return found, figures | more, (*filter(None, [said]), *doubts, *moved)


def _describe_changes(
    clip: ClipInputs, tracks: Tracking, changes: Sequence[CameraChange]
) -> list[str]:
    """Return sentences about cameras that change, and others whose people meet nobody any more."""
    lone = find_lone_views(clip.cameras, clip.detections, tracks.joints, clip.fps)
    explained = {change.camera for change in changes}
    return [f"{describe_change(change)}." for change in changes] + [
        f"camera {clip.camera_ids[c]}: from frame {clip.detections.frame[row]} on most of its "
        "people meet nobody, though other cameras place people in its view. Look whether it moved, "
        "or its clock changed."
        for c, row in lone.items()
        if clip.camera_ids[c] not in explained
    ]


def _doubts(
    inputs: UnitInputs, clip: ClipInputs, tracks: Tracking
) -> tuple[dict[str, float], list[str]]:
    """Return metrics and warnings on the world's unit and axes, and on identities."""
    name, unmatched = inputs.recipe.name, tracks.report.unmatched_share or 0.0
    figures, warnings = dict[str, float](), list[str]()
    most = 1000  # frames from the first with people; more tell no more of the world
    first = int(np.isfinite(tracks.joints[..., 0]).any(axis=(1, 2)).argmax())
    tracked = People.of(tracks.joints[first : first + most], clip.fps)
    if tracked is not None:
        figures["median_stature_m"] = tracked.stature
        # With many detections left over, people are rays that meet by chance.
        doubted = doubt_world(clip.cameras, tracked, sizes=unmatched < 0.3)
        warnings += [f"{name}: {each}" for each in doubted]
    frame = np.asarray(clip.detections.frame, dtype=np.int64)
    doubts = describe_doubts(frame, len(tracks.person), tracks.takeovers, tracks.joins)
    if doubts is not None:
        warnings.append(f"{name}: {doubts}.")
    return figures, warnings


def _pitch(inputs: UnitInputs) -> PitchTemplate | None:
    """Return size and surface of the pitch, if there is one."""
    given = inputs.sources["pitch"]
    return None if given is None else PitchTemplate.from_spec(PitchSpec(any_size=True, **given))


def _mark(detection_index: NDArray[np.integer], clip: ClipInputs) -> NDArray[np.bool_]:
    """Return the mask (frames, cameras, detections) of people's detections."""
    mask = np.zeros(clip.detections.score.shape, dtype=np.bool_)
    frame, camera, person = np.nonzero(detection_index >= 0)
    mask[frame, camera, detection_index[frame, camera, person]] = True
    return mask


@dataclass(frozen=True, eq=False)
class _Feet:
    """Foot positions of some detections of a clip.

    Attributes:
        positions: (frames, cameras, places), in the order of the detections: as many places in a
            block of frames as one camera has such detections in one of its frames.
        detection: (frames, cameras, places) int16, the detection at each place; -1 = none.
    """

    positions: GroundPositions
    detection: FrameBlocks

    def detections_of(self, place: NDArray[np.integer]) -> NDArray[np.int16]:
        """Return the detections at places (frames, cameras, people); -1 = none."""
        out = np.full(place.shape, -1, dtype=np.int16)
        for number, detection in enumerate(self.detection.parts):
            rows = slice(number * BLOCK, number * BLOCK + len(detection))
            at = np.maximum(place[rows], 0).astype(np.int64)
            found = np.take_along_axis(detection, at, axis=2)
            out[rows] = np.where(place[rows] >= 0, found, -1)
        return out

    def places_of(self, detection: NDArray[np.integer]) -> NDArray[np.int16]:
        """Return the places of detections (frames, cameras, people); -1 = none."""
        place = np.full(detection.shape, -1, dtype=np.int16)
        for number, known in enumerate(self.detection.parts):
            rows = slice(number * BLOCK, number * BLOCK + len(known))
            for column in range(known.shape[2]):
                own = known[:, :, column, None]
                place[rows][(detection[rows] == own) & (own >= 0)] = column
        return place


def _locate_feet(clip: ClipInputs, pitch: PitchTemplate, chosen: NDArray[np.bool_] | None) -> _Feet:
    """Return foot positions by camera of chosen detections; None = all."""
    pitch = pitch if clip.surface is None else pitch.with_surface(clip.surface)

    def locate(first: int) -> tuple[GroundPositions, NDArray[np.int16]]:
        rows = slice(first, first + BLOCK)
        detections = clip.detections[rows]
        there = np.isfinite(detections.confidence).any(-1) | np.isfinite(detections.boxes).all(-1)
        own = np.asarray(there if chosen is None else there & chosen[rows])
        located = locate_feet(
            clip.cameras, detections, pitch, camera_covariance=clip.camera_covariance, chosen=own
        )
        order = np.argsort(~own, axis=2, kind="stable")[:, :, : max(1, int(own.sum(axis=2).max()))]
        index = np.where(np.take_along_axis(own, order, axis=2), order, -1)
        return located.select(order), index.astype(np.int16)

    blocks = map_in_threads(locate, range(0, len(clip.detections.frame), BLOCK))
    positions, indices = zip(*blocks, strict=True)
    return _Feet(GroundPositions.join(positions, BLOCK), FrameBlocks(indices, BLOCK))


def _estimate_clocks(
    positions: GroundPositions, clip: ClipInputs, pitch: PitchTemplate, joints: Singles
) -> PlaneClocks:
    """Return the cameras' clock offsets by running people; none where people are triangulated.

    Triangulation estimates the clocks itself, and its people are at the times of the frames.
    """
    if np.isfinite(joints).any():
        none = np.zeros(len(clip.camera_ids))
        return PlaneClocks(none, np.full(len(none), np.inf), 0, none > 0.0)
    return estimate_plane_clocks(positions, clip.fps, pitch_size=(pitch.length, pitch.width))


def _track_on_plane(
    clip: ClipInputs, pitch: PitchTemplate, found: Identities, rates: Floats
) -> tuple[Identities, dict[str, float], str] | None:
    """Add people by their feet; return all, metrics and a sentence, or None without any."""
    is_triangulated = _mark(found.detection_index, clip)
    feet = _locate_feet(clip, pitch, ~is_triangulated)
    positions = feet.positions
    clocks = _estimate_clocks(positions, clip, pitch, found.joints)
    located = int(positions.number_seen().sum())
    detections = located + np.count_nonzero(is_triangulated)
    if not located:
        return None
    tracks = track_on_plane(
        positions,
        clip.fps,
        clocks.seconds,
        pitch_size=(pitch.length, pitch.width),
        triangulated=TriangulatedPeople(
            triangulated_places(found.joints), np.asarray((found.detection_index >= 0).any(axis=1))
        ),
        covering=count_covering_cameras(clip.cameras, positions),
    )
    if not tracks.detection_index.shape[2]:
        return None
    is_placed = np.asarray(np.isfinite(tracks.xy).all(axis=-1))
    index = feet.detections_of(tracks.detection_index)
    added = add_plane_tracks(found, index, is_placed, tracks.continues)
    variance = np.trace(tracks.covariance, axis1=-2, axis2=-1)
    figures = {
        "people": float(len(added.person)),
        "plane_people": float(sum(track.kind == "plane" for track in added.tracks)),
        "plane_poses": float(np.count_nonzero(added.on_plane)),
        "plane_std_m": float(np.sqrt(np.nanmedian(variance))),
        "unmatched_share": 1.0 - np.count_nonzero(added.detection_index >= 0) / detections,
    }
    # Images earlier than those of the latest camera with the same people, in their own frames.
    late = clocks.seconds * clip.fps
    changes = [
        (clip.camera_ids[c], offset_change(late[c] - late[list(group)].max(), rates[c]))
        for group in clocks.groups
        for c in group
        if late[list(group)].max() - late[c] > 3.0 * clocks.std[c] * clip.fps
    ]
    whole = [f"{name} {change:+.0f}" for name, change in changes if round(float(change))]
    said = (
        " Running people show that clocks differ. That is corrected here; for the whole match, "
        "add to the clock offsets (offset_frames in match.yaml): {}.".format(", ".join(whole))
        if whole
        else ""
    )
    return added, figures, said
