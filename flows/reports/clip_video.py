"""The video of a clip with what was found drawn over it, for the person who accepts it."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path
from typing import Final

import numpy as np
from numpy.typing import NDArray

from flows.release import (
    body_tracks,
    broadcast_cameras,
    joint_tracks,
    placed_joints,
    static_cameras,
)
from flows.reports.broadcast import write_broadcast_videos
from flows.reports.match_pictures import frame_pictures
from flows.stage import Match
from worldpose.cameras import Camera
from worldpose.reports.overlay_video import overlay_frames
from worldpose.store import Run, Store
from worldpose.video import write_video

LENGTH: Final = 30.0
"""Longest stretch that is drawn [s]: its middle is that of the clip."""
RATE: Final = 25.0
"""Most frames a second that are drawn."""


def clip_view(run: Run, match: Match, clip: str) -> str | None:
    """Whose video shows a clip: the clip's own camera, else the static one that sees most people.

    None where no camera has a video.
    """
    if clip in broadcast_cameras(run) and clip in match.folder.videos:
        return clip
    return static_view(run, match, clip)


def static_view(run: Run, match: Match, clip: str) -> str | None:
    """The static camera with a video that sees most people in a clip; None where none has any."""
    seen = placed_joints(run, clip)["inliers"].any("joint").sum(("frame", "person")).values
    order = [list(static_cameras(run, match.folder.spec))[c] for c in np.argsort(-seen)]
    return next((camera for camera in order if camera in match.folder.videos), None)


def write_clip_video(
    store: Store, run: Run, match: Match, clip: str, file: Path, *, owner: str | None = None
) -> None:
    """Write the video of a clip with markings and people over it.

    Args:
        store: the project's store.
        run: the run.
        match: the match; `clip_view` has a camera for the clip.
        clip: which clip.
        file: an mp4, named after what it shows.
        owner: whose video, as `static_view` gives it; None = that of `clip_view`.

    Raises:
        InputError: a picture is damaged.
    """
    owner = owner or clip_view(run, match, clip)
    assert owner is not None  # asked for only where there is one
    if owner == clip:
        (made,) = write_broadcast_videos(run, match, file, clips=(clip,))
        made.replace(file)
        return
    fps = match.folder.spec.fps
    every = max(1, round(fps / RATE))
    tracks = joint_tracks(run, clip)
    spare = max(0, len(tracks.frames) - round(LENGTH * fps)) // 2
    frames = tracks.frames[spare : len(tracks.frames) - spare : every]
    camera = static_cameras(run, match.folder.spec)[owner]
    cameras = Camera.stack([camera])[np.zeros(len(frames), dtype=np.intp)]
    width, height = camera.image_size.tolist()

    def pictures() -> Iterator[NDArray[np.uint8]]:
        for picture in frame_pictures(store, match, owner, frames.tolist()):
            dark = np.zeros((height, width, 3), dtype=np.uint8)  # where the camera has no picture
            yield dark if picture is None else picture

    bodies = body_tracks(run, clip)
    drawn = overlay_frames(pictures(), cameras, tracks, frames, match.folder.pitch, bodies)
    write_video(file, drawn, fps / every, quality=23)
