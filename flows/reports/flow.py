"""Report section about the background motion in a broadcast clip (M6)."""

from __future__ import annotations

import cv2
import numpy as np

from flows.results.best_results import clip_title
from flows.stage import Match
from flows.stages.detection import seen_in_broadcast
from worldpose.broadcast_calibration import BroadcastCalibrationSettings
from worldpose.broadcast_calibration.tracking import follow, modified_z_scores
from worldpose.geometry import Camera
from worldpose.ingest import unit_frames
from worldpose.reports import CaptionedImage
from worldpose.reports.broadcast import plot_flow
from worldpose.store import Run
from worldpose.video import open_video


def flow_pictures(run: Run, match: Match, clip: str, camera: Camera) -> list[CaptionedImage]:
    """Draw points tracked between the two frames with the largest camera rotation.

    Args:
        run: the run.
        match: the match.
        clip: a clip with a broadcast camera.
        camera: the camera, a batch over its frames.
    """
    frames = run[f"broadcast_calibration/{clip}"]["frame"].values
    rotation = camera.cam_from_world.rotation
    # The angle of R1^T R2 increases as the trace decreases.
    traces = np.einsum("fab,fab->f", rotation[1:], rotation[:-1])
    known = np.isfinite(traces) & (np.diff(frames) == 1)
    if not known.any():
        return []
    pair = int(np.argmin(np.where(known, traces, np.inf)))
    number = int(frames[pair])
    offset = unit_frames(match.folder.spec, clip).offset
    with open_video(match.folder.videos[clip]) as video:
        stills = [video.frame(number + offset + k) for k in (0, 1)]
    boxes = None
    for unit in seen_in_broadcast(match, clip):
        boxes = run[unit]["boxes"].sel(frame=[number]).values.astype(np.float64)
    own = run.record.settings.get("broadcast_calibration", {})
    settings = BroadcastCalibrationSettings.model_validate(own)
    greys = [np.asarray(cv2.cvtColor(still, cv2.COLOR_RGB2GRAY), np.uint8) for still in stills]
    (followed,) = follow(greys, boxes, settings.flow_points)
    rays = camera[pair].unproject(followed.start)
    predicted = camera[pair + 1].project(rays.origins + rays.directions * 100.0)
    told = np.isfinite(predicted).all(-1)
    start, end, predicted = followed.start[told], followed.end[told], predicted[told]
    rejected = modified_z_scores(predicted - end) >= settings.flow_outlier
    png = plot_flow(stills[0], start, end, rejected, predicted)
    return [
        CaptionedImage(
            f"{clip_title(clip)}, frame {number}, where the camera turns most from one frame to "
            "the next: points of the background where the next frame has them (arrows), those "
            "that do not move with the others (orange), and where the found camera puts them "
            "(yellow).",
            png,
        )
    ]
