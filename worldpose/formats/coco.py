"""COCO keypoints data set from 3D joints projected into a static camera."""

from __future__ import annotations

import json
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from data_contracts.conventions import COCO17, COCO17_BONES
from worldpose.formats.files import whole_file
from worldpose.formats.joints_file import JointTracks
from worldpose.geometry import Camera

DECIMALS = 2
"""Of all pixel values: a hundredth of a pixel is far below any detector's error."""


def coco_dataset(
    camera_id: str,
    camera: Camera,
    tracks: JointTracks,
    observed: NDArray[np.bool_],
    *,
    offset_frames: int = 0,
) -> dict[str, Any]:
    """Return the people of one static camera as a COCO keypoints data set.

    One image per frame: `id` is the camera's own frame number, `file_name` is <camera>/<frame with
    six digits>. One annotation per person with at least one joint in the image: `keypoints` are the
    reprojected 3D joints with v = 2 if this camera's own observation is an inlier of the joint, v =
    1 if the joint comes from other cameras only, and 0, 0, 0 if there is no joint or it is outside
    the image. `bbox` and `area` are those of the keypoints; `track_id` is the person.

    Args:
        camera_id: prefix of the image names.
        camera: a single camera.
        tracks: frames are match frames.
        observed: (frames, persons, 17), the camera's observation of the joint was an inlier.
        offset_frames: the camera's own frame number at match frame 0.
    """
    width, height = (int(n) for n in camera.image_size)
    frames, persons = tracks.joints.shape[:2]
    pixels = camera.project(tracks.joints.reshape(-1, 3)).reshape(frames, persons, 17, 2)
    pixels = np.round(pixels, DECIMALS)
    within = (pixels >= -0.5) & (pixels <= np.array([width, height]) - 0.5)
    visible = np.all(within, axis=-1) * np.where(observed, 2, 1)
    own_frames = [int(frame) + offset_frames for frame in tracks.frames]
    annotations = [
        {
            "id": number,
            "image_id": own_frames[frame],
            "category_id": 1,
            "track_id": int(tracks.person_ids[person]),
            "iscrowd": 0,
            **_labels(pixels[frame, person], visible[frame, person]),
        }
        for number, (frame, person) in enumerate(np.argwhere(visible.any(-1)), start=1)
    ]
    return {
        "info": {
            "description": f"3D joints reprojected into camera {camera_id}; (0, 0) is the centre "
            "of the top-left pixel; v = 2: agrees with this camera's observation, v = 1: from "
            "other cameras only, v = 0: no joint in the picture",
            "version": "1.0",
        },
        "licenses": [],
        "images": [
            {
                "id": frame,
                "file_name": f"{camera_id}/{frame:06d}",
                "width": width,
                "height": height,
            }
            for frame in own_frames
        ],
        "annotations": annotations,
        "categories": [
            {
                "id": 1,
                "name": "person",
                "supercategory": "person",
                "keypoints": list(COCO17),
                "skeleton": [[a + 1, b + 1] for a, b in COCO17_BONES],
            }
        ],
    }


def write_coco(path: Path, dataset: Mapping[str, Any]) -> None:
    """Write a data set as JSON, whole or not at all."""
    with whole_file(path) as draft:
        draft.write_text(json.dumps(dataset, separators=(",", ":")) + "\n", encoding="utf-8")


def _labels(pixels: NDArray[np.float64], visible: NDArray[np.int64]) -> dict[str, Any]:
    """Return keypoints and box of one person: (17, 2) [px] and v (17,), at least one above 0."""
    seen = visible > 0
    low, high = pixels[seen].min(axis=0), pixels[seen].max(axis=0)
    width, height = np.round(high - low, DECIMALS).tolist()
    triples = np.column_stack([np.where(seen[:, None], pixels, 0.0), visible])
    return {
        "keypoints": [value for x, y, v in triples.tolist() for value in (x, y, int(v))],
        "num_keypoints": int(seen.sum()),
        "bbox": [*low.tolist(), width, height],
        "area": round(width * height, DECIMALS),
    }
