"""Video of a clip with an overlay of the results, for the reviewer."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path

import numpy as np

from data_contracts.arrays import Image, Integers
from data_contracts.conventions import COCO17_HIPS
from data_contracts.pitch import PitchSpec
from flows.reports.broadcast import (
    MAX_VIDEO_S,
    broadcast_video_frames,
    video_step,
    write_broadcast_video,
)
from flows.reports.match_pictures import frame_pictures, shown_pitch
from flows.results.best_results import (
    Origin,
    body_tracks,
    clip_positions,
    joint_tracks,
    placed_joints,
)
from flows.results.run_cameras import broadcast_views, static_cameras
from flows.results.tool_exports import ImageView, image_views
from flows.stage import Match
from worldpose.formats.joints_file import JointTracks
from worldpose.geometry.cameras import Camera
from worldpose.pitch.template import PitchTemplate
from worldpose.reports.bodies import BodyTracks
from worldpose.reports.videos import overlay_frames
from worldpose.store.store import Run, Store
from worldpose.video.files import write_video


def clip_view(run: Run, match: Match, clip: str) -> str | None:
    """Return the source of a clip's video: a broadcast camera, else a static camera.

    Of several it is the one with most people; None if no camera has a video that is at hand.
    """
    match = match.at_hand()
    views = [view for view in broadcast_views(run, clip) if view in match.folder.videos]
    if not views:
        return static_view(run, match, clip)
    return max(views, key=lambda v: int(run[f"broadcast_calibration/{v}"]["player_count"].sum()))


def static_view(run: Run, match: Match, clip: str) -> str | None:
    """Return the camera with most people in a clip of those with a video at hand; None if none."""
    if not match.has_static_cameras:
        return None
    seen = placed_joints(run, clip)["inliers"].any("joint").sum(("frame", "person")).values
    order = [list(static_cameras(run, match.folder.spec))[c] for c in np.argsort(-seen)]
    return next((camera for camera in order if camera in match.at_hand().folder.videos), None)


def write_clip_video(
    store: Store, run: Run, match: Match, clip: str, file: Path, *, owner: str | None = None
) -> None:
    """Write the video (mp4) of a clip with markings and people overlaid.

    The owner is a camera as `static_view` returns it; None = that of `clip_view`, which has one. A
    long clip is cut to its middle part. InputError if an image is damaged.
    """
    owner = owner or clip_view(run, match, clip)
    assert owner is not None  # the caller checks that there is one
    if owner in broadcast_views(run):
        write_broadcast_video(run, match, owner, file)
        return
    pitch = shown_pitch(run, match)
    tracks, _ = mark_places(run, clip, joint_tracks(run, clip), pitch)
    frames = video_frames(run, match, clip, owner)
    views = image_views(Origin(run, match.registration), clip, tracks.frames, corrected=True)
    view = next(view for view in views if view.name == owner)
    cameras = Camera.stack([view.camera_in(frame) for frame in frames.tolist()])
    width, height = view.camera.image_size.tolist()
    tracks, bodies = people_at_images(run, clip, tracks, view)

    def pictures() -> Iterator[Image]:
        for picture in frame_pictures(store, match, owner, frames.tolist()):
            dark = np.zeros((height, width, 3), dtype=np.uint8)  # where the camera has no frame
            yield dark if picture is None else picture

    drawn = overlay_frames(pictures(), cameras, tracks, frames, pitch, bodies)
    write_video(file, drawn, match.folder.spec.fps / video_step(match), quality=23)


def mark_places(
    run: Run, clip: str, tracks: JointTracks, pitch: PitchSpec | None
) -> tuple[JointTracks, bool]:
    """Return a clip's best joints, with a mark where only the feet place a person, and if any is.

    The mark is a triangle on its tip: ankles at the place, knees and hips 1 m above it.
    """
    places = clip_positions(run, clip)
    joints = np.full((*places.on_plane.shape, 17, 3), np.nan)
    joints[:, np.searchsorted(places.person, tracks.person_ids)] = tracks.joints
    alone = places.on_plane & np.isnan(joints).all(axis=(-2, -1))
    mark = np.full((17, 3), np.nan)
    mark[COCO17_HIPS[0] :] = [*[[-0.3, 0.0, 1.0], [0.3, 0.0, 1.0]] * 2, *[[0.0, 0.0, 0.0]] * 2]
    x, y = places.xy[alone].T
    ground = np.zeros_like(x) if pitch is None else PitchTemplate.from_spec(pitch).height(x, y)
    joints[alone] = np.column_stack([x, y, ground])[:, None] + mark
    return JointTracks(tracks.frames, places.person, joints), bool(alone.any())


def people_at_images(
    run: Run, clip: str, tracks: JointTracks, view: ImageView
) -> tuple[JointTracks, BodyTracks | None]:
    """Return a clip's best joints and bodies, if any, where they are in a camera's images.

    Bodies move as a whole: between a match frame and its image they keep their pose.
    """
    bodies = body_tracks(run, clip)
    if bodies is not None:
        poses = replace(bodies.poses, transl=view.at_images(bodies.poses.transl))
        bodies = replace(bodies, poses=poses)
    return replace(tracks, joints=view.at_images(tracks.joints)), bodies


def video_frames(run: Run, match: Match, clip: str, owner: str) -> Integers:
    """Return the match frames of a clip's video, as `write_clip_video` writes it for `owner`."""
    if owner in broadcast_views(run):
        frames = run[f"broadcast_calibration/{owner}"]["frame"].values
        return np.asarray(frames[broadcast_video_frames(run, match, owner)])
    all_frames = joint_tracks(run, clip).frames
    spare = max(0, len(all_frames) - round(MAX_VIDEO_S * match.folder.spec.fps)) // 2
    return np.asarray(all_frames[spare : len(all_frames) - spare : video_step(match)])
