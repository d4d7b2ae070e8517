"""Task of stage `tracking`: who is who in one clip."""

from __future__ import annotations

from data_contracts.run import Work
from data_contracts.tracking import TRACKING
from tasks.clip_inputs import open_clip
from tasks.unit import figures_of, unit_task
from worldpose.store import Store
from worldpose.tracking import TrackingSettings, track_people


@unit_task
def tracking(work: Work) -> str:
    """Publishes which detection is which person; returns the key."""
    store = Store.open(work.project)
    with store.publishing(work) as result:
        clip = open_clip(store, work)
        tracks = track_people(
            clip.cameras,
            clip.keypoints,
            clip.confidence,
            clip.fps,
            TrackingSettings.model_validate(work.recipe.settings),
            ground=bool(work.recipe.sources["ground"]),
            people=work.recipe.sources["people"],
        )
        result.write(
            TRACKING,
            arrays={
                "detection_index": tracks.detection_index,
                "ray_distance": tracks.ray_distance,
                "joints": tracks.joints,
            },
            coordinates={"frame": clip.frame, "person": tracks.person},
            attributes={
                "camera": list(clip.camera_ids),
                "tracks": [track.model_dump(mode="json") for track in tracks.tracks],
                "joins": [join.model_dump(mode="json") for join in tracks.joins],
            },
        )
        result.figures.update(figures_of(tracks.report, clip.camera_ids))
    return work.key
