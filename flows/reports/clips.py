"""Report section about a clip: people in camera images and from above."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from data_contracts.pitch import PitchSpec
from flows.reports.match_pictures import background_image, frame_picture
from flows.results.best_results import (
    body_tracks,
    clip_title,
    estimated_pitch,
    joint_tracks,
    placed_joints,
    static_cameras,
)
from flows.stage import Match
from flows.stages.filtering import seen_in
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


def clip_pictures(
    store: Store, run: Run, match: Match, clip: str, truth: JointTracks | None = None
) -> list[CaptionedImage]:
    """Draw the stadium from a camera and from above, the bodies, and all trajectories."""
    cameras = static_cameras(run, match.folder.spec)
    tracks = joint_tracks(run, clip)
    pitch = estimated_pitch(run, match.folder.pitch, match.folder.spec)
    seen = placed_joints(run, clip)["inliers"].any("joint").sum("person").values
    pictures = []
    if len(tracks.frames):
        first = int(tracks.frames[0])
        widest = list(cameras)[int(seen[0].argmax())]
        image = _image_with_people(store, match, widest, first)
        here = f"{clip_title(clip)}, frame {first}"
        beneath = "" if image is None else ", over its image"
        pictures = [
            CaptionedImage(
                f"{here}, from camera {widest}: markings and reconstructed people, "
                f"projected by the estimated camera{beneath}.",
                plot_camera_view(
                    cameras[widest], f"camera {widest}", tracks, 0, still=image, pitch=pitch
                ),
            ),
            CaptionedImage(
                f"{here}, from above. The more cameras see a place, the darker it is.",
                plot_stadium(cameras, "", tracks, pitch=pitch),
            ),
        ]
        bodies = body_tracks(run, clip)
        if bodies is not None:
            pictures.append(_bodies(store, bodies, match, clip, (widest, cameras[widest]), pitch))
    above = plot_paths(tracks, truth=truth, cameras=cameras, pitch=pitch)
    pictures.append(CaptionedImage(f"{clip_title(clip)}: the paths of all people.", above))
    return pictures


def _image_with_people(
    store: Store, match: Match, camera_id: str, frame: int
) -> NDArray[np.uint8] | None:
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
    seen = placed["inliers"].any("joint").sum("person").values
    if not seen.any():
        return []
    cameras = static_cameras(run, match.folder.spec)
    tracks = joint_tracks(run, clip)
    frame, index = (int(n) for n in np.unravel_index(int(seen.argmax()), seen.shape))
    name = list(cameras)[index]
    number = int(tracks.frames[frame])
    detected = run[seen_in(run, match, name, clip)].sel(frame=number)
    tracked = run[f"tracking/{clip}"].sel(frame=number)["detection_index"].values[index]
    image = frame_picture(store, match, name, number)
    if image is None and frame == 0:
        image = background_image(store, match, name)
    png = plot_detections(
        cameras[name],
        ImageDetections(
            detected["boxes"].values, detected["keypoints"].values, tracked[tracked >= 0]
        ),
        ReconstructedPeople(
            tracks.joints[frame],
            tracks.person_ids,
            placed["inliers"].values[frame, index].any(-1),
        ),
        still=image,
        pitch=estimated_pitch(run, match.folder.pitch, match.folder.spec),
    )
    return [
        CaptionedImage(
            f"Camera {name}, frame {number}. Left: its detections; orange detections belong to no "
            "track. Right: the people that all cameras reconstruct, projected into this camera; a "
            "dashed box marks a person without a detection in this camera.",
            png,
        )
    ]
