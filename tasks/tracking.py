"""Task of stage `tracking`: identities of the detections in one clip."""

from __future__ import annotations

from typing import Any

import numpy as np
from pydantic import TypeAdapter

from data_contracts.tracking import TRACKING
from data_contracts.work import Work
from tasks.clip_inputs import open_clip
from tasks.unit import figures_of, open_uncorrected, unit_task
from worldpose.review.identities import (
    Identities,
    IdentityEdit,
    replay_identities,
    stored_identities,
)
from worldpose.store import Store
from worldpose.tracking import (
    TrackingSettings,
    describe_doubts,
    diagnose_no_people,
    track_people,
)


@unit_task
def tracking(work: Work) -> str:
    """Publish the person of each detection, with people's corrections; return the key."""
    store = Store.open(work.project)
    with store.publishing(work) as result:
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
    settings = TrackingSettings.model_validate(work.recipe.settings)
    tracks = track_people(
        clip.cameras,
        clip.keypoints,
        clip.confidence,
        clip.fps,
        settings,
        pitch_size=sources["pitch_size"],
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
    warnings: tuple[str, ...] = ()
    if not len(tracks.person):
        reason = diagnose_no_people(
            clip.cameras,
            clip.camera_ids,
            clip.keypoints,
            clip.confidence,
            clip.fps,
            settings,
            ground=sources["pitch_size"] is not None,
            births=tracks.report.births,
        )
        warnings = (f"{work.recipe.name} found no person: {reason.message}",)
    doubts = describe_doubts(
        np.asarray(found.frame, dtype=np.int64), len(tracks.person), tracks.takeovers, tracks.joins
    )
    if doubts is not None:
        warnings += (f"{work.recipe.name}: {doubts}.",)
    return found, figures_of(tracks.report, clip.camera_ids), warnings
