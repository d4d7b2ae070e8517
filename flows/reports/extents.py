"""Report section about the size of a run, as in the paper's data set table, and key metrics."""

from __future__ import annotations

import numpy as np

from data_contracts.evaluation import Evaluation
from data_contracts.release import DataSetStatistics
from flows.results.best_results import broadcast_cameras, clips_of, joint_tracks
from flows.stage import Match
from worldpose.dataset.statistics import clip_statistics, data_set_statistics, kind_of
from worldpose.reports import Section
from worldpose.reports.data_set import counted_section
from worldpose.store import Run


def extent_of(run: Run, match: Match) -> DataSetStatistics:
    """Count clips, frames, poses and distances of a run; a person's position is the mid-hip."""
    from worldpose.reports.drawing import HIPS

    broadcast = broadcast_cameras(run)
    clips = {}
    for clip in clips_of(run.record):
        places = joint_tracks(run, clip).joints[:, :, HIPS].mean(2)
        camera = broadcast.get(clip)
        kind = (
            "S"
            if camera is None
            else kind_of(camera.focal.mean(-1), camera.cam_from_world.rotation)
        )
        clips[clip] = clip_statistics(places, match.folder.spec.fps, kind)
    return data_set_statistics(clips)


def extent_section(run: Run, match: Match) -> Section:
    """Return the data set table row, its histograms, and each clip's share."""
    return counted_section(extent_of(run, match))


def tiles_of(run: Run, match: Match, scores: Evaluation | None) -> list[tuple[str, str]]:
    """Return the key metrics for the top of the report."""
    found = extent_of(run, match)
    people = sum(clip.persons for clip in found.clips.values())
    tiles = [
        (f"{60.0 * found.minutes:.1f} s", f"{found.frames:,} frames in {_counted(found)}"),
        (f"{people}", "people"),
        (f"{found.poses:,}", "3D poses"),
        (f"{len(match.folder.spec.static_cameras)}", "static cameras"),
        (f"{1000.0 * found.distance_km:,.0f} m", "run and walked by all"),
    ]
    if scores is not None and scores.mpjpe_mm is not None and np.isfinite(scores.mpjpe_mm):
        tiles.append((f"{scores.mpjpe_mm:.0f} mm", "mean error of a joint, against the truth"))
    return tiles


def _counted(found: DataSetStatistics) -> str:
    return "1 clip" if len(found.clips) == 1 else f"{len(found.clips)} clips"
