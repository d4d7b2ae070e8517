"""The paper's fit of the moving camera with `method=paper`, in the records of this stage."""

from __future__ import annotations

import numpy as np

from worldpose.broadcast_calibration.evidence import PointEvidence
from worldpose.broadcast_calibration.moving_camera import MovingCamera
from worldpose.pitch.template import PitchTemplate
from worldpose.reference_method.broadcast_calibration import refine


def refit(
    start: MovingCamera,
    pitch: PitchTemplate,
    players: PointEvidence,
    samples: int,
    iterations: int,
) -> MovingCamera:
    """Return the camera of least E_calib, from the camera that tracking gives.

    Args:
        start: initial camera; its projections are the markings' initial positions.
        pitch: the template.
        players: matched keypoints; none if there are no people.
        samples: maximum number of markings' points per frame.
        iterations: of Adam.
    """
    lines, camera = pitch.sample_lines(0.5).points_world, start.camera
    pixels = camera.project(np.broadcast_to(lines, (len(start), *lines.shape)))
    seen = ((pixels >= 0.0) & (pixels <= start.image_size - 1.0)).all(axis=-1)
    frame, point = np.nonzero(seen)
    # Evenly chosen among those of a frame.
    place = np.arange(len(frame)) - np.searchsorted(frame, frame)
    kept = place % np.maximum(1, -(-seen.sum(axis=1) // samples))[frame] == 0
    frame, point = frame[kept], point[kept]
    field = lines[point], pixels[frame, point], frame
    people = players.world, players.image, players.frame
    return MovingCamera.from_batch(refine(camera, field, people, iterations))
