"""Report section about a clip: people in camera images and from above."""

from __future__ import annotations

from itertools import islice
from typing import Final

import numpy as np

from data_contracts.arrays import Flags, Floats, Image
from data_contracts.pitch import PitchSpec
from flows.reports.clip_video import mark_places, people_at_images
from flows.reports.match_pictures import background_image, frame_picture, shown_pitch
from flows.results.best_results import Origin, clip_title, joint_tracks, placed_joints
from flows.results.run_cameras import static_cameras
from flows.results.tool_exports import ImageView, image_views
from flows.stage import Match
from flows.stages.filtering import seen_in
from worldpose.dataset.contents import sample_evenly
from worldpose.formats.joints_file import JointTracks
from worldpose.geometry.cameras import Camera
from worldpose.reports.bodies import BodyTracks, plot_bodies
from worldpose.reports.clips import (
    ImageDetections,
    ReconstructedPeople,
    plot_camera_view,
    plot_detections,
    plot_paths,
    plot_stadium,
)
from worldpose.reports.html_page import CaptionedImage
from worldpose.store.store import Run, Store

MAX_VIEWS: Final = 2
"""Number of views shown with large residuals: the worst, each of another person."""
EVALUATED_FRAMES: Final = 300
"""Frames of a clip that are evaluated, evenly spaced."""
MIN_JOINTS: Final = 8
"""Minimum number of joints of a person in a view."""
_CROP_HEIGHTS: Final = 2.5
"""Side length of the crop [height of the person]."""


def clip_pictures(
    store: Store, run: Run, match: Match, clip: str, truth: JointTracks | None = None
) -> list[CaptionedImage]:
    """Draw the stadium from a camera and from above, the bodies, and all trajectories."""
    cameras = static_cameras(run, match.folder.spec)
    tracks = joint_tracks(run, clip)
    pitch = shown_pitch(run, match)
    seen = placed_joints(run, clip)["inliers"].any("joint").sum("person").values
    if truth is not None:
        spec = match.folder.spec.clip(clip)
        own = (truth.frames - spec.first_frame) // spec.frame_count == 0
        truth = JointTracks(truth.frames[own], truth.person_ids, truth.joints[own])
    pictures = []
    if len(tracks.frames):
        tracks, has_marks = mark_places(run, clip, tracks, pitch)
        first = int(tracks.frames[0])
        view = _static_views(run, match, clip, tracks)[int(seen[0].argmax())]
        widest, camera = view.name, view.camera_in(first)
        shown, bodies = people_at_images(run, clip, tracks, view)
        image = _image_with_people(store, match, widest, first)
        here = f"{clip_title(clip)}, frame {first}"
        beneath = "." if image is None else ", over its image."
        if has_marks:
            beneath += " A triangle stands on its tip where only the feet place a person."
        pictures = [
            CaptionedImage(
                f"{here}, from camera {widest}: markings and reconstructed people, "
                f"projected by the estimated camera{beneath}",
                plot_camera_view(camera, f"camera {widest}", shown, 0, still=image, pitch=pitch),
            ),
            CaptionedImage(
                f"{here}, from above. The more cameras see a place, the darker it is.",
                plot_stadium(cameras, "", tracks, pitch=pitch),
            ),
        ]
        if bodies is not None and np.isfinite(bodies.poses.transl[0]).any():
            pictures.append(_bodies(store, bodies, match, clip, (widest, camera), pitch))
    above = plot_paths(tracks, truth=truth, cameras=cameras, pitch=pitch)
    pictures.append(CaptionedImage(f"{clip_title(clip)}: the paths of all people.", above))
    return pictures


def _image_with_people(store: Store, match: Match, camera_id: str, frame: int) -> Image | None:
    """Return a camera's image in a clip's first frame, else the still, which was taken then."""
    image = frame_picture(store, match, camera_id, frame)
    return background_image(store, match, camera_id) if image is None else image


def _bodies(
    store: Store,
    bodies: BodyTracks,
    match: Match,
    clip: str,
    view: tuple[str, Camera],
    pitch: PitchSpec | None,
) -> CaptionedImage:
    """Draw the bodies of a clip's first frame on the image of a camera, given with its id."""
    camera_id, camera = view
    frame = int(bodies.frames[0])
    image = _image_with_people(store, match, camera_id, frame)
    png = plot_bodies(
        camera,
        f"camera {camera_id}, frame {frame}",
        bodies.model.vertices(bodies.poses[0]),
        bodies.model.faces,
        bodies.person_ids,
        still=image,
        pitch=pitch,
    )
    return CaptionedImage(
        f"{clip_title(clip)}, frame {frame}: fitted bodies ({bodies.model.name}) where camera "
        f"{camera_id} shows most people{'' if image is None else ', over its image'}.",
        png,
    )


def detection_pictures(store: Store, run: Run, match: Match, clip: str) -> list[CaptionedImage]:
    """Draw the view with most people: its detections, and their track assignments."""
    placed = placed_joints(run, clip)
    inliers = placed["inliers"].any("joint")
    seen = inliers.sum("person").values
    if not seen.any():
        return []
    tracks = joint_tracks(run, clip)
    row, index = (int(n) for n in np.unravel_index(int(seen.argmax()), seen.shape))
    name = list(static_cameras(run, match.folder.spec))[index]
    png = _plot_view(store, run, match, clip, tracks, (row, index), inliers.values[row, index])
    return [
        CaptionedImage(
            f"Camera {name}, frame {tracks.frames[row]}. Left: its detections; orange detections "
            "belong to no track. Right: the people that all cameras reconstruct, projected into "
            "this camera; a dashed box marks a person without a detection in this camera.",
            png,
        )
    ]


def _plot_view(
    store: Store,
    run: Run,
    match: Match,
    clip: str,
    tracks: JointTracks,
    place: tuple[int, int],
    seen: Flags | None = None,
    part: tuple[Floats, Floats] | None = None,
) -> bytes:
    """Return a PNG of detections and reconstruction in one view.

    Its place is the indices of frame and static camera; `seen` are the people whom the camera
    supports, None = those with a tracked detection.
    """
    row, index = place
    view = _static_views(run, match, clip, tracks)[index]
    name, number = view.name, int(tracks.frames[row])
    detected = run[seen_in(run, match, name, clip)].sel(frame=number)
    tracked = run[f"tracking/{clip}"].sel(frame=number)["detection_index"].values[index]
    still = frame_picture(store, match, name, number)
    if still is None and row == 0:
        still = background_image(store, match, name)
    return plot_detections(
        view.camera_in(number),
        ImageDetections(
            detected["boxes"].values, detected["keypoints"].values, tracked[tracked >= 0]
        ),
        ReconstructedPeople(
            view.at_images(tracks.joints, np.array([row]))[0],
            tracks.person_ids,
            tracked >= 0 if seen is None else seen,
        ),
        still=still,
        pitch=shown_pitch(run, match),
        part=part,
    )


def _static_views(run: Run, match: Match, clip: str, tracks: JointTracks) -> list[ImageView]:
    """Return the images of static cameras at joints, with the changes that the run corrects."""
    origin = Origin(run, match.registration)
    views = image_views(origin, clip, tracks.frames, corrected=True)
    return list(islice(views, len(origin.static_cameras)))


def worst_views(run: Run, match: Match, clip: str, tracks: JointTracks) -> list[tuple[int, ...]]:
    """Return views with the largest median distance of keypoints to projected joints, worst first.

    Distances are in heights of the person in the image, over the keypoints assigned to the person's
    track; each person appears once. A view is frame index, camera, person, and distance in percent.
    """
    rows = sample_evenly(len(tracks.frames), EVALUATED_FRAMES)
    numbers = tracks.frames[rows]
    tracked = run[f"tracking/{clip}"]["detection_index"].sel(frame=numbers)
    place = tracked.reindex(person=tracks.person_ids, fill_value=-1).values
    away = np.full(place.shape, np.nan)
    for c, view in enumerate(_static_views(run, match, clip, tracks)):
        seen = run[seen_in(run, match, view.name, clip)]["keypoints"].reindex(frame=numbers).values
        own = np.take_along_axis(seen, np.maximum(place[:, c], 0)[..., None, None], axis=1)
        found = view.show(tracks.joints, rows)
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
    views = _static_views(run, match, clip, tracks)
    pictures = []
    for row, index, person, percent in worst_views(run, match, clip, tracks):
        name = views[index].name
        pixels = views[index].show(tracks.joints[:, [person]], np.array([row]))[0, 0]
        side = _CROP_HEIGHTS * float(np.ptp(pixels[:, 1])) * np.array([1.6, 1.0])
        part = pixels.mean(axis=0) - 0.5 * side, side
        pictures.append(
            CaptionedImage(
                f"{clip_title(clip)}, frame {tracks.frames[row]}, camera {name}: person "
                f"{tracks.person_ids[person]}, whose keypoints differ most from what all cameras "
                f"together found: by {percent} % of the person's height in the median.",
                _plot_view(store, run, match, clip, tracks, (row, index), part=part),
            )
        )
    return pictures
