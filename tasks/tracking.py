"""Task of stage `tracking`: identities of the detections in one clip."""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray
from pydantic import TypeAdapter

from data_contracts.pitch import PitchSpec
from data_contracts.tracking import TRACKING
from data_contracts.work import Work
from tasks.clip_inputs import ClipInputs, open_boxes, open_clip
from tasks.unit import figures_of, open_uncorrected, unit_task
from worldpose.pitch import PitchTemplate
from worldpose.review.identities import (
    Identities,
    IdentityEdit,
    replay_identities,
    stored_identities,
)
from worldpose.store import Store
from worldpose.tracking import (
    GroundPositions,
    PlaneClocks,
    TrackingSettings,
    describe_doubts,
    diagnose_no_people,
    estimate_plane_clocks,
    locate_feet,
    locate_tracks,
    track_on_plane,
    track_people,
)


@unit_task
def tracking(work: Work) -> str:
    """Publish the person of each detection, with people's corrections; return the key."""
    store = Store.open(work.project)
    with store.publish(work) as result:
        corrections = work.recipe.sources.get("identities") or []
        edits = TypeAdapter(list[IdentityEdit]).validate_python(corrections)
        found, figures, warnings = (_open_uncorrected if edits else _track_people)(store, work)
        result.warnings += warnings
        replay = replay_identities(found, edits)
        corrected = replay.identities
        if edits:
            figures["undecided"] = float(sum(not join.decided for join in corrected.joins))
        figures["corrections_refused"] = float(sum(map(bool, replay.objections)))
        result.write(
            TRACKING,
            arrays={
                "detection_index": corrected.detection_index,
                "ray_distance": corrected.ray_distance,
                "joints": corrected.joints,
                **_ground_arrays(store, work, corrected),
            },
            coordinates={"frame": corrected.frame, "person": corrected.person},
            attributes={
                "camera": list(corrected.cameras),
                "tracks": [track.model_dump(mode="json") for track in corrected.tracks],
                "joins": [join.model_dump(mode="json") for join in corrected.joins],
                "objections": list(replay.objections),
            },
        )
        result.figures.update(figures)
    return work.key


def _ground_arrays(store: Store, work: Work, people: Identities) -> dict[str, NDArray[Any]]:
    """Return the stored places of people on the pitch; empty if all are triangulated."""
    pitch = _pitch(work)
    on_plane = [track.kind == "plane" for track in people.tracks]
    if pitch is None or not any(on_plane):
        return {}
    clip = open_clip(store, work)
    positions, clocks = _feet(store, work, clip, pitch)
    tracks = locate_tracks(positions, people.detection_index, clip.fps, clocks.seconds)
    arrays = {
        "ground": tracks.xy,
        "ground_velocity": tracks.velocity,
        "ground_covariance": tracks.covariance,
    }
    for array in arrays.values():
        array[:, ~np.array(on_plane)] = np.nan
    arrays["ground_height"] = np.where(on_plane, tracks.height, np.nan)
    return {name: array.astype(np.float32) for name, array in arrays.items()}


Tracked = tuple[Identities, dict[str, float], tuple[str, ...]]
"""The tracker's output, its metrics, and its warnings."""


def _open_uncorrected(store: Store, work: Work) -> Tracked:
    """Return the published tracks without corrections; if there are none, track."""
    published = open_uncorrected(store, work, "identities")
    if published is None:
        return _track_people(store, work)
    stored, manifest = published
    return stored_identities(stored), dict(manifest.figures), manifest.warnings


def _track_people(store: Store, work: Work) -> Tracked:
    sources: dict[str, Any] = work.recipe.sources
    clip = open_clip(store, work)
    pitch = _pitch(work)
    settings = TrackingSettings.model_validate(work.recipe.settings)
    tracks = track_people(
        clip.cameras,
        clip.keypoints,
        clip.confidence,
        clip.fps,
        settings,
        pitch_size=None if pitch is None else (pitch.length, pitch.width),
        people=sources["people"],
    )
    found = Identities(
        frame=np.asarray(clip.frame),
        cameras=tuple(clip.camera_ids),
        person=tracks.person,
        detection_index=tracks.detection_index,
        ray_distance=tracks.ray_distance,
        joints=tracks.joints,
        names={},
        joins=tracks.joins,
    )
    figures = figures_of(tracks.report, clip.camera_ids)
    warnings: tuple[str, ...] = ()
    if not len(tracks.person):
        reason = diagnose_no_people(
            clip.cameras,
            clip.camera_ids,
            clip.keypoints,
            clip.confidence,
            clip.fps,
            settings,
            ground=pitch is not None,
            births=tracks.report.births,
        )
        plane = None if pitch is None else _track_on_plane(store, work, clip, pitch)
        if plane is None:
            warnings = (f"{work.recipe.name} found no person: {reason.message}",)
        else:
            found, further, clocks = plane
            figures |= further
            warnings = (
                f"{work.recipe.name} could not triangulate any person: {reason.message} "
                f"{len(found.person)} people are placed on the pitch from their feet, without "
                f"joints and bodies.{clocks}",
            )
    doubts = describe_doubts(
        np.asarray(found.frame, dtype=np.int64), len(tracks.person), tracks.takeovers, tracks.joins
    )
    if doubts is not None:
        warnings += (f"{work.recipe.name}: {doubts}.",)
    return found, figures, warnings


def _pitch(work: Work) -> PitchTemplate | None:
    """Return size and surface of the pitch, if there is one."""
    given: Any = work.recipe.sources["pitch"]
    return None if given is None else PitchTemplate.from_spec(PitchSpec(any_size=True, **given))


def _feet(
    store: Store, work: Work, clip: ClipInputs, pitch: PitchTemplate
) -> tuple[GroundPositions, PlaneClocks]:
    """Return people's foot positions by camera, and the clock offsets estimated from them."""
    positions = locate_feet(
        clip.cameras,
        clip.keypoints[:],
        clip.confidence[:],
        pitch,
        boxes=open_boxes(store, work)[:],
        camera_covariance=clip.camera_covariance,
    )
    size = (pitch.length, pitch.width)
    return positions, estimate_plane_clocks(positions, clip.fps, pitch_size=size)


def _track_on_plane(
    store: Store, work: Work, clip: ClipInputs, pitch: PitchTemplate
) -> tuple[Identities, dict[str, float], str] | None:
    """Return people tracked by their feet, metrics, and a sentence on clocks; None without any."""
    positions, clocks = _feet(store, work, clip, pitch)
    size = (pitch.length, pitch.width)
    tracks = track_on_plane(positions, clip.fps, clocks.seconds, pitch_size=size)
    index = tracks.detection_index
    if not index.shape[2]:
        return None
    found = Identities(
        frame=np.asarray(clip.frame),
        cameras=tuple(clip.camera_ids),
        person=np.arange(index.shape[2], dtype=np.int32),
        detection_index=index,
        ray_distance=np.full(index.shape, np.nan, dtype=np.float32),
        joints=np.full((len(index), index.shape[2], 17, 3), np.nan, dtype=np.float32),
        names={},
        joins=(),
    )
    variance = np.trace(tracks.covariance, axis1=-2, axis2=-1)
    detections = np.count_nonzero(np.isfinite(positions.xy[..., 0]))
    figures = {
        "people": float(index.shape[2]),
        "plane_std_m": float(np.sqrt(np.nanmedian(variance))),
        "unmatched_share": 1.0 - np.count_nonzero(index >= 0) / detections,
    }
    # A video that is late shows an earlier time: its frames lie behind those of the others.
    offsets = (clocks.seconds.max() - clocks.seconds) * clip.fps
    errors = clocks.std * clip.fps
    late = [
        f"{name} {offsets[c]:+.1f} (standard deviation {errors[c]:.1f})"
        for c, name in enumerate(clip.camera_ids)
        if np.isfinite(errors[c]) and offsets[c] > 3.0 * errors[c]
    ]
    said = (
        " Running people show that clocks differ. That is corrected here; for the whole match, "
        f"add to offset_frames in match.yaml: {', '.join(late)}."
        if late
        else ""
    )
    return found, figures, said
