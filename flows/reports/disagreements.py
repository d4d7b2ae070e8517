"""Report section about the views with the largest residuals between detections and joints."""

from __future__ import annotations

from typing import Final

import numpy as np

from flows.reports.match_pictures import background_image, frame_picture
from flows.results.best_results import clip_title, estimated_pitch, joint_tracks, static_cameras
from flows.stage import Match
from flows.stages.filtering import seen_in
from worldpose.formats.joints_file import JointTracks
from worldpose.reports.clips import ImageDetections, ReconstructedPeople, plot_detections
from worldpose.reports.html_page import CaptionedImage
from worldpose.store.store import Run, Store

MAX_VIEWS: Final = 2
"""Number of views shown: the worst, each of another person."""
EVALUATED_FRAMES: Final = 300
"""Frames of a clip that are evaluated, evenly spaced."""
MIN_JOINTS: Final = 8
"""Minimum number of joints of a person in a view."""
_CROP_HEIGHTS: Final = 2.5
"""Side length of the crop [height of the person]."""


def worst_views(run: Run, match: Match, clip: str, tracks: JointTracks) -> list[tuple[int, ...]]:
    """Return views with the largest median distance of keypoints to projected joints, worst first.

    Distances are in heights of the person in the image, over the keypoints assigned to the person's
    track; each person appears once.

    Returns:
        Frame index, camera and person of each, and the median distance in percent.
    """
    rows = np.unique(
        np.linspace(0, len(tracks.frames) - 1, EVALUATED_FRAMES).round().astype(np.int64)
    )
    numbers = tracks.frames[rows]
    tracked = run[f"tracking/{clip}"]["detection_index"].sel(frame=numbers)
    place = tracked.reindex(person=tracks.person_ids, fill_value=-1).values
    away = np.full(place.shape, np.nan)
    for c, (name, camera) in enumerate(static_cameras(run, match.folder.spec).items()):
        seen = run[seen_in(run, match, name, clip)]["keypoints"].reindex(frame=numbers).values
        own = np.take_along_axis(seen, np.maximum(place[:, c], 0)[..., None, None], axis=1)
        found = camera.project(tracks.joints[rows].reshape(-1, 3)).reshape(own.shape)
        off = np.linalg.norm(own - found, axis=-1)
        height = np.ptp(found[..., 1], axis=-1)
        enough = (np.isfinite(off).sum(-1) >= MIN_JOINTS) & (place[:, c] >= 0)
        away[:, c][enough] = np.nanmedian(off[enough], axis=-1) / height[enough]
    worst: list[tuple[int, ...]] = []
    for _ in range(MAX_VIEWS):
        if not np.isfinite(away).any():
            break
        row, camera_place, person = np.unravel_index(int(np.nanargmax(away)), away.shape)
        percent = round(100.0 * float(away[row, camera_place, person]))
        worst.append((int(rows[row]), int(camera_place), int(person), percent))
        away[:, :, person] = np.nan
    return worst


def disagreement_pictures(store: Store, run: Run, match: Match, clip: str) -> list[CaptionedImage]:
    """Crop the people whose detections and projected joints differ most, before and after."""
    tracks = joint_tracks(run, clip)
    cameras = static_cameras(run, match.folder.spec)
    pictures = []
    for row, place, person, percent in worst_views(run, match, clip, tracks):
        name, number = list(cameras)[place], int(tracks.frames[row])
        camera, detected = cameras[name], run[seen_in(run, match, name, clip)].sel(frame=number)
        index = run[f"tracking/{clip}"].sel(frame=number)["detection_index"].values[place]
        still = frame_picture(store, match, name, number)
        if still is None and number == int(tracks.frames[0]):
            still = background_image(store, match, name)
        pixels = camera.project(tracks.joints[row, person])
        side = _CROP_HEIGHTS * float(np.ptp(pixels[:, 1])) * np.array([1.6, 1.0])
        png = plot_detections(
            camera,
            ImageDetections(
                detected["boxes"].values, detected["keypoints"].values, index[index >= 0]
            ),
            ReconstructedPeople(tracks.joints[row], tracks.person_ids, index >= 0),
            still=still,
            pitch=estimated_pitch(run, match.folder.pitch, match.folder.spec),
            part=(pixels.mean(axis=0) - 0.5 * side, side),
        )
        pictures.append(
            CaptionedImage(
                f"{clip_title(clip)}, frame {number}, camera {name}: person "
                f"{tracks.person_ids[person]}, whose keypoints differ most from what all cameras "
                f"together found: by {percent} % of the person's height in the median.",
                png,
            )
        )
    return pictures
