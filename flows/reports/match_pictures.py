"""Images of a match by camera and match frame."""

from __future__ import annotations

from collections.abc import Iterator, Sequence

import numpy as np

from data_contracts.arrays import Image, Integers
from data_contracts.pitch import PitchSpec
from flows.layers import pitch_of_run
from flows.results.run_cameras import estimated_pitch
from flows.stage import Match
from worldpose.ingest.footage import read_still, unit_frames
from worldpose.store.store import Run, Store
from worldpose.video.folder import open_video, pictures_at


def shown_pitch(run: Run, match: Match, clip: str | None = None) -> PitchSpec | None:
    """Return the pitch as a run, or a clip's broadcast cameras, estimated it; None without one."""
    pitch = pitch_of_run(run, lambda: match.folder.pitch)
    return estimated_pitch(run, pitch, match.folder.spec, clip)


def background_image(store: Store, match: Match, camera_id: str) -> Image | None:
    """Return an image (height, width, 3) RGB that shows what a static camera sees.

    It is the still of the match folder or, without one, the first readable image of the camera's
    video in the clips; None if the match has neither. The latest run of the store maps match frames
    to video frames; here and below. InputError if the image is damaged.
    """
    still = match.folder.stills.get(camera_id)
    if still is not None:
        camera = match.folder.spec.camera(camera_id)
        return read_still(still, (camera.width, camera.height))
    for first, count in unit_frames(match.folder.spec, camera_id).ranges:
        images = frame_pictures(store, match, camera_id, range(first, first + count))
        for image in images:
            if image is not None:
                return image
    return None


def frame_picture(store: Store, match: Match, owner: str, frame: int) -> Image | None:
    """Return a camera's image (height, width, 3) RGB in a match frame; None if there is none.

    The owner is a static camera or a broadcast view; here and below.
    """
    return next(frame_pictures(store, match, owner, [frame]))


def frame_pictures(
    store: Store, match: Match, owner: str, frames: Sequence[int]
) -> Iterator[Image | None]:
    """Yield images of ascending match frames, decoded once in order; InputError if damaged."""
    file = match.folder.videos.get(owner)
    if file is None or not file.exists():  # results outlive their videos
        yield from (None for _ in frames)
        return
    spec, wanted = match.folder.spec, np.asarray(frames, dtype=np.int64)
    numbers: Integers | None = None
    results = store.run(match.match_id).results if store.runs(match.match_id) else {}
    if (key := results.get(f"ingest/{owner}")) is not None:
        footage = store.open_result(match.match_id, "ingest", owner, key)
        if "picture_of_frame" in footage:  # as ingest found them; -1 = none
            known = footage["picture_of_frame"].reindex(frame=wanted, fill_value=-1)
            numbers = known.values.astype(np.int64)
    with open_video(file) as video:
        if numbers is None:
            clock = unit_frames(spec, owner)
            numbers = video.index.shown(clock.numbers(wanted), spec.fps * clock.rate, str(file))
        numbers[numbers >= len(video)] = -1
        yield from pictures_at(video, numbers)
