"""Task of stage `tracking`: identities of the detections in one clip."""

from __future__ import annotations

from typing import Any

import numpy as np
from pydantic import TypeAdapter

from data_contracts.tracking import TRACKING
from data_contracts.work import Work
from tasks.clip_inputs import open_clip
from tasks.unit import figures_of, unit_task
from worldpose.review.identities import (
    Identities,
    IdentityEdit,
    replay_identities,
    stored_identities,
)
from worldpose.store import Store, recipe_key
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
        said = work.recipe.sources.get("identities") or []
        edits = TypeAdapter(list[IdentityEdit]).validate_python(said)
        found, figures, warnings = _automatic(store, work) if edits else _tracked(store, work)
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


def _automatic(store: Store, work: Work) -> Tracked:
    """Return the published tracks without corrections; if there are none, track.

    Both are the same bytes.
    """
    recipe = work.recipe
    sources = {name: each for name, each in recipe.sources.items() if name != "identities"}
    plain = recipe.model_copy(update={"sources": sources})
    unit = (recipe.match_id, recipe.stage, recipe.unit, recipe_key(plain))
    if not store.has(*unit):
        return _tracked(store, work)
    manifest = store.manifest(*unit)
    return stored_identities(store.open_result(*unit)), dict(manifest.figures), manifest.warnings


def _tracked(store: Store, work: Work) -> Tracked:
    sources: dict[str, Any] = work.recipe.sources
    clip = open_clip(store, work)
    settings = TrackingSettings.model_validate(work.recipe.settings)
    given = (clip.keypoints, clip.confidence, clip.fps, settings)
    tracks = track_people(
        clip.cameras,
        *given,
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
            *given,
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
