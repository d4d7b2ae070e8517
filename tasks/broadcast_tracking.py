"""Task of stage `broadcast_tracking`: a moving camera's people on the pitch, by feet and shirts."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
import xarray as xr
from numpy.typing import NDArray

from data_contracts.arrays import Image
from data_contracts.broadcast_tracking import BROADCAST_TRACKING
from data_contracts.keypoints import KeypointDetections
from data_contracts.pitch import PitchSpec
from data_contracts.tracking import Track
from data_contracts.work import Work
from tasks.clip_inputs import select_frames
from tasks.unit import open_input, require_registered, unit_task
from worldpose.broadcast_calibration.pitch_errors import SIZES
from worldpose.broadcast_calibration.uncertainty import moving_from_arrays, static_covariance
from worldpose.pitch.template import PitchTemplate
from worldpose.store.store import Store
from worldpose.tracking.plane.feet import GroundPositions, locate_feet
from worldpose.tracking.plane.shirts import measure_shirts
from worldpose.tracking.plane.tracker import track_on_plane
from worldpose.video.folder import open_video


@unit_task
def broadcast_tracking(work: Work) -> str:
    """Publish the tracks of the clip's people and their places on the pitch; return the key."""
    store = Store.open(work.project)
    sources: dict[str, Any] = work.recipe.sources
    first, count = sources["first_frame"], sources["frame_count"]
    filmed = open_broadcast(store, work)
    detections, pitch = filmed.detections, filmed.pitch
    path = Path(work.folder) / sources["video"]
    with store.publish(work) as result:
        with open_video(path) as video:
            start = first + sources["offset_frames"]
            images = (image for _, image in video.frames(start, start + count))
            positions = _locate_people(detections, filmed.camera, pitch, images)
        require_registered(path, sources["video_sha256"])
        size = (pitch.length, pitch.width)
        tracks = track_on_plane(positions, float(sources["fps"]), pitch_size=size)
        index = tracks.detection_index[:, 0]
        found = int(np.isfinite(positions.xy[..., 0]).sum())
        result.write(
            BROADCAST_TRACKING,
            arrays={
                "detection_index": index,
                "ground": tracks.xy.astype(np.float32),
                "ground_velocity": tracks.velocity.astype(np.float32),
                "ground_covariance": tracks.covariance.astype(np.float32),
                "ground_height": tracks.height.astype(np.float32),
            },
            coordinates={
                "frame": np.arange(first, first + count),
                "person": np.arange(index.shape[1], dtype=np.int32),
            },
            attributes={
                "clip_id": work.recipe.unit,
                "tracks": [_track(number, seen, first) for number, seen in enumerate(index.T)],
            },
        )
        if index.shape[1] and not sources["has_estimates"]:
            result.warnings.append(
                f"{work.recipe.name}: people have places on the pitch and no bodies. To get bodies "
                f"from one camera, save a monocular method's poses as estimates/{work.recipe.unit}"
                ".npz in the match folder, and run again."
            )
        result.figures["people"] = float(index.shape[1])
        if found:
            result.figures["unmatched_share"] = 1.0 - np.count_nonzero(index >= 0) / found
        if index.shape[1]:
            variance = np.trace(tracks.covariance, axis1=-2, axis2=-1)
            result.figures["plane_std_m"] = float(np.sqrt(np.nanmedian(variance)))
        else:
            result.warnings.append(
                f"{work.recipe.name} found no person on the pitch: {found} detections have feet "
                "there. Check the camera in the report, and the detections."
            )
    return work.key


@dataclass(frozen=True, eq=False)
class BroadcastInputs:
    """The broadcast camera of a clip, and what it sees.

    Attributes:
        detections: stored detections of the clip's frames.
        camera: the stored moving camera, at the pooled position if there is one.
        pitch: surface under the feet, as the calibration found it.
    """

    detections: xr.Dataset
    camera: xr.Dataset
    pitch: PitchTemplate


def open_broadcast(store: Store, work: Work) -> BroadcastInputs:
    """Read the broadcast camera and its detections in the clip of `work`."""
    sources: dict[str, Any] = work.recipe.sources
    first, count = sources["first_frame"], sources["frame_count"]
    inputs = {name.partition("/")[0]: name for name in work.recipe.inputs}
    calibrated = open_input(store, work, inputs["broadcast_calibration"])
    camera = inputs.get("broadcast_pooling")
    moving = calibrated if camera is None else open_input(store, work, camera)
    detected = next(name for stage, name in inputs.items() if stage in ("ingest", "detection"))
    detections = select_frames(open_input(store, work, detected), np.arange(first, first + count))
    # The surface that the calibration found: people stand on it as the markings lie on it.
    surface = {name: (calibrated.attrs["pitch"] or {}).get(name) for name in SIZES}
    known = {name: value for name, value in surface.items() if value is not None}
    pitch = PitchTemplate.from_spec(PitchSpec.model_validate(sources["pitch"] | known))
    return BroadcastInputs(detections, moving, pitch)


def _locate_people(
    detections: xr.Dataset, camera: xr.Dataset, pitch: PitchTemplate, images: Iterator[Image]
) -> GroundPositions:
    """Return places and shirts of a moving camera's detections, as those of one camera."""
    moving, uncertainty = moving_from_arrays(
        {str(name): array.values for name, array in camera.data_vars.items()}
    )
    covariance, cameras = static_covariance(moving, uncertainty), moving.camera
    seen = KeypointDetections.from_arrays(detections)
    parts = []
    for frame, image in zip(range(len(moving)), images, strict=True):
        now = slice(frame, frame + 1)
        people = KeypointDetections.stack([seen[now]])
        found = locate_feet(cameras[now], people, pitch, camera_covariance=covariance[now])
        shirts = measure_shirts(
            image, seen.keypoints[frame], seen.confidence[frame], seen.boxes[frame]
        )
        # Parts start tracks, too: in a duel one player is often a part of the other's box.
        parts.append(replace(found, is_whole=None, boxes=None, shirts=shirts[None, None]))
    return GroundPositions.concatenate(parts)


def _track(person: int, index: NDArray[np.int16], first: int) -> dict[str, Any]:
    seen = np.flatnonzero(index >= 0)
    return Track(
        person=person,
        first_frame=first + int(seen[0]),
        last_frame=first + int(seen[-1]),
        frames_seen=len(seen),
        views=1.0,
        kind="plane",
    ).model_dump(mode="json")
